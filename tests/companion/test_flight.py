"""What the flight core itself decides; its stages have tests of their own."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import replace

import pytest

from companion.config import CompanionConfig
from companion.flight import Flight
from companion.mavlink import wire
from companion.mavlink.computer import ComputerStatus
from companion.messages import Event, LidarScan, OdometryEstimate
from companion.odometry import ScanResult
from companion.odometry.turned import TurnedBy
from companion.recording.replay import Replay
from companion.topics import EVENT, Topic
from tests.companion.recording.corner import recorded

ODOMETRY = wire.ODOMETRY.to_bytes(3, "little")  # as in a MAVLink 2 header

MS = 1_000_000


def status(free_gib: float) -> ComputerStatus:
    total = 100 * 1024
    return ComputerStatus(
        t_ns=MS, uptime_s=1.0, cpu_core_ratios=(), ram_used_mib=1, ram_total_mib=2,
        disk_used_mib=total - round(free_gib * 1024), disk_total_mib=total, temperature_c=None,
    )  # fmt: skip


@pytest.mark.parametrize(("free_gib", "is_refused"), [(1.9, True), (2.1, False)])
def test_a_disk_that_is_nearly_full_stands_against_arming(free_gib: float, is_refused: bool) -> None:
    """FAULTS 21: free space at arming. Issue 4: what the doctor calls red means no arming."""
    told: list[str] = []

    def tap(topic: Topic, t_ns: int, message: object) -> None:
        if topic is EVENT and isinstance(message, Event):
            told.append(message.text)

    flight = Flight(CompanionConfig(), tap=tap)
    flight.on_computer(status(free_gib))
    for n in range(1, 20):
        flight.poll(n * 50 * MS)
    (why,) = [text for text in told if text.startswith("not ready")]
    assert ("computer.disk" in why) is is_refused


def test_without_a_recording_the_disk_may_be_full() -> None:
    flight = Flight(CompanionConfig.model_validate({"recording": {"enabled": False}}))
    flight.on_computer(status(0.0))
    assert flight._computer_not_ready == ()


def odometry_sent(*, lands_blind: bool, jumps: bool) -> int:
    """How many estimates a recorded flight sends, were it landing for want of a position from its 100th step on and were its
    place found anew at the 200th estimate."""
    flight, inputs = recorded()
    steps, predictions = itertools.count(), itertools.count()
    step, predict = flight.navigator.step, flight.odometry.predict
    flight.navigator.step = lambda t, i: replace(step(t, i), lands_blind=lands_blind and next(steps) > 100)  # type: ignore[method-assign]

    def predicted(t_ns: int) -> OdometryEstimate | None:
        estimate = predict(t_ns)
        if estimate is None or not jumps or next(predictions) < 200:
            return estimate
        return replace(estimate, reset_counter=estimate.reset_counter + 1)

    flight.odometry.predict = predicted  # type: ignore[method-assign]
    replay = Replay(flight)
    replay.run(inputs)
    return sum(frame[7:10] == ODOMETRY for _, frame in replay.frames)


def test_a_place_found_anew_in_a_blind_landing_is_not_told_to_the_flight_controller() -> None:
    """It flew after a false one at 18 m/s, into the end wall of a hall of 120 m."""
    usual = odometry_sent(lands_blind=False, jumps=True)
    assert usual > 300
    assert odometry_sent(lands_blind=True, jumps=False) == usual
    assert 100 < odometry_sent(lands_blind=True, jumps=True) < usual - 100


def flown_with(changes: dict[str, object]) -> Flight:
    """A recorded flight, with these in each result of the odometry."""
    flight, inputs = recorded()
    begin = flight.odometry.begin

    def begun(scan: LidarScan) -> Callable[[], ScanResult | None]:
        process = begin(scan)

        def processed() -> ScanResult | None:
            result = process()
            return None if result is None else replace(result, **changes)  # type: ignore[arg-type]

        return processed

    flight.odometry.begin = begun  # type: ignore[method-assign]
    Replay(flight).run(inputs)
    return flight


@pytest.mark.parametrize(("pitch_deg", "is_told"), [(8.0, True), (5.0, False)])
def test_a_lidar_that_leans_by_more_than_is_corrected_is_told_once_and_beside_the_volume(
    pitch_deg: float, is_told: bool
) -> None:
    flight = flown_with({"tilt_offset_rad": (0.0, -math.radians(pitch_deg))})
    assert [e.name for e in flight.events].count("lidar_leans") == is_told
    assert any("check lidar.mount_rpy_deg and fly again" in w for w in flight.measure().warnings) is is_told


@pytest.mark.parametrize(
    ("angle_deg", "sigma_deg", "is_told"), [(2.0, 0.4, True), (2.0, 0.8, False), (0.9, 0.2, False)]
)
def test_a_lidar_that_sits_turned_is_told_once_and_beside_the_volume(
    angle_deg: float, sigma_deg: float, is_told: bool
) -> None:
    flight = flown_with({"lidar_turned_by": TurnedBy(math.radians(angle_deg), math.radians(sigma_deg))})
    assert [e.text for e in flight.events if e.name == "lidar_turned"] == [
        "LiDAR is turned by +2.0 deg about the vertical"
    ] * is_told
    assert any("correct the yaw of lidar.mount_rpy_deg by +2.0" in w for w in flight.measure().warnings) is is_told
