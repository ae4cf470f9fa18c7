"""The emulated autopilot flies the vehicle on vision made from truth, within the figures that real PX4 flew it with.

Bounds: the table of flights in shared/VEHICLE.md (column PX4 F1), loosely.
"""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from tests.simbridge.autopilot.rig import Rig, S

HEIGHT_M = 3.0


@pytest.fixture(scope="module")
def flown() -> Rig:
    """Arm, climb, hold, fly a square by velocity, hold, land. Marks of time are in `marks`."""
    rig = Rig()
    rig.takeoff(HEIGHT_M)
    rig.marks = {"hold": rig.t_s}  # type: ignore[attr-defined]
    rig.fly(6.0)
    rig.marks["square"] = rig.t_s  # type: ignore[attr-defined]
    for north, east in ((3.0, 0.0), (3.0, 3.0), (0.0, 3.0), (0.0, 0.0)):

        def toward(north: float = north, east: float = east) -> tuple[int, int, list[float]]:
            error = np.array([north, east]) - rig.autopilot.ekf.o[7:9]
            v = error * min(0.5 / max(float(np.hypot(*error)), 1e-9), 1.0)
            return (1, 0x9C7, [0.0, 0.0, 0.0, float(v[0]), float(v[1]), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])

        rig.stream(toward)
        rig.until(lambda n=north, e=east: math.hypot(rig.position_ned()[0] - n, rig.position_ned()[1] - e) < 0.2, 20.0)  # type: ignore[misc]
    rig.marks["land"] = rig.t_s  # type: ignore[attr-defined]
    assert rig.mode(4, 6) == 0
    rig.stream(None)
    rig.until(lambda: not rig.autopilot.commander.is_armed, 20.0)
    rig.marks["disarmed"] = rig.t_s  # type: ignore[attr-defined]
    return rig


def _truth(rig: Rig, begin: float, end: float) -> np.ndarray:
    return np.array([row for t, row in rig.log if begin <= t <= end])


def test_it_flies_a_square_and_lands_where_the_square_ends(flown: Rig) -> None:
    assert np.hypot(*flown.position_ned()[:2]) < 0.4
    assert abs(flown.position_ned()[2]) < 0.05


def test_a_hold_by_zero_velocity_stays_within_centimetres(flown: Rig) -> None:
    begin = flown.marks["hold"]  # type: ignore[attr-defined]
    rows = _truth(flown, begin, begin + 6.0)
    rms = float(np.sqrt(np.mean(np.sum((rows[:, :2] - rows[:, :2].mean(axis=0)) ** 2, axis=1))))
    assert rms < 0.05  # recorded 1.1 cm, and 3.2 cm of drift
    assert float(np.abs(rows[:, 2] + HEIGHT_M).max()) < 0.2


def test_the_climb_does_not_overshoot(flown: Rig) -> None:
    rows = _truth(flown, 0.0, flown.marks["square"])  # type: ignore[attr-defined]
    assert rows[:, 2].min() > -(HEIGHT_M + 0.1)


def test_height_holds_along_the_square(flown: Rig) -> None:
    rows = _truth(flown, flown.marks["square"], flown.marks["land"])  # type: ignore[attr-defined]
    assert float(np.ptp(rows[:, 2])) < 0.15


def test_landing_takes_the_time_that_the_landing_speed_gives(flown: Rig) -> None:
    seconds = flown.marks["disarmed"] - flown.marks["land"]  # type: ignore[attr-defined]
    assert 6.5 < seconds < 10.0  # recorded 9.3 s from 4 m, so 7.9 s from 3 m
    rows = _truth(flown, flown.marks["land"], flown.marks["disarmed"])  # type: ignore[attr-defined]
    assert 0.65 < rows[:, 5].max() < 0.9  # recorded peak 0.75 m/s


def test_the_heartbeat_tells_each_phase(flown: Rig) -> None:
    seen = [(m.base_mode, m.custom_mode, m.system_status) for _, m in flown.messages("HEARTBEAT")]
    order = [s for i, s in enumerate(seen) if i == 0 or s != seen[i - 1]]
    expected = [(29, 0x3040000, 0), (29, 0x3040000, 3), (145, 0x60000, 4), (157, 0x6040000, 4)]
    assert [s for s in order if s in expected] == expected


def test_frames_of_a_flight_have_no_gap_in_their_sequence(flown: Rig) -> None:
    numbers = [frame[4] for _, frame in flown.frames]
    assert all((b - a) % 256 == 1 for a, b in itertools.pairwise(numbers))


def test_it_stops_within_a_third_of_a_metre_and_turns_as_px4_does() -> None:
    rig = Rig(seed=2)
    rig.takeoff(2.0)
    rig.body_velocity(0.43, 0.0, 0.0, 0.0)
    rig.fly(8.0)
    speeds = np.array([row[3] for t, row in rig.log if t > rig.t_s - 4.0])
    assert abs(speeds.mean() - 0.43) < 0.03
    at = rig.position_ned()[0]
    rig.body_velocity(0.0, 0.0, 0.0, 0.0)
    rig.fly(3.0)
    peak = max(row[0] for t, row in rig.log if t > rig.t_s - 3.0)
    assert 0.15 < peak - at < 0.40  # recorded 0.27 m
    before = rig.yaw()
    rig.body_velocity(0.0, 0.0, 0.0, math.radians(20.0))
    rig.fly(4.5)
    rig.body_velocity(0.0, 0.0, 0.0, 0.0)
    begin = rig.t_ns
    rig.fly(4.0)
    turned = [math.degrees(row[6] - before) for t, row in rig.log if t * S > begin]
    assert 86.0 < turned[-1] < 94.0  # recorded 90.6 to 91.0 settled
    assert max(turned) < 97.0  # recorded peak 93.2 to 93.5
