"""The ground's map and the floor under the start: what noise along the beams must not do to them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.messages import RangefinderSample
from companion.odometry.height import HeightTracker
from companion.odometry.height_map import HeightMap
from companion.odometry.level import range_noise_m

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
    tracker = HeightTracker(SENSOR_UP_M)
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
    tracker = HeightTracker(SENSOR_UP_M)
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
