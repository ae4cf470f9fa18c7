"""The ground's map and the floor under the start: what noise along the beams must not do to them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.messages import AttitudeSample, RangefinderSample
from companion.odometry import filter as kalman
from companion.odometry import weak
from companion.odometry.attitude import AttitudeBuffer
from companion.odometry.height import HeightTracker
from companion.odometry.height_map import HeightMap
from companion.odometry.level import range_noise_m
from companion.odometry.wall_map import WallMap

SENSOR_UP_M = 0.25
SENSOR = np.array([0.0, 0.0, SENSOR_UP_M])
FLOOR_M = -0.12
NOISE_M = 0.12
RETURNS = 4


def ring(rng: np.random.Generator, elevation_deg: float = 11.25, count: int = 128) -> np.ndarray:
    """(N, 4) block means of one layer that meets the floor all round, from a body that stands on it."""
    azimuth = np.arange(count) * 2 * math.pi / count
    down = math.radians(elevation_deg)
    reach = (SENSOR_UP_M - FLOOR_M) / math.sin(down) + rng.normal(0.0, NOISE_M / math.sqrt(RETURNS), count)
    flat = reach * math.cos(down)
    z = SENSOR_UP_M - reach * math.sin(down)
    return np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), z, np.full(count, RETURNS)])


def standing_map(scans: int = 200) -> HeightMap:
    rng = np.random.default_rng(1)
    ground = HeightMap()
    for _ in range(scans):
        ground.insert(ring(rng), np.zeros(3), SENSOR, NOISE_M, 0.0)
    return ground


def test_a_ring_of_ground_does_not_lean_along_the_beams() -> None:
    ground = standing_map()
    radius = (SENSOR_UP_M - FLOOR_M) / math.tan(math.radians(11.25))
    for off in (-0.3, 0.0, 0.3, 0.6):
        around = np.arange(24) * 2 * math.pi / 24
        known = [ground.height_at((radius + off) * math.cos(a), (radius + off) * math.sin(a)) for a in around]
        heights = [height[0] for height in known if height is not None]
        assert len(heights) > 12
        assert np.mean(heights) == pytest.approx(FLOOR_M, abs=0.004)  # it leaned by 4 cm a metre


def test_the_plane_about_the_start_is_the_floor_there() -> None:
    plane = standing_map().plane_about(0.0, 0.0, 2.5)
    assert plane is not None
    assert plane.z_m == pytest.approx(FLOOR_M, abs=0.003)
    assert plane.rms_m < 0.02


def test_no_plane_is_told_where_ground_was_seen_on_one_side_only() -> None:
    rng = np.random.default_rng(2)
    ground = HeightMap()
    for _ in range(50):
        points = ring(rng)
        ground.insert(points[points[:, 0] > 0.5], np.zeros(3), SENSOR, NOISE_M, 0.0)
    assert ground.plane_about(0.0, 0.0, 2.5) is None


def test_a_rangefinder_cut_off_at_its_least_range_does_not_move_the_floor() -> None:
    rng = np.random.default_rng(3)
    tracker = HeightTracker(SENSOR_UP_M, 0.1)
    for n in range(400):
        reading = 0.12 + rng.normal(0.0, 0.03)
        if reading >= 0.10:  # what is nearer is not sent
            tracker.on_rangefinder(RangefinderSample(t_ns=n * 100_000_000, distance_m=reading))
    assert tracker.floor_m is not None
    assert tracker.floor_m < FLOOR_M - 0.006  # all that the rangefinder knows
    for _ in range(200):
        tracker.ground.insert(ring(rng), np.zeros(3), SENSOR, NOISE_M, 0.0)
    tracker.leave_ground()
    assert tracker.floor_m == pytest.approx(FLOOR_M, abs=0.003)


def test_a_pile_beside_the_start_leaves_the_floor_to_the_rangefinder() -> None:
    rng = np.random.default_rng(4)
    tracker = HeightTracker(SENSOR_UP_M, 0.1)
    for n in range(50):
        tracker.on_rangefinder(RangefinderSample(t_ns=n * 100_000_000, distance_m=0.12))
        points = ring(rng)
        points[:, 2] += np.where(points[:, 0] > 1.0, 0.3, 0.0)
        tracker.ground.insert(points, np.zeros(3), SENSOR, NOISE_M, 0.0)
    tracker.leave_ground()
    assert tracker.floor_m == pytest.approx(-0.12, abs=1e-9)


def test_noise_of_returns_is_told_from_a_layer_with_walls_edges_and_gaps() -> None:
    rng = np.random.default_rng(5)
    azimuth = np.arange(512) * 2 * math.pi / 512
    walls = np.minimum(
        10.0 / np.maximum(np.abs(np.cos(azimuth)), 1e-9), 6.0 / np.maximum(np.abs(np.sin(azimuth)), 1e-9)
    )
    ranges = walls + rng.normal(0.0, NOISE_M, 512)
    ranges[::17] = 0.0
    ranges[100:110] = 2.0
    assert range_noise_m(ranges.astype(np.float32)) == pytest.approx(NOISE_M, rel=0.12)
    assert math.isnan(range_noise_m(np.zeros(512, dtype=np.float32)))


def test_few_noisy_returns_give_planes_that_points_can_have() -> None:
    rng = np.random.default_rng(6)
    for _ in range(200):
        ground = HeightMap()
        points = ring(rng, count=8)
        points[:, :3] *= 1.0 + rng.normal(0.0, 0.1, (8, 1))
        ground.insert(points, np.zeros(3), SENSOR, 0.6, 0.0)
        known = [ground.height_at(x, y) for x, y in points[:, :2]]
        assert all(math.isfinite(height[0]) and height[1] > 0.0 for height in known if height is not None)


def cone_map(seed: int) -> HeightMap:
    """A heap of 4 m with flanks of 34 deg, 12 m ahead, on a level floor, seen well."""
    rng = np.random.default_rng(seed)
    ground = HeightMap()
    for _ in range(40):
        sight = heap(rng, 0.0)
        ground.insert(sight, np.array([0.0, 0.0, 8.0]), np.zeros(3), 0.12, 1e-6)
    return ground


def heap(rng: np.random.Generator, shift_m: float, height_m: float = 4.0) -> np.ndarray:
    """(600, 4) block means of the lower layers, in the levelled frame 8 m up, the body shift_m farther along x than it thinks."""
    xy = rng.uniform([2.0, -10.0], [22.0, 10.0], (600, 2))
    z = np.maximum(height_m - 0.67 * np.hypot(xy[:, 0] - 12.0, xy[:, 1]), 0.0) + 0.03 * rng.standard_normal(600)
    return np.column_stack([xy[:, 0] - shift_m, xy[:, 1], z - 8.0, np.full(600, 4.0)])


def shift_of(ground: HeightMap, points: np.ndarray, axis: tuple[float, float]) -> tuple[float, float]:
    return ground.shift_along(
        points, np.zeros(3), 8.0, WallMap(), np.array(axis), tilt=np.zeros(2), variances=np.array([1e-3, 1e-5, 1e-5]),
        sigma_range_m=0.06, gate_m=0.6, seen_spread_m=8.0,
    )  # fmt: skip


@pytest.mark.parametrize("shift_m", [-0.3, 0.0, 0.2])
def test_a_pile_tells_where_the_body_is_along_a_hall(shift_m: float) -> None:
    moved_m, information = shift_of(cone_map(1), heap(np.random.default_rng(2), shift_m), (1.0, 0.0))
    assert moved_m == pytest.approx(shift_m, abs=0.04)
    assert 1.0 / 0.2**2 < information < 1.0 / 0.005**2


def test_a_level_floor_tells_nothing_of_the_place() -> None:
    rng = np.random.default_rng(3)
    ground = HeightMap()
    for _ in range(40):
        ground.insert(heap(rng, 0.0, height_m=0.0), np.array([0.0, 0.0, 8.0]), np.zeros(3), 0.12, 1e-6)
    moved_m, information = shift_of(ground, heap(rng, 0.3, height_m=0.0), (1.0, 0.0))
    state = kalman.Planar(0, np.zeros(8), np.diag([0.25] * 8))
    held = weak.held_by_ground(state, np.array([1.0, 0.0]), moved_m, information)
    assert abs(held.x[0]) < 0.05


def test_what_the_ground_tells_narrows_that_axis_only_and_is_not_believed_when_it_contradicts() -> None:
    axis = np.array([0.6, 0.8])
    state = kalman.Planar(0, np.zeros(8), np.diag([0.04, 0.04, 0.1, 0.1, 0.1, 0.1, 1e-4, 1e-4]))
    held = weak.held_by_ground(state, axis, 0.2, 2500.0)
    assert axis @ held.x[:2] == pytest.approx(0.2, abs=0.03)
    assert weak.sigma_along(held, axis) < 0.06
    assert weak.sigma_along(held, np.array([-0.8, 0.6])) == pytest.approx(0.2)
    assert weak.held_by_ground(state, axis, 2.0, 2500.0) is state
    assert weak.held_by_ground(state, axis, 0.2, 4.0) is state


def test_a_heap_does_not_lie_lower_in_the_map_than_it_is() -> None:
    """It is round: the mean of a window lies under its middle, and a fit to that held the body lower beside heaps."""
    rng = np.random.default_rng(6)
    ground, far = HeightMap(), np.array([12.0, 0.0, 8.0])
    places = rng.uniform(-7.0, 7.0, (40_000, 2))
    heights = np.maximum(3.5 - 0.7 * np.hypot(places[:, 0], places[:, 1]), 0.0)
    sight = np.column_stack([places, heights]) - far
    ground.insert(np.column_stack([sight, np.full(len(sight), RETURNS)]), far, np.zeros(3), 0.0, 0.0)
    asked = rng.uniform(-4.0, 4.0, (2000, 2))
    radius = np.hypot(asked[:, 0], asked[:, 1])
    flank = asked[(radius > 1.5) & (radius < 4.0)]
    errors = []
    for x, y in flank:
        known = ground.height_at(x, y)
        assert known is not None
        errors.append(known[0] - (3.5 - 0.7 * math.hypot(x, y)))
    assert np.mean(errors) == pytest.approx(0.0, abs=0.003)  # it was -0.022


SCAN_NS = 100_000_000


def flown(tracker: HeightTracker, state: kalman.Vertical, true_z_m: float, scans: int) -> list[kalman.Vertical]:
    """The vertical state after each scan of a body that stays at true_z_m above a floor that the tracker knows; nan: it sees
    none of it."""
    rng, attitude = np.random.default_rng(7), AttitudeBuffer()
    planar = kalman.Planar(0, np.array([5.0, *np.zeros(7)]), np.diag([1e-4] * 8))  # off the start: no rangefinder
    out = []
    for _ in range(scans):
        t_ns = state.t_ns + SCAN_NS
        attitude.add(
            AttitudeSample(t_ns=t_ns, q_ref_body_wxyz=np.array([1.0, 0.0, 0.0, 0.0]), rate_body_radps=np.zeros(3))
        )
        xy = rng.uniform(-8.0, 8.0, (0 if math.isnan(true_z_m) else 400, 2))
        z = 0.03 * rng.standard_normal(len(xy)) - true_z_m
        assert attitude.history is not None
        state, _ = tracker.update(
            np.column_stack([xy, z, np.full(len(xy), 4.0)]), planar, kalman.carry_vertical(state, t_ns),
            attitude.history, WallMap(), 0.12,
        )  # fmt: skip
        out.append(state)
    return out


def tracker_over_floor() -> HeightTracker:
    rng, tracker = np.random.default_rng(8), HeightTracker(SENSOR_UP_M, 0.1)
    xy = rng.uniform(-10.0, 20.0, (20_000, 2))
    tracker.ground.insert(
        np.column_stack([xy, np.full(len(xy), -8.0), np.full(len(xy), 4.0)]), np.array([0.0, 0.0, 8.0]), np.zeros(3),
        0.12, 1e-6,
    )  # fmt: skip
    return tracker


def test_a_height_that_is_found_far_off_is_no_climb() -> None:
    """Read as one, it flew away at 1.8 m/s, out of reach of the ground's map, and the vehicle after it into the roof."""
    tracker = tracker_over_floor()
    states = flown(tracker, kalman.Vertical(SCAN_NS, np.array([9.0, -0.2]), np.diag([0.05**2, 0.2**2])), 8.0, 60)
    assert all(-0.2 < float(s.x[0]) - 8.0 < 1.05 for s in states)
    assert all(abs(float(s.x[0]) - 8.0) < 0.05 for s in states[-20:])


def test_a_height_that_nothing_tells_stays_and_is_told_as_unknown() -> None:
    tracker = tracker_over_floor()
    start = kalman.Vertical(SCAN_NS, np.array([8.0, -1.8]), np.diag([0.01**2, 0.1**2]))
    states = flown(tracker, start, math.nan, 50)
    assert float(states[-1].x[0]) > 8.0 - 1.8 * 0.7
    assert float(states[-1].p[0, 0]) > 1.0


def test_a_jump_of_height_is_told_as_a_restart() -> None:
    tracker = tracker_over_floor()
    jumps = []
    state = kalman.Vertical(SCAN_NS, np.array([9.0, 0.0]), np.diag([0.05**2, 0.2**2]))
    for _ in range(40):
        state = flown(tracker, state, 8.0, 1)[-1]
        jumps.append(tracker.has_jumped)
    assert sum(jumps) == 1


def test_above_the_start_the_rangefinder_alone_tells_a_climb() -> None:
    tracker, attitude = HeightTracker(SENSOR_UP_M, 0.1), AttitudeBuffer()
    for n in range(10):
        tracker.on_rangefinder(RangefinderSample(t_ns=n, distance_m=0.12))
    tracker.is_standing = False
    state = kalman.Vertical(SCAN_NS, np.array([0.0, 0.8]), np.diag([0.02**2, 0.2**2]))
    planar = kalman.Planar(0, np.zeros(8), np.diag([1e-4] * 8))
    for n in range(1, 31):
        t_ns = SCAN_NS * (n + 1)
        attitude.add(
            AttitudeSample(t_ns=t_ns, q_ref_body_wxyz=np.array([1.0, 0.0, 0.0, 0.0]), rate_body_radps=np.zeros(3))
        )
        tracker.on_rangefinder(RangefinderSample(t_ns=t_ns, distance_m=0.12 + 0.08 * n))
        assert attitude.history is not None
        state, _ = tracker.update(
            np.zeros((0, 4)), planar, kalman.carry_vertical(state, t_ns), attitude.history, WallMap(), 0.12
        )
    assert float(state.x[0]) == pytest.approx(2.4, abs=0.05)
    assert float(state.x[1]) == pytest.approx(0.8, abs=0.15)
