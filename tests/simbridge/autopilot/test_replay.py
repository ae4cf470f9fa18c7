"""The referee: real PX4's recorded conversations. Same input, same modes, answers, texts and failsafes, within named tolerances.

How the vehicle moves meanwhile, and what therefore cannot be compared, is told in `replay`.
"""

from __future__ import annotations

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import development as dialect

from simbridge.autopilot.timesync import TimeSync
from tests.simbridge.autopilot.replay import (
    FLIGHT_PARAMS,
    Conversation,
    Event,
    all_of,
    changes,
    event_ids,
    modes,
)

# Tolerances, s: half a period or more of the stream that shows it, plus what the detectors behind it differ by.
HEARTBEAT_S = 1.1  # 1 Hz, and its phase
LANDED_STATE_S = 0.6  # 2 Hz
CURRENT_MODE_S = 2.1  # 0.5 Hz
ESTIMATOR_FLAGS_S = 0.35  # 2 Hz, 5 Hz in wrong_input
ACK_S = 0.05
FAILSAFE_S = 0.15  # the commander looks ten times a second
DISARM_S = 0.6
TEXT_S = 0.6
SETTLED_S = 2.5  # what is shown before the streams are lowered is boot

FLIGHTS = ("ev_offboard", "setpoint_loss", "vision_loss", "origin_altitude")
STREAMS = (
    ("HEARTBEAT", ("base_mode", "custom_mode", "system_status"), HEARTBEAT_S),
    ("EXTENDED_SYS_STATE", ("landed_state",), LANDED_STATE_S),
    ("CURRENT_MODE", ("standard_mode", "custom_mode", "intended_custom_mode"), CURRENT_MODE_S),
    ("ESTIMATOR_STATUS", ("flags",), ESTIMATOR_FLAGS_S),
)
_runs: dict[str, tuple[Conversation, list[Event]]] = {}


def run(name: str) -> tuple[Conversation, list[Event]]:
    """One replay, shared by the tests of it."""
    if name not in _runs:
        conversation = Conversation(name)
        if name == "handshake":
            params: dict[str, float] = {"EKF2_EV_CTRL": 15, "EKF2_HGT_REF": 3, "COM_RC_IN_MODE": 1}
            out, _ = conversation.run(params, _vision_instead_of_gps(conversation.end_ns))
        else:
            out, _ = conversation.run(FLIGHT_PARAMS)
        _runs[name] = conversation, out
    return _runs[name]


def _vision_instead_of_gps(end_ns: int) -> list[tuple[int, str, bytes]]:
    """`handshake` was recorded with a GPS, which the emulation lacks: its position comes as vision on the other link."""
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=197)
    origin = dialect.MAVLink_set_gps_global_origin_message(1, 473977432, 85455942, 0)
    out = [(500_000_000, "gcs", bytes(origin.pack(mav)))]
    variances = [0.01 if i in (0, 6, 11, 15, 18, 20) else 0.0 for i in range(21)]
    for t in range(600_000_000, end_ns, 33_000_000):
        still = dialect.MAVLink_odometry_message(
            t // 1000, 1, 12, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0, 0, 0, 0, variances, variances, 0, 3, 100
        )
        out.append((t, "gcs", bytes(still.pack(mav))))
    return out


def _lasting(rows: list[tuple[float, Any]], end_s: float) -> list[tuple[float, Any]]:
    """Without states that the stream showed once only because its phase met a moment in between."""
    kept: list[tuple[float, Any]] = []
    for i, (t, value) in enumerate(rows):
        until = rows[i + 1][0] if i + 1 < len(rows) else end_s + 9.0
        if until - t > 1.05 or i == 0:
            kept.append((t, value))
    return kept


@pytest.mark.parametrize("flight", FLIGHTS)
@pytest.mark.parametrize(("stream", "fields", "tolerance_s"), STREAMS, ids=[s[0] for s in STREAMS])
def test_states_change_as_recorded(flight: str, stream: str, fields: tuple[str, ...], tolerance_s: float) -> None:
    conversation, out = run(flight)
    end = conversation.recorded[-1][0]
    recorded = _lasting(changes(conversation.recorded, stream, *fields, after_s=SETTLED_S), end)
    emulated = _lasting(changes(out, stream, *fields, after_s=SETTLED_S), end)
    assert [v for _, v in emulated] == [v for _, v in recorded]
    for (t_emulated, value), (t_recorded, _) in zip(emulated[1:], recorded[1:], strict=True):
        assert abs(t_emulated - t_recorded) <= tolerance_s, f"{stream} {value}"


@pytest.mark.parametrize("flight", FLIGHTS)
def test_every_command_of_a_flight_is_answered_as_recorded(flight: str) -> None:
    conversation, out = run(flight)
    # 211 is PX4's own broadcast to a gripper, which its link answers itself
    recorded = [(t, m) for t, m in all_of(conversation.recorded, "COMMAND_ACK") if m.command != 211]
    emulated = all_of(out, "COMMAND_ACK")
    assert [(m.command, m.result) for _, m in emulated] == [(m.command, m.result) for _, m in recorded]
    assert max(abs(a - b) for (a, _), (b, _) in zip(emulated, recorded, strict=True)) <= ACK_S


def test_lost_setpoints_land_the_vehicle_when_px4_did() -> None:
    _, out = run("setpoint_loss")
    times = {name: t for t, name in modes(out)}
    assert abs(times["LAND"] - 79.53) <= FAILSAFE_S
    assert abs(modes(out)[-1][0] - 88.8) <= DISARM_S


def test_lost_vision_ends_in_descend_when_px4_did() -> None:
    _, out = run("vision_loss")
    assert [name for _, name in modes(out)] == ["LOITER", "OFFBOARD", "DESCEND", "OFFBOARD"]
    times = {name: t for t, name in modes(out)}
    assert abs(times["DESCEND"] - 86.53) <= FAILSAFE_S
    assert abs(modes(out)[-1][0] - 94.57) <= DISARM_S


EVENTS = {
    26266355: ("armed", 0.05),
    21054825: ("take-off detected", 0.3),
    31382480: ("failsafe", FAILSAFE_S),
    29547634: ("failsafe, autopilot disengaged", FAILSAFE_S),
    26622124: ("landing detected", DISARM_S),
    32794487: ("disarmed", DISARM_S),
}


@pytest.mark.parametrize("flight", ["ev_offboard", "setpoint_loss", "vision_loss"])
def test_events_say_what_px4s_said_when_it_said_it(flight: str) -> None:
    conversation, out = run(flight)
    recorded = [row for row in event_ids(conversation.recorded) if row[1] in EVENTS]
    emulated = [row for row in event_ids(out) if row[1] in EVENTS]
    assert [row[1:] for row in emulated] == [row[1:] for row in recorded]
    for (t_emulated, number, _), (t_recorded, _, _) in zip(emulated, recorded, strict=True):
        name, tolerance_s = EVENTS[number]
        assert abs(t_emulated - t_recorded) <= tolerance_s, name


def test_between_origin_and_vision_the_position_reads_as_recorded() -> None:
    conversation, out = run("ev_offboard")
    for events in (conversation.recorded, out):
        at = [m for t, m in all_of(events, "LOCAL_POSITION_NED") if 10.0 < t < 47.0]
        assert all(abs(m.x + 5227321.0) <= 1.0 and abs(m.y + 1067128.125) <= 1.0 for m in at)  # float32 steps of 0.5 m


def test_the_position_is_the_recorded_one_in_flight() -> None:
    conversation, out = run("ev_offboard")
    emulated = [(t, m) for t, m in all_of(out, "LOCAL_POSITION_NED") if 60.0 < t < 103.0]
    recorded = [(t, m) for t, m in all_of(conversation.recorded, "LOCAL_POSITION_NED") if 59.5 < t < 103.5]
    for t, m in emulated[::10]:
        near = min(recorded, key=lambda row: abs(row[0] - t))[1]
        assert math.dist((m.x, m.y, m.z), (near.x, near.y, near.z)) < 0.2  # 0.1 s apart at 0.5 m/s, and PX4's own error


def test_an_origin_with_altitude_lifts_the_local_height_as_recorded() -> None:
    conversation, out = run("origin_altitude")
    for events in (conversation.recorded, out):
        heights = {round(t): m.z for t, m in all_of(events, "LOCAL_POSITION_NED")}
        assert abs(heights[40]) < 0.1
        assert abs(heights[50] - 489.4) < 0.1
        altitude = [m.alt / 1000 for t, m in all_of(events, "GLOBAL_POSITION_INT") if t > 64.0][-1]
        assert 2.5 < altitude < 3.5


def test_px4s_clock_offset_is_used_from_the_fifty_second_on() -> None:
    conversation = Conversation("ev_offboard")
    answers = [(t, m) for t, _, m in conversation.to_fc if m is not None and m.get_type() == "TIMESYNC" and m.tc1 != 0]
    sync = TimeSync()
    converged_s = 0.0
    for t, m in answers:
        sync.answer(m.ts1, m.tc1, t)
        if sync.converged:
            converged_s = t / 1e9 - conversation.offset_s
            break
    assert abs(converged_s - 50.0) < 0.15  # its log: 50.0
    assert abs(sync.stamp(answers[-1][1].tc1, 0) - answers[-1][1].ts1) < 4_000_000


# wrong_input


@pytest.mark.parametrize(
    ("stream", "fields", "tolerance_s"), [STREAMS[0], STREAMS[3]], ids=["HEARTBEAT", "ESTIMATOR_STATUS"]
)
def test_wrong_input_changes_what_it_changed_in_px4(stream: str, fields: tuple[str, ...], tolerance_s: float) -> None:
    conversation, out = run("wrong_input")
    recorded = changes(conversation.recorded, stream, *fields, after_s=SETTLED_S)
    emulated = changes(out, stream, *fields, after_s=SETTLED_S)
    assert [v for _, v in emulated] == [v for _, v in recorded]
    for (t_emulated, value), (t_recorded, _) in zip(emulated[1:], recorded[1:], strict=True):
        assert abs(t_emulated - t_recorded) <= tolerance_s, f"{stream} {value}"


def test_texts_about_wrong_input_are_px4s_own() -> None:
    conversation, out = run("wrong_input")

    def texts(events: list[Event]) -> list[tuple[float, int, str, int]]:
        rows = [(t, m.severity, m.text, m.chunk_seq) for t, m in all_of(events, "STATUSTEXT")]
        return [row for row in rows if not row[2].startswith("[logger]")]  # the emulation keeps no log

    recorded, emulated = texts(conversation.recorded), texts(out)
    odometry = [len([row for row in rows if "estimator_type" in row[2]]) for rows in (recorded, emulated)]
    assert abs(odometry[0] - odometry[1]) <= 3  # 78 of about 105: they leave at 20 Hz and the queue is short
    others = [[row for row in rows if "estimator_type" not in row[2]] for rows in (recorded, emulated)]
    assert [row[1:] for row in others[1]] == [row[1:] for row in others[0]]
    assert max(abs(a[0] - b[0]) for a, b in zip(*others, strict=True)) <= TEXT_S


CASES = {
    "correct": (6.0, 10.3),
    "estimator LIDAR": (11.6, 14.0),
    "estimator MOCAP": (17.2, 19.5),
    "frame_id 14": (22.6, 25.3),
    "quaternion norm 1.001": (28.1, 31.0),
    "quaternion norm 1.000005": (33.6, 36.5),
    "child_frame_id 14": (39.2, 42.0),
    "quality -1": (44.6, 47.5),
}


@pytest.mark.parametrize("case", CASES)
def test_each_kind_of_wrong_vision_stops_the_same_sources_as_in_px4(case: str) -> None:
    conversation, out = run("wrong_input")
    begin, end = CASES[case]

    def fused(events: list[Event]) -> dict[str, bool]:
        rows = [m for t, m in all_of(events, "ESTIMATOR_STATUS") if begin < t < end]
        names = ("vel_ratio", "pos_horiz_ratio", "mag_ratio")  # mag_ratio: heading, here that of vision
        return {name: all(math.isfinite(getattr(m, name)) for m in rows) for name in names}

    assert fused(out) == fused(conversation.recorded)


# handshake

NOT_EMULATED = {397}  # COMPONENT_METADATA: the emulation has no files to describe, and denies it


def _answers(events: list[Event], name: str) -> list[tuple[Any, ...]]:
    picks = {
        "COMMAND_ACK": ("command", "result", "target_system", "target_component"),
        "MESSAGE_INTERVAL": ("message_id", "interval_us"),
        "PARAM_ERROR": ("param_id", "error"),
        "MISSION_REQUEST_INT": ("seq", "target_system", "target_component"),
        "MISSION_COUNT": ("count", "target_system", "target_component"),
        "MISSION_ACK": ("type", "target_system", "target_component"),
        "MISSION_ITEM_INT": ("seq", "frame", "command", "current", "autocontinue", "param1", "param2", "x", "y", "z"),
        "STATUSTEXT": ("severity", "text", "id", "chunk_seq"),
        "AUTOPILOT_VERSION": ("capabilities", "flight_sw_version"),
    }[name]
    return [tuple(getattr(m, f) for f in picks) for _, m in all_of(events, name)]


@pytest.mark.parametrize(
    "name",
    ["MESSAGE_INTERVAL", "PARAM_ERROR", "MISSION_REQUEST_INT", "MISSION_COUNT", "MISSION_ACK", "MISSION_ITEM_INT",
     "STATUSTEXT", "AUTOPILOT_VERSION"],
)  # fmt: skip
def test_the_handshake_is_answered_in_px4s_words(name: str) -> None:
    conversation, out = run("handshake")
    assert _answers(out, name) == _answers(conversation.recorded, name)


def test_the_handshakes_commands_have_px4s_results() -> None:
    conversation, out = run("handshake")
    recorded = [a for a in _answers(conversation.recorded, "COMMAND_ACK") if a[0] != 211]
    emulated = _answers(out, "COMMAND_ACK")
    # the emulation answers in order; PX4 answered two of them (31014 as COMMAND_INT and REQUEST_MESSAGE 397) a little later
    assert len(emulated) == len(recorded)
    differ = [(a, b) for a, b in zip(emulated, recorded, strict=True) if a != b]
    assert all(a[0] == 512 and (a[1], b[1]) == (2, 0) for a, b in differ)
    assert len(differ) == len(NOT_EMULATED)


def test_the_handshakes_modes_and_arming_are_px4s() -> None:
    conversation, out = run("handshake")
    fields = ("base_mode", "custom_mode", "system_status")
    recorded = changes(conversation.recorded, "HEARTBEAT", *fields, after_s=5.0)
    emulated = changes(out, "HEARTBEAT", *fields, after_s=5.0)
    assert [v for _, v in emulated] == [v for _, v in recorded]
    assert max(abs(a - b) for (a, _), (b, _) in zip(emulated[1:], recorded[1:], strict=True)) <= HEARTBEAT_S


def test_all_parameters_arrive_with_hash_and_without_gap() -> None:
    _, out = run("handshake")
    values = [m for t, m in all_of(out, "PARAM_VALUE") if 1.8 < t < 2.7]
    count = values[0].param_count
    assert sorted(m.param_index for m in values) == [*range(count), 65535]
    assert next(m for m in values if m.param_index == 65535).param_id == "_HASH_CHECK"


def test_a_parameter_is_set_answered_and_told_again() -> None:
    conversation, out = run("handshake")

    def told(events: list[Event]) -> list[tuple[str, float, int]]:
        return [(m.param_id, m.param_value, m.param_type) for t, m in all_of(events, "PARAM_VALUE") if 4.0 < t < 5.0]

    assert told(out) == told(conversation.recorded)


def test_a_companion_alone_gets_no_text() -> None:
    _, out = run("handshake")
    first = min(t for t, _ in all_of(out, "STATUSTEXT"))
    assert abs(first - 15.38) < 0.1  # when the ground station's heartbeat began
