"""Levelling, motion compensation, and what the navigator steers by."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from companion.config import LidarConfig
from companion.messages import AttitudeSample, LidarScan
from companion.odometry.attitude import HISTORY, STORE, AttitudeBuffer
from companion.odometry.level import Leveller, block_means
from companion.odometry.ranges import wall_ranges
from tests.companion.odometry.hall import Hall, Noise, Track, lidar_geometry, rectangle, stream

HALL = Hall([rectangle(40, 25)])
EXACT = Noise(0.0, 0.0, (0.0, 0.0), 0.0, 0.0, 0.0, 0.0)


def _last_scan(
    velocity: tuple[float, float, float], yaw_rate: float, roll: float, pitch: float, mount=(0.1, -0.05, 0.08)
):
    t = np.arange(60) * 0.02
    position = np.array([15.0, 10.0, 6.0]) + t[:, None] * velocity
    rpy = np.stack((np.full(60, roll), np.full(60, pitch), 0.5 + yaw_rate * t), axis=1)
    track = Track(t, position, rpy)
    buffer = AttitudeBuffer()
    scans = []
    for m in stream(HALL, track, lidar_geometry(), EXACT, 0, mount_m=mount):
        if isinstance(m, AttitudeSample):
            buffer.add(m)
        elif isinstance(m, LidarScan):
            scans.append(m)
    assert buffer.history is not None
    return scans[-1], buffer.history, track


@pytest.mark.parametrize(
    ("velocity", "yaw_rate", "roll", "pitch"),
    [
        ((0.0, 0.0, 0.0), 0.0, 0.0, 0.0),
        ((0.0, 0.0, 0.0), 0.0, 0.05, -0.04),
        ((0.5, 0.2, 0.0), 0.0, 0.0, 0.0),
        ((0.0, 0.0, 0.8), math.radians(20.0), 0.0, 0.0),
        ((0.4, -0.3, 0.5), math.radians(-20.0), -0.06, 0.03),
    ],
)
def test_levelled_points_lie_on_what_they_hit(velocity, yaw_rate: float, roll: float, pitch: float) -> None:
    cfg = LidarConfig(mount_position_m=(0.1, -0.05, 0.08))
    scan, history, track = _last_scan(velocity, yaw_rate, roll, pitch)
    position, rpy = track.at(np.array([scan.t_ns * 1e-9]))
    yaw = rpy[0, 2]
    c, s = math.cos(yaw), math.sin(yaw)
    v = np.array(velocity)
    levelled, _ = Leveller(cfg).level(scan, history, np.array([c * v[0] + s * v[1], -s * v[0] + c * v[1], v[2]]))
    p = levelled.points_level
    world = np.stack((c * p[:, 0] - s * p[:, 1], s * p[:, 0] + c * p[:, 1], p[:, 2]), axis=1) + position[0]
    off = np.min(
        np.abs([world[:, 0], world[:, 0] - 40, world[:, 1], world[:, 1] - 25, world[:, 2], world[:, 2] - 15]), axis=0
    )
    assert len(p) > 2000
    assert off.max() < 2e-3


def test_without_compensation_a_moving_scan_would_be_off_by_centimetres() -> None:
    """Guards the test above against passing for want of motion."""
    scan, history, _ = _last_scan((0.5, 0.2, 0.0), math.radians(20.0), 0.0, 0.0)
    good, _ = Leveller(LidarConfig()).level(scan, history, np.array([0.5, 0.0, 0.0]))
    bad, _ = Leveller(LidarConfig()).level(scan, history, np.zeros(3))
    assert np.abs(good.points_level - bad.points_level).max() > 0.04


def test_returns_too_near_or_too_far_are_left_out_of_the_levelled_scan_but_not_of_the_obstacle_ranges() -> None:
    scan, history, _ = _last_scan((0.0, 0.0, 0.0), 0.0, 0.0, 0.0)
    ranges = scan.range_m.copy()
    ahead = 256  # column that looks forward
    ranges[0, ahead] = 0.2
    near = LidarScan(
        t_ns=scan.t_ns,
        frame_id=scan.frame_id,
        t_column_ns=scan.t_column_ns,
        range_m=ranges,
        signal=scan.signal,
        column_valid=scan.column_valid,
        geometry=scan.geometry,
    )
    levelled, every = Leveller(LidarConfig()).level(near, history, np.zeros(3))
    assert levelled.range_m.min() >= 0.5
    told = wall_ranges(near, every, np.eye(3), 0.5)
    assert told.ranges_m[0] < 0.3
    assert told.front_m is not None
    assert told.front_m > 5.0


def test_front_and_right_are_the_distances_to_the_walls() -> None:
    """Heading along +x, 10 m from the wall on the right, 25 m from the one ahead: eq. 4 and 5."""
    t = np.arange(60) * 0.02
    track = Track(t, np.tile([15.0, 10.0, 6.0], (60, 1)), np.zeros((60, 3)))
    buffer = AttitudeBuffer()
    noise = replace(EXACT, range_m=0.12)
    front, right = [], []
    for m in stream(HALL, track, lidar_geometry(), noise, 5):
        if isinstance(m, AttitudeSample):
            buffer.add(m)
        elif isinstance(m, LidarScan) and buffer.history is not None:
            _, every = Leveller(LidarConfig()).level(m, buffer.history, np.zeros(3))
            told = wall_ranges(m, every, np.eye(3), 0.5)
            front.append(told.front_m)
            right.append(told.right_m)
            assert told.is_seen.all()
            assert told.ranges_m[90] == pytest.approx(15.0, abs=0.6)  # left
            assert told.ranges_m[180] == pytest.approx(15.0, abs=0.6)  # behind
    assert np.mean(front) == pytest.approx(25.0, abs=0.06)
    assert np.mean(right) == pytest.approx(10.0, abs=0.06)
    assert np.std(right) < 0.08


def test_blocks_of_returns_average_within_a_layer_and_leave_out_strays() -> None:
    scan, history, _ = _last_scan((0.0, 0.0, 0.0), 0.0, 0.0, 0.0)
    levelled, _ = Leveller(LidarConfig()).level(scan, history, np.zeros(3))
    means = block_means(levelled, 0, 512, 0.5)
    assert len(means) == pytest.approx(4 * 128, abs=4)
    floor = means[np.abs(means[:, 2] + 6.0) < 0.02]
    assert len(floor) > 100
    ranges = scan.range_m.copy()
    ranges[4, ::16] = 1.0  # dust
    dusty = LidarScan(
        t_ns=scan.t_ns,
        frame_id=1,
        t_column_ns=scan.t_column_ns,
        range_m=ranges,
        signal=scan.signal,
        column_valid=scan.column_valid,
        geometry=scan.geometry,
    )
    levelled, _ = Leveller(LidarConfig()).level(dusty, history, np.zeros(3))
    assert (block_means(levelled, 0, 512, 0.5)[:, 2] < -0.9).sum() >= (means[:, 2] < -0.9).sum() - 2


def test_attitude_is_interpolated_and_carried_on_a_little() -> None:
    buffer = AttitudeBuffer()
    for k in range(10):
        angle = 0.1 * k * 0.02
        q = np.array([math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0])
        assert buffer.add(
            AttitudeSample(t_ns=k * 20_000_000, q_ref_body_wxyz=q, rate_body_radps=np.array([0.1, 0.0, 0.3]))
        )
    assert buffer.history is not None
    got = buffer.history.at(np.array([90_000_000, 180_000_000, 230_000_000, 10_000_000_000], np.int64))
    assert got[0, 0] == pytest.approx(0.1 * 0.09, abs=1e-6)
    assert got[1, 2] - got[0, 2] == pytest.approx(0.3 * 0.09, rel=1e-3)
    assert got[2, 2] - got[1, 2] == pytest.approx(0.3 * 0.05, rel=1e-3)
    assert got[3, 2] - got[1, 2] == pytest.approx(0.3 * 0.1, rel=1e-3)  # no further than that
    stale = AttitudeSample(t_ns=5, q_ref_body_wxyz=np.array([1.0, 0, 0, 0]), rate_body_radps=np.zeros(3))
    assert not buffer.add(stale)
    assert buffer.dropped == 1


def test_published_attitude_never_changes_however_many_samples_follow() -> None:
    buffer, published = AttitudeBuffer(), []
    for k in range(2 * STORE + 10):
        angle = 0.001 * (k % 50)
        q = np.array([math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0])
        assert buffer.add(AttitudeSample(t_ns=k, q_ref_body_wxyz=q, rate_body_radps=np.array([0.0, 0.0, 0.3])))
        assert buffer.history is not None
        if k % 50 == 0:
            published.append((buffer.history, buffer.history.t_ns.copy(), buffer.history.values.copy()))
    for history, t_ns, values in published:
        np.testing.assert_array_equal(history.t_ns, t_ns)
        np.testing.assert_array_equal(history.values, values)
    newest = published[-1][0]
    np.testing.assert_array_equal(newest.t_ns, newest.t_ns[-1] - np.arange(HISTORY)[::-1])
