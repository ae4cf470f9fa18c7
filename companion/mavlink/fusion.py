"""Is what we send really fused, and if not, which gate stops it. An autopilot drops bad vision in silence, whole or in
part (PX4.md, 7): so each of its gates is looked at by itself, in the order in which a sample meets them."""

from __future__ import annotations

import math
from collections.abc import Callable

from companion.mavlink.checks import Check, Facts, SentVision, Verdict

_PX4_FRAMES = {1, 4, 20, 21}  # LOCAL_NED, LOCAL_ENU, LOCAL_FRD, LOCAL_FLU
_PX4_CHILD_FRAMES = _PX4_FRAMES | {8, 9, 12}
_ARDUPILOT_FRAME, _ARDUPILOT_CHILD = 20, 12
_FUSED_TYPES = {0, 1, 2, 3}  # UNKNOWN, NAIVE, VISION, VIO
_MAX_NORM_ERROR = 1e-5
_MAX_SIGMA_M = 5.0  # COM_POS_FS_EPH
_REJECTED = 1.0

Gate = tuple[str, str, str]  # what was found, what is expected, what to do


def check_fusion(facts: Facts) -> list[Check]:
    """One line for the whole, named fusion, and one for each gate that is shut, named fusion.GATE."""
    gates: tuple[tuple[str, Callable[[Facts], Gate | None]], ...] = (
        ("switch", _switch),
        ("rate", _rate),
        ("frame", _frame),
        ("estimator_type", _estimator_type),
        ("quaternion", _quaternion),
        ("quality", _quality),
        ("covariance", _covariance),
        ("time", _time),
        ("innovation", _innovation),
    )
    shut = [(name, found) for name, gate in gates if (found := gate(facts)) is not None]
    checks = [
        Check(name=f"fusion.{name}", verdict=Verdict.FAIL, actual=actual, expected=expected, mend=mend)
        for name, (actual, expected, mend) in shut
    ]
    return [_whole(facts, [name for name, _ in shut]), *checks]


def _whole(facts: Facts, shut: list[str]) -> Check:
    flags = "" if facts.estimator_flags is None else f" (estimator flags 0x{facts.estimator_flags:03x})"
    if facts.is_vision_fused is None:
        return Check(name="fusion", verdict=Verdict.FAIL, actual="the estimator gives no status", mend="See its stream")
    if facts.is_vision_fused and not shut:
        return Check(name="fusion", verdict=Verdict.OK, actual=f"vision is fused{flags}")
    if facts.is_vision_fused and "switch" not in shut:  # else the position comes from elsewhere: satellites
        actual = f"fused in part at best{flags}: {', '.join(shut)}"
        return Check(name="fusion", verdict=Verdict.FAIL, actual=actual, mend="Open the gates below")
    if shut:
        actual = f"vision is not fused{flags}; shut: {', '.join(shut)}"
        return Check(name="fusion", verdict=Verdict.FAIL, actual=actual, mend="Open the gates below")
    if facts.vision is None:
        return Check(
            name="fusion",
            verdict=Verdict.WARN,
            actual=f"no vision is being sent{flags}, so nothing can be said",
            mend="Start the companion, or let doctor send a test pose: vehicle on the ground, disarmed, --probe",
        )
    return Check(
        name="fusion",
        verdict=Verdict.FAIL,
        actual=f"vision is not fused{flags}, though no gate that we know is shut",
        mend="Keep the vehicle still for some seconds and run again; restart the autopilot; read its own log",
    )


def _switch(facts: Facts) -> Gate | None:
    values = facts.parameters
    if facts.autopilot == "px4":
        control, allowed = values.get("EKF2_EV_CTRL"), values.get("EKF2_SENS_EN")
        if control is not None and int(control) & 9 != 9:
            return f"EKF2_EV_CTRL is {control:g}", "15: position, height, velocity, yaw", "Set EKF2_EV_CTRL to 15"
        if allowed is not None and not int(allowed) & 8:
            return f"EKF2_SENS_EN is {allowed:g}", "bit 3 set", "Set EKF2_SENS_EN to 8191"
        return None
    wanted = {"VISO_TYPE": (1,), "EK3_SRC1_POSXY": (6,), "EK3_SRC1_YAW": (6,), "AHRS_EKF_TYPE": (3,)}
    for name, good in wanted.items():
        value = values.get(name)
        if value is not None and value not in good:
            return f"{name} is {value:g}", f"{good[0]}", f"Set {name} to {good[0]}"
    return None


def _of_vision(judge: Callable[[SentVision, Facts], Gate | None]) -> Callable[[Facts], Gate | None]:
    return lambda facts: None if facts.vision is None else judge(facts.vision, facts)


@_of_vision
def _rate(vision: SentVision, facts: Facts) -> Gate | None:
    longest = 0.2 if facts.autopilot == "px4" else 0.25
    if vision.max_gap_s < longest and vision.rate_hz >= 1.0 / longest:
        return None
    return (
        f"{vision.rate_hz:.1f} Hz, longest pause {vision.max_gap_s * 1e3:.0f} ms",
        f"no pause of {longest * 1e3:.0f} ms; 30 to 50 Hz is asked for",
        "Is the companion overloaded, the link too slow?",
    )


def _missing(facts: Facts, part: str, bit: int) -> bool:
    """PX4 gives no test ratio for a part of the vision that it drops, though its flags say fused: as recorded in
    wrong_input, part by part."""
    control = facts.parameters.get("EKF2_EV_CTRL")
    wanted = control is not None and bool(int(control) & bit)
    is_told = facts.autopilot == "px4" and facts.is_vision_fused is True and bool(facts.ratios)
    return wanted and is_told and part not in facts.ratios


def _frame(facts: Facts) -> Gate | None:
    if facts.vision is not None:
        return _sent_frame(facts.vision, facts)
    if _missing(facts, "position", 1):
        return "the position is dropped", "frame_id LOCAL_NED (1)", "What frame_id does the sender of ODOMETRY use?"
    if _missing(facts, "velocity", 4):
        return "the velocity is dropped", "child_frame_id BODY_FRD (12)", "What child_frame_id does the sender use?"
    return None


def _sent_frame(vision: SentVision, facts: Facts) -> Gate | None:
    pair = f"frame_id {vision.frame_id}, child_frame_id {vision.child_frame_id}"
    if facts.autopilot == "ardupilot":
        if (vision.frame_id, vision.child_frame_id) == (_ARDUPILOT_FRAME, _ARDUPILOT_CHILD):
            return None
        return pair, "LOCAL_FRD (20) with BODY_FRD (12)", "ArduPilot drops every other pair in silence"
    if vision.frame_id not in _PX4_FRAMES:
        return pair, "frame_id LOCAL_NED (1)", "PX4 drops the position in silence"
    if vision.child_frame_id not in _PX4_CHILD_FRAMES:
        return pair, "child_frame_id BODY_FRD (12)", "PX4 drops the velocity in silence"
    return None


def _estimator_type(facts: Facts) -> Gate | None:
    """By what was sent, where that is known; else by the autopilot's words, which may be late."""
    vision = facts.vision
    if vision is None:
        is_refused = any("estimator_type" in text and "unsupported" in text for text in facts.texts)
        found = "the autopilot refuses it in words" if is_refused else ""
    else:
        is_fused = facts.autopilot != "px4" or vision.estimator_type in _FUSED_TYPES
        found = "" if is_fused else f"estimator_type {vision.estimator_type}"
    if not found:
        return None
    return found, "VIO (3)", "PX4 takes UNKNOWN, NAIVE, VISION, VIO; MOCAP goes where its EKF does not look"


def _quaternion(facts: Facts) -> Gate | None:
    if facts.vision is not None and facts.vision.norm_error > _MAX_NORM_ERROR:
        off = f"norm off by {facts.vision.norm_error:.1e}"
        return off, "at most 1e-5", "PX4 drops the attitude in silence: normalise it"
    if facts.vision is None and _missing(facts, "heading", 8):
        return "the attitude is dropped", "a quaternion of norm 1, within 1e-5", "Normalise it in double precision"
    return None


@_of_vision
def _quality(vision: SentVision, facts: Facts) -> Gate | None:
    name = "EKF2_EV_QMIN" if facts.autopilot == "px4" else "VISO_QUAL_MIN"
    least = facts.parameters.get(name) or 0.0
    if vision.quality >= max(0.0, least):
        return None
    return f"quality {vision.quality}", f"at least {max(0.0, least):g} ({name})", f"Set {name} to 0 or 1"


@_of_vision
def _covariance(vision: SentVision, facts: Facts) -> Gate | None:
    sigma = vision.position_sigma_m
    if math.isfinite(sigma) and 0.0 < sigma <= _MAX_SIGMA_M:
        return None
    return (
        f"position sigma {sigma:g} m",
        f"finite, above 0, at most {_MAX_SIGMA_M:g} m",
        "The estimate is too weak to fly on: what does the LiDAR see?",
    )


@_of_vision
def _time(vision: SentVision, facts: Facts) -> Gate | None:
    if vision.stamps_forward:
        return None
    return "time_usec stands still or goes back", "each stamp later than the one before", "Send each estimate once"


def _innovation(facts: Facts) -> Gate | None:
    """Ratios are told for what is fused: above 1 for long means that the estimate and the rest disagree."""
    bad = {name: ratio for name, ratio in facts.ratios.items() if math.isfinite(ratio) and ratio > _REJECTED}
    if not bad:
        return None
    told = ", ".join(f"{name} {ratio:.1f}" for name, ratio in sorted(bad.items()))
    return (
        told,
        "test ratios below 1",
        "The measurement disagrees with the rest: a jump without reset_counter, wrong delay, wrong mount or scale",
    )
