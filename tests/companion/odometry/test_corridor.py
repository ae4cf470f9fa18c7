"""A corridor whose ends are out of sight: the position along it is not known, and the odometry says so (FAULTS 9)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.messages import Array, LidarScan, RangefinderSample
from companion.odometry import Odometry, ScanResult
from tests.companion.odometry.conftest import CONFIG, Message, error_of, feed
from tests.companion.odometry.hall import Hall, Noise, Track, fly, lidar_geometry, rectangle, stream, truth_in_map

SIGHT_M = 13.0
STAND_S = 3.0
CORRIDOR = Hall([rectangle(120, 10)])


@dataclass
class Corridor:
    """error: (N, 4) x along, y across, z, yaw; sigma: (N,) along; weight: (N,) of all points in the wall map."""

    odometry: Odometry
    results: list[ScanResult]
    error: Array
    sigma: Array
    weight: Array
    true: Array


def _follow(track: Track, messages: list[Message]) -> Corridor:
    odometry = Odometry(CONFIG)
    results: list[ScanResult] = []
    error, weight, truth = [], [], []
    t0 = next(m.t_ns for m in messages if isinstance(m, LidarScan))
    for message in messages:
        for result in feed(odometry, [message]):
            results.append(result)
            truth.append(truth_in_map(track, message.t_ns, t0))
            error.append(error_of(result.estimate, truth[-1]))
            weight.append(odometry.walls.sums[..., 0].sum())
    sigma = [np.sqrt(r.estimate.pose_covariance[0, 0]) for r in results]
    return Corridor(odometry, results, np.array(error), np.array(sigma), np.array(weight), np.array(truth))


@pytest.fixture(scope="module")
def there_and_back() -> Corridor:
    """From 10 m off one end, which is seen as far as 13 m, 12 m along and back again."""
    legs = [(2.0, 0.0, 1.0, 0.0), (15.0, 0.8, 0.0, 0.0), (2.0, 0.0, 0.0, 0.0), (14.0, -0.8, 0.0, 0.0)]
    track = fly((10.0, 4.0, 0.0), legs, stand_s=STAND_S)
    return _follow(track, list(stream(CORRIDOR, track, lidar_geometry(), Noise(), seed=5, max_range_m=SIGHT_M)))


@pytest.fixture(scope="module")
def begun_in_flight() -> Corridor:
    """Nothing is heard before the vehicle flies at 0.5 m/s, 3 m up, in the middle of the corridor."""
    track = fly((50.0, 4.0, 0.0), [(3.0, 0.0, 1.0, 0.0), (10.0, 0.5, 0.0, 0.0)], stand_s=1.0)
    messages = stream(CORRIDOR, track, lidar_geometry(), Noise(), seed=6, max_range_m=SIGHT_M)
    return _follow(track, [m for m in messages if m.t_ns > 6_000_000_000])


def _unseen(flight: Corridor) -> NDArray[np.intp]:
    return np.flatnonzero([r.estimate.is_degenerate for r in flight.results])


def test_where_no_end_is_seen_the_error_stays_within_three_sigma(there_and_back: Corridor) -> None:
    unseen = _unseen(there_and_back)
    assert len(unseen) > 100
    assert (np.abs(there_and_back.error[unseen, 0]) <= 3.0 * there_and_back.sigma[unseen] + 0.02).all()
    assert there_and_back.sigma.max() > 1.0
    assert np.abs(there_and_back.error[:, 1]).max() < 0.1  # across it, all is as ever


def test_quality_falls_with_what_is_known_along_the_corridor(there_and_back: Corridor) -> None:
    unsure = [r.estimate.quality for r, s in zip(there_and_back.results, there_and_back.sigma, strict=True) if s > 0.55]
    assert len(unsure) > 50
    assert max(unsure) < 20
    assert min(unsure) > 0


def test_velocity_along_a_corridor_does_not_run_away(there_and_back: Corridor) -> None:
    speed = [np.hypot(*r.estimate.velocity_body_mps[:2]) for r in there_and_back.results]
    assert max(speed) < 1.5


def test_nothing_is_painted_into_the_map_while_the_position_is_lost(there_and_back: Corridor) -> None:
    lost = np.flatnonzero(there_and_back.sigma > 0.5)
    assert len(lost) > 50
    assert np.ptp(there_and_back.weight[lost[0] : lost[-1] + 1]) == 0.0
    assert there_and_back.weight[-1] > there_and_back.weight[lost[-1]]  # and painted again once it is found
    assert not any(there_and_back.results[i].keyframe for i in lost)


def test_the_end_seen_again_brings_the_pose_back_and_a_jump_is_told(there_and_back: Corridor) -> None:
    """AUTOPILOTS.md: "reset_counter moves only when the pose truly jumps"."""
    resets = [r.estimate.reset_counter for r in there_and_back.results]
    x = np.array([r.estimate.position_map_m[0] for r in there_and_back.results])
    jumps = np.flatnonzero(np.abs(np.diff(x)) > 0.4)
    assert np.abs(there_and_back.error[-15:, 0]).max() < 0.1
    assert there_and_back.sigma[-1] < 0.15
    assert all(resets[i + 1] == resets[i] + 1 for i in jumps)
    assert resets[-1] <= 1


def test_flying_along_a_corridor_is_not_taken_for_standing(begun_in_flight: Corridor) -> None:
    assert not any(r.is_standing for r in begun_in_flight.results[2:])
    assert (np.abs(begun_in_flight.error[:, 0]) <= 3.0 * begun_in_flight.sigma + 0.02).all()
    assert begun_in_flight.sigma[-1] > 1.0


def test_what_its_rangefinder_finds_on_the_ground_stands_even_in_a_corridor() -> None:
    track = fly((50.0, 4.0, 0.0), [], stand_s=4.0)
    messages = list(stream(CORRIDOR, track, lidar_geometry(), Noise(), seed=7, max_range_m=SIGHT_M))
    results = feed(Odometry(CONFIG), messages)
    assert len(results) > 30
    assert all(r.is_standing for r in results)
    assert np.hypot(*results[-1].estimate.position_map_m[:2]) < 0.01
    blind = [replace(m, distance_m=3.0) if isinstance(m, RangefinderSample) else m for m in messages]
    assert not feed(Odometry(CONFIG), blind)[-1].is_standing
