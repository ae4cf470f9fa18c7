"""The gate before arming: each reason says what is missing and what to do about it. What the doctor calls red is red
here too: parameters, sensors, battery and origin are judged by its own checks."""

from __future__ import annotations

import math
from functools import lru_cache

from companion.geometry import wrap_angle, yaw_from_quat
from companion.mavlink.checks import Check, Facts, Verdict, check_battery, check_origin, check_sensors
from companion.mavlink.dialect import Dialect
from companion.mavlink.origin import Origin, OriginState
from companion.mavlink.parameters import Parameters
from companion.mavlink.timesync import Timesync
from companion.mavlink.vehicle import LOST_AGE_NS, Vehicle
from companion.mavlink.vision import Vision
from companion.messages import AttitudeSample

_ATTITUDE_AGE_NS = 300_000_000
_VISION_AGE_NS = 300_000_000
_ESTIMATOR_AGE_NS = 3_000_000_000
_FRAME_TOLERANCE_RAD = math.radians(10.0)  # FAULTS 27


def reasons_not_to_arm(
    *,
    dialect: Dialect | None,
    vehicle: Vehicle,
    origin: Origin,
    timesync: Timesync,
    vision: Vision,
    attitude: AttitudeSample | None,
    parameters: Parameters,
    t_ns: int,
) -> tuple[str, ...]:
    """All that stands against arming; empty when nothing does."""
    if dialect is None or vehicle.t_heartbeat_ns is None:
        return ("link: no heartbeat of a PX4 or ArduPilot yet: check cable, port, baud rate and the system id",)
    reasons = [
        _heartbeat(vehicle, t_ns),
        *parameters.reasons(),
        _origin(origin),
        *_told_by_the_doctor(
            dialect.name,
            origin.confirmed_e7[2] if origin.confirmed_e7 is not None else None,
            vehicle.sensors_present,
            vehicle.sensors_health,
            vehicle.battery_ratio,
        ),
        timesync.missing(dialect.timesync_answers),
        _attitude(vehicle, t_ns),
        _vision_sent(vision, t_ns),
        _vision_fused(dialect, vehicle, t_ns),
        _frames_agree(dialect, vehicle, vision, attitude),
        "autopilot: in failsafe: let it land and clear, or see its own messages" if vehicle.is_failsafe else None,
        "autopilot: its own pre-arm check fails: see its messages" if vehicle.prearm_ok is False else None,
    ]
    return tuple(reason for reason in reasons if reason is not None)


def _heartbeat(vehicle: Vehicle, t_ns: int) -> str | None:
    age_ns = t_ns - (vehicle.t_heartbeat_ns or 0)
    if age_ns <= LOST_AGE_NS:
        return None
    return f"link: the last heartbeat is {age_ns / 1e9:.1f} s old: check the link"


def _origin(origin: Origin) -> str | None:
    if origin.state is OriginState.CONFIRMED:
        return None
    return (
        f"origin: GPS_GLOBAL_ORIGIN has not come back, sent {origin.sent} times: the autopilot's estimator is still "
        "starting, or holds a position without an origin: restart it on the ground"
    )


@lru_cache(maxsize=4)  # asked for at every estimate and setpoint, and seldom another answer
def _told_by_the_doctor(
    autopilot: str, altitude_mm: int | None, present: int | None, health: int | None, battery_ratio: float | None
) -> tuple[str, ...]:
    facts = Facts(
        autopilot=autopilot,
        has_origin=None if altitude_mm is None else True,
        origin_altitude_m=None if altitude_mm is None else altitude_mm / 1e3,
        sensors_present=present,
        sensors_health=health,
        battery_ratio=battery_ratio,
    )
    return in_words([*check_origin(facts), *check_sensors(facts), *check_battery(facts)])


def in_words(checks: list[Check]) -> tuple[str, ...]:
    """Each red line as a reason not to arm."""
    red = [check for check in checks if check.verdict is Verdict.FAIL]
    return tuple(
        f"{c.name}: {c.actual}" + (f", expected {c.expected}" if c.expected else "") + f": {c.mend}" for c in red
    )


def _attitude(vehicle: Vehicle, t_ns: int) -> str | None:
    if vehicle.t_attitude_ns is not None and t_ns - vehicle.t_attitude_ns <= _ATTITUDE_AGE_NS:
        return None
    return "attitude: ATTITUDE_QUATERNION does not stream: is SET_MESSAGE_INTERVAL refused, the link too slow?"


def _vision_sent(vision: Vision, t_ns: int) -> str | None:
    if vision.t_sent_ns is not None and t_ns - vision.t_sent_ns <= _VISION_AGE_NS:
        return None
    why = ", ".join(f"{reason} {count}" for reason, count in sorted(vision.refused.items()))
    return f"vision: no ODOMETRY leaves: is the LiDAR running, the registration good? held back: {why or 'none'}"


def _vision_fused(dialect: Dialect, vehicle: Vehicle, t_ns: int) -> str | None:
    if vehicle.estimator_flags is None or vehicle.t_estimator_ns is None:
        return "estimator: no status report yet: is its stream refused?"
    if t_ns - vehicle.t_estimator_ns > _ESTIMATOR_AGE_NS:
        return "estimator: its status report has stopped"
    if dialect.is_vision_fused(vehicle.estimator_flags):
        return None
    return (
        f"fusion: the autopilot does not use the vision (flags 0x{vehicle.estimator_flags:03x}): "
        "run `stockpilot doctor`, it names the gate"
    )


def _frames_agree(dialect: Dialect, vehicle: Vehicle, vision: Vision, attitude: AttitudeSample | None) -> str | None:
    """Fused, the autopilot's attitude is the estimate's: else a frame or a mount is wrong."""
    estimate = vision.newest
    flags = vehicle.estimator_flags
    if estimate is None or attitude is None or flags is None or not dialect.is_vision_fused(flags):
        return None
    ours, theirs = estimate.q_map_body_wxyz, attitude.q_ref_body_wxyz
    along = abs(sum(a * b for a, b in zip(ours.tolist(), theirs.tolist(), strict=True)))
    whole = 2.0 * math.acos(min(1.0, along))
    if whole <= _FRAME_TOLERANCE_RAD:
        return None
    yaw = abs(wrap_angle(yaw_from_quat(ours) - yaw_from_quat(theirs)))
    return (
        f"frames: estimate and autopilot disagree by {math.degrees(whole):.0f} deg "
        f"({math.degrees(yaw):.0f} in heading; 10 allowed): is the LiDAR mounted as the mission file says?"
    )
