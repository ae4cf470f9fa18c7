"""The small machines on their own: heartbeats, obstacles, computer status, time sync, modes, costs."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as m

from companion.config import MavlinkConfig
from companion.mavlink import ardupilot, px4, wire
from companion.mavlink.codec import encode
from companion.mavlink.computer import ComputerStatus
from companion.mavlink.dialect import ModeReport
from companion.mavlink.heartbeats import Heartbeats, SignsOfLife, SystemStatus
from companion.mavlink.px4 import PX4
from companion.mavlink.session import MavlinkSession
from companion.mavlink.timesync import Timesync
from companion.mavlink.vision import pack_odometry
from companion.messages import FlightMode, LandedState, WallRanges
from tests.companion.mavlink.peer import MS, SECOND, attitude, estimate, packer, parse

ALIVE = dict.fromkeys(("t_scan_ns", "t_estimate_ns", "t_setpoint_ns"), 100 * SECOND)


def beats(signs: SignsOfLife, t_ns: int) -> dict[int, int]:
    """component -> system_status of the heartbeats due."""
    return {c: wire.unpack(wire.HEARTBEAT, payload)[4] for c, payload in Heartbeats().poll(signs, t_ns)}


# ---- heartbeats -----------------------------------------------------------------------------------------------------


def test_both_components_beat_once_a_second_as_onboard_controller() -> None:
    """AUTOPILOTS.md: MAV_TYPE_ONBOARD_CONTROLLER, component 191 and 197."""
    session = MavlinkSession(MavlinkConfig())
    sent = []
    for tick in range(1000):
        session.poll(SECOND + tick * 10 * MS)
        sent += parse(session.data_to_send())
    assert len(sent) == 20
    assert {(s.get_srcSystem(), s.get_srcComponent(), s.type, s.autopilot) for s in sent} == {
        (1, 191, 18, 8),
        (1, 197, 18, 8),
    }


@pytest.mark.parametrize("stream", ["t_scan_ns", "t_estimate_ns", "t_setpoint_ns"])
def test_the_companions_heartbeat_stops_when_a_stream_stands_still(stream: str) -> None:
    """AUTOPILOTS.md: a heartbeat that keeps coming from a hung program lies: gate it on scan, estimate and setpoint."""
    signs = SignsOfLife(**ALIVE, quality=90, is_flying_offboard=True)
    now = 100 * SECOND + 100 * MS
    assert beats(signs, now) == {191: 4, 197: 4}
    setattr(signs, stream, now - 1100 * MS)
    assert 191 not in beats(signs, now)


def test_before_the_sensors_start_the_heartbeat_is_sent() -> None:
    assert beats(SignsOfLife(), SECOND) == {191: 4, 197: 3}


def test_when_everything_stands_still_no_component_beats() -> None:
    """AUTOPILOTS.md: "A heartbeat that keeps coming from a hung program lies: gate it on the age of scan, estimate and
    setpoint"."""
    signs = SignsOfLife(**ALIVE, quality=90)
    assert beats(signs, 106 * SECOND) == {}


@pytest.mark.parametrize(
    ("changes", "status"),
    [
        ({}, SystemStatus.ACTIVE),
        ({"is_degenerate": True}, SystemStatus.CRITICAL),
        ({"t_scan_ns": 100 * SECOND - 400 * MS}, SystemStatus.CRITICAL),
        ({"quality": -1}, SystemStatus.FLIGHT_TERMINATION),
        ({"t_estimate_ns": 97 * SECOND}, SystemStatus.FLIGHT_TERMINATION),
    ],
)
def test_the_estimators_heartbeat_says_how_good_it_is(changes: dict[str, int], status: SystemStatus) -> None:
    """AUTOPILOTS.md: 197 ACTIVE, CRITICAL when weak, FLIGHT_TERMINATION when failed."""
    signs = SignsOfLife(**{**ALIVE, "quality": 90, **changes})
    assert beats(signs, 100 * SECOND)[197] == status


# ---- obstacles ------------------------------------------------------------------------------------------------------


def walls(ranges: dict[int, float]) -> WallRanges:
    metres, seen = np.full(360, np.inf), np.zeros(360, dtype=bool)
    for bearing, distance in ranges.items():
        metres[bearing % 360], seen[bearing % 360] = distance, True
    return WallRanges(t_ns=5 * SECOND, front_m=None, right_m=None, ranges_m=metres, is_seen=seen)


def test_obstacles_are_72_sectors_in_cm_clockwise_in_body_frd() -> None:
    """AUTOPILOTS.md: OBSTACLE_DISTANCE: 72 sectors, centimetres, clockwise, MAV_FRAME_BODY_FRD."""
    session = MavlinkSession(MavlinkConfig())
    session.send_wall_ranges(walls({0: 6.0, 2: 5.0, -90: 3.0, 90: 4.0, 45: 80.0}))
    (sent,) = parse(session.data_to_send())
    assert (sent.frame, sent.increment_f, sent.angle_offset, len(sent.distances)) == (12, 5.0, 0.0, 72)
    assert sent.distances[0] == 500, "the nearest of the sector"
    assert sent.distances[18] == 300, "to the right: clockwise"
    assert sent.distances[54] == 400
    assert sent.distances[63] == sent.max_distance + 1 == 5001, "looked at, nothing within reach"
    assert sent.distances[36] == 65535, "not looked at"
    assert sent.time_usec == 5_000_000


@given(st.dictionaries(st.integers(0, 359), st.floats(0.0, 1e6), max_size=360))
def test_no_return_is_lost_between_sectors(ranges: dict[int, float]) -> None:
    session = MavlinkSession(MavlinkConfig())
    session.send_wall_ranges(walls(ranges))
    (sent,) = parse(session.data_to_send())
    nearest = min(ranges.values(), default=1e9)
    if nearest <= 50:
        assert min(sent.distances) == round(nearest * 100)


# ---- computer -------------------------------------------------------------------------------------------------------


def test_computer_status_says_what_it_knows_and_marks_the_rest_unknown() -> None:
    session = MavlinkSession(MavlinkConfig())
    session.send_computer_status(
        ComputerStatus(
            t_ns=7 * SECOND,
            uptime_s=12.5,
            cpu_core_ratios=(0.25, 0.75),
            ram_used_mib=1000,
            ram_total_mib=4000,
            disk_used_mib=10_000,
            disk_total_mib=60_000,
            temperature_c=None,
        )
    )
    (sent,) = parse(session.data_to_send())
    assert sent.get_type() == "ONBOARD_COMPUTER_STATUS"
    assert (sent.uptime, sent.time_usec) == (12_500, 7_000_000)
    assert sent.cpu_cores[:3] == [25, 75, 255]
    assert sent.cpu_combined[0] == 50
    assert (sent.ram_usage, sent.ram_total, sent.storage_usage[0], sent.storage_total[0]) == (1000, 4000, 10000, 60000)
    assert sent.temperature_board == 127


# ---- time sync ------------------------------------------------------------------------------------------------------


def exchange(sync: Timesync, t_ns: int, *, there_ns: int, back_ns: int, offset_ns: int) -> None:
    _, ts1 = sync.ask(t_ns)
    sync.on_message(t_ns + there_ns - offset_ns, ts1, t_ns + there_ns + back_ns)


def test_offset_is_taken_from_the_quickest_exchange() -> None:
    sync = Timesync()
    offset = 1000 * SECOND
    for n in range(20):
        exchange(sync, n * 100 * MS, there_ns=MS, back_ns=(1 + n % 5) * MS, offset_ns=offset)
    assert sync.offset_ns == offset
    assert sync.missing(0) is None


def test_exchanges_slower_than_10_ms_are_not_used() -> None:
    """AUTOPILOTS.md: round trip < 10 ms."""
    sync = Timesync()
    for n in range(20):
        exchange(sync, n * 100 * MS, there_ns=6 * MS, back_ns=6 * MS, offset_ns=0)
    assert sync.good == 0
    assert "20 slower than 10 ms" in str(sync.missing(0))


def test_an_answer_to_a_question_that_we_did_not_ask_is_not_used() -> None:
    sync = Timesync()
    sync.ask(0)
    assert sync.on_message(5, 12345, MS) is None
    assert (sync.good, sync.unasked) == (0, 1)


def test_ten_jumps_of_more_than_100_ms_start_it_anew_and_one_does_not() -> None:
    """AUTOPILOTS.md: a jump > 100 ms ten times resets it."""
    sync = Timesync()
    for n in range(600):
        sync.on_message(0, n, n * 100 * MS)
        exchange(sync, n * 100 * MS, there_ns=MS, back_ns=MS, offset_ns=0)
    exchange(sync, 61 * SECOND, there_ns=MS, back_ns=MS, offset_ns=SECOND)
    assert sync.offset_ns == 0
    assert sync.missing(500) is None
    for n in range(10):
        exchange(sync, 62 * SECOND + n * 100 * MS, there_ns=MS, back_ns=MS, offset_ns=SECOND)
    assert sync.offset_ns == SECOND
    assert sync.missing(500) is not None


@given(st.lists(st.tuples(st.integers(-(2**63), 2**63 - 1), st.integers(-(2**63), 2**63 - 1)), max_size=30))
def test_no_timesync_message_moves_a_stamp_into_the_future(messages: list[tuple[int, int]]) -> None:
    sync = Timesync()
    for n, (tc1, ts1) in enumerate(messages):
        sync.ask(n)
        sync.on_message(tc1, ts1, n)
        assert sync.to_companion(n * 7, n) <= n


# ---- modes ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("main", "sub", "landed", "standard", "mode"),
    [
        (6, 0, 2, None, FlightMode.OFFBOARD),
        (4, 2, 2, None, FlightMode.TAKEOFF),
        (4, 3, 2, None, FlightMode.HOLD),
        (4, 4, 2, None, FlightMode.MISSION),
        (4, 5, 2, None, FlightMode.RETURN),
        (4, 6, 4, None, FlightMode.LAND),
        (4, 6, 2, None, FlightMode.DESCEND),
        (4, 6, 2, 7, FlightMode.LAND),
        (4, 6, 4, 0, FlightMode.DESCEND),
        (4, 6, 1, None, FlightMode.LAND),
        (4, 20, 2, None, FlightMode.DESCEND),  # as a PX4 of August 2026 said it after a loss of vision
        (3, 0, 2, None, FlightMode.MANUAL),
        (1, 0, 2, None, FlightMode.MANUAL),
        (7, 0, 2, None, FlightMode.MANUAL),
        (0, 0, 0, None, FlightMode.UNKNOWN),
    ],
)
def test_px4_mode(main: int, sub: int, landed: int, standard: int | None, mode: FlightMode) -> None:
    """PX4.md 7: DESCEND and AUTO_LAND look alike; landed_state and CURRENT_MODE.standard_mode tell them apart."""
    report = ModeReport(custom_mode=main << 16 | sub << 24, landed_state=LandedState(landed), standard_mode=standard)
    assert px4.decode_mode(report) is mode


@pytest.mark.parametrize(
    ("number", "mode"),
    [
        (0, FlightMode.MANUAL),
        (3, FlightMode.MISSION),
        (4, FlightMode.OFFBOARD),
        (5, FlightMode.MANUAL),
        (6, FlightMode.RETURN),
        (9, FlightMode.LAND),
        (17, FlightMode.HOLD),
        (99, FlightMode.MANUAL),
    ],
)
def test_ardupilot_mode(number: int, mode: FlightMode) -> None:
    report = ModeReport(custom_mode=number, landed_state=LandedState.IN_AIR, standard_mode=None)
    assert ardupilot.decode_mode(report) is mode


@pytest.mark.parametrize(
    ("flags", "valid", "fused"),
    [(229, False, False), (511, True, True), (383, True, True), (127, True, False), (101, False, False)],
)
def test_px4_estimator_flags(flags: int, valid: bool, fused: bool) -> None:
    """The flags of the recorded vision_loss, in order."""
    assert (px4.is_position_valid(flags), px4.is_vision_fused(flags)) == (valid, fused)


@pytest.mark.parametrize(
    ("flags", "fused"), [(0x400, False), (0x000, False), (0x0A7, False), (0x33F, True), (0x025, False)]
)
def test_ardupilot_estimator_flags(flags: int, fused: bool) -> None:
    assert ardupilot.is_vision_fused(flags) is fused
    assert ardupilot.is_position_valid(flags) is fused


# ---- cost -----------------------------------------------------------------------------------------------------------


def best_us(call: object, rounds: int = 30, calls: int = 100) -> float:
    assert callable(call)
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        for _ in range(calls):
            call()
        times.append((time.perf_counter() - start) / calls * 1e6)
    return min(times)


def test_packing_odometry_costs_at_most_60_us() -> None:
    """pymavlink's own costs about 50 us for the packing alone (AUTOPILOTS.md, measured)."""
    sample = estimate(SECOND)

    def call() -> None:
        payload = pack_odometry(sample, PX4, 1_000_000)
        encode(wire.ODOMETRY, payload, system=1, component=197, sequence=0)

    assert best_us(call) <= 60.0


def test_taking_in_an_attitude_costs_at_most_60_us() -> None:
    session = MavlinkSession(MavlinkConfig())
    session.receive(bytes(m.MAVLink_heartbeat_message(2, 12, 29, 0, 3, 3).pack(packer())), 1)
    frames = iter([bytes(attitude(boot_ms).pack(packer())) for boot_ms in range(1, 3100)])
    t_ns = iter(range(MS, 4000 * MS, MS))
    assert best_us(lambda: session.receive(next(frames), next(t_ns))) <= 60.0
