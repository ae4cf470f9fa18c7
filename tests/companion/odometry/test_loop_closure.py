"""Places seen before are recognised, and the drift between is taken out; what cannot be told stays open."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.odometry.likelihood import LikelihoodGrid, thinned
from companion.odometry.loop_closure import LoopCloser
from companion.odometry.planar import PlanarMatcher
from companion.odometry.pose_graph import Constraint, composed, optimised, relative
from tests.companion.odometry.hall import Hall, rectangle

ROUND = Hall([rectangle(24, 16), rectangle(18, 10, 3, 3), rectangle(1, 1, 0, 7), rectangle(2, 1, 12, 0)])
CORRIDOR = Hall([rectangle(200, 3)])
BEAMS = np.radians(np.arange(180) - 89.5)
FIRM = np.diag([1e4, 1e4, 1e5])


def scan_of(hall: Hall, pose: np.ndarray, rng: np.random.Generator, far_m: float = 50.0) -> np.ndarray:
    """What a half-turn scanner sees from x, y, yaw in the hall, in its own frame; far_m: beyond, nothing comes back."""
    along = BEAMS + pose[2]
    rays = np.stack((np.cos(along), np.sin(along), np.zeros(180)), axis=1)
    r = hall.cast(np.tile([pose[0], pose[1], 1.0], (180, 1)), rays) + rng.normal(size=180) * 0.02
    seen = r < far_m
    return np.stack((r * np.cos(BEAMS), r * np.sin(BEAMS)), axis=1)[seen]


def round_trip(laps: float) -> np.ndarray:
    """(N, 3) along the corridor about the block, turning at its corners; steps of 0.1 m and 5 deg."""
    corners = np.array([(1.5, 1.5), (22.5, 1.5), (22.5, 14.5), (1.5, 14.5)])
    poses, yaw = [], 0.0
    for k in range(math.ceil(4 * laps)):
        a, b = corners[k % 4], corners[(k + 1) % 4]
        steps = int(np.hypot(*(b - a)) / 0.1)
        poses += [(*(a + (b - a) * n / steps), yaw) for n in range(steps)]
        poses += [(*b, yaw + math.radians(5.0 * n)) for n in range(18)]
        yaw += math.pi / 2
    return np.array(poses)


def drifting(path: np.ndarray, step_error: tuple[float, float, float]) -> np.ndarray:
    """The path as an odometry tells it that errs by so much with each step; it begins at the origin."""
    told = [np.zeros(3)]
    for step in relative(path[:-1], path[1:]):
        told.append(composed(told[-1], step + step_error))
    return np.array(told)


def test_drift_of_a_round_trip_is_taken_out() -> None:
    path, rng = round_trip(1.5), np.random.default_rng(0)
    truth = relative(np.broadcast_to(path[0], path.shape), path)
    odom = drifting(path, (0.0003, 0.0, 0.0002))
    closer = LoopCloser()
    for pose, told in zip(path, odom, strict=True):
        closer.add(scan_of(ROUND, pose, rng), told, FIRM, converged=True)
    before = np.hypot(*(odom - truth)[:, :2].T)
    after = np.hypot(*(closer.poses() - truth)[:, :2].T)
    assert closer.loops > 30
    assert before.max() > 1.0
    assert after.max() < 0.5
    second_lap = np.argmin(np.hypot(*(path[-1] - path[: len(path) // 2])[:, :2].T))
    met = relative(closer.poses()[second_lap], closer.poses()[-1]) - relative(path[second_lap], path[-1])
    assert np.hypot(*met[:2]) < 0.03, "the same place is at two places of the map"


def test_a_corridor_that_looks_alike_everywhere_does_not_pull_the_robot_along_it() -> None:
    """There and back, ends out of sight: the walls say nothing of the way along, so odometry's word stands."""
    rng = np.random.default_rng(0)
    out = np.column_stack((np.linspace(80, 110, 300), np.full(300, 1.5), np.zeros(300)))
    turn = np.column_stack((np.full(36, 110.0), np.full(36, 1.5), np.radians(5.0 * np.arange(1, 37))))
    path = np.concatenate((out, turn, out[::-1] + (0.0, 0.0, math.pi)))
    truth = relative(np.broadcast_to(path[0], path.shape), path)
    closer = LoopCloser()
    for pose, told in zip(path, truth, strict=True):
        closer.add(scan_of(CORRIDOR, pose, rng, far_m=15.0), told, FIRM, converged=True)
    assert np.abs((closer.poses() - truth)[:, :2]).max() < 0.1


def test_a_wrong_loop_closure_bends_nothing() -> None:
    line = np.column_stack((np.arange(40.0), np.zeros(40), np.zeros(40)))
    chain = [Constraint(k, k + 1, np.array([1.0, 0.0, 0.0]), FIRM, False) for k in range(39)]
    right = Constraint(0, 30, np.array([30.0, 0.0, 0.0]), FIRM, True)
    wrong = Constraint(5, 35, np.array([3.0, 8.0, 1.0]), FIRM, True)
    found = optimised(line, [*chain, right, wrong])
    assert np.abs(found - line).max() < 0.2


def test_a_loop_closure_spreads_what_is_amiss_over_the_way() -> None:
    """A square whose odometry turns too little: the end meets the beginning, which stays where it is."""
    square = np.array([np.append(p, a) for p, a in zip(
        [(0, 0), (5, 0), (10, 0), (10, 5), (10, 10), (5, 10), (0, 10), (0, 5), (0, 0)],
        np.radians([0, 0, 90, 90, 180, 180, 270, 270, 360]), strict=True)])  # fmt: skip
    steps = relative(square[:-1], square[1:]) + (0.01, 0.0, 0.01)
    odom = [np.zeros(3)]
    for step in steps:
        odom.append(composed(odom[-1], step))
    graph = [Constraint(k, k + 1, step, FIRM / 100, False) for k, step in enumerate(steps)]
    graph.append(Constraint(0, 8, np.zeros(3), FIRM, True))
    found = optimised(np.array(odom), graph)
    assert np.hypot(*(np.array(odom) - square)[8, :2]) > 0.3
    assert np.array_equal(found[0], np.zeros(3))
    np.testing.assert_allclose(found[8], 0.0, atol=0.03)
    assert np.hypot(*(found - square)[:, :2].T).max() < 0.15


@pytest.mark.parametrize("off", [(0.0, 0.0, 0.0), (1.7, -0.9, 0.3), (-2.3, 1.2, -0.38)])
def test_the_search_finds_a_scan_wherever_in_the_window_it_was_taken(off: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(0)
    pose = np.array([2.0, 1.5, 0.4])
    around = [np.array([2.0 + d, 1.5, a]) for d in (-0.5, 0.0, 0.5) for a in (0.0, 1.5, 3.0, 4.5)]
    seen = [composed(p, np.column_stack((scan_of(ROUND, p, rng), np.zeros(180))))[:, :2] for p in around]
    grid = LikelihoodGrid(np.concatenate(seen))
    fit = grid.search(thinned(scan_of(ROUND, pose, rng)), pose + off, window_m=3.0, window_rad=0.45)
    assert np.hypot(*(fit.pose - pose)[:2]) < 0.15
    assert abs(fit.pose[2] - pose[2]) < 0.03
    assert fit.score > 0.6


def test_a_turn_on_the_spot_too_fast_to_follow_is_found_again() -> None:
    """50 deg between two scans."""
    rng, matcher = np.random.default_rng(0), PlanarMatcher()
    room = Hall([rectangle(8, 6), rectangle(1, 1, 6, 4)])
    at = [np.array([2.5, 2.5, math.radians(a)]) for a in (0, 0, 0, 50, 100, 100)]
    poses = [matcher.match(scan_of(room, p, rng), 400_000_000 * k) for k, p in enumerate(at)]
    assert all(p.converged for p in poses)
    np.testing.assert_allclose([p.pose for p in poses], [p - at[0] for p in at], atol=0.06)


def test_a_trajectory_of_nothing_is_empty() -> None:
    assert LoopCloser().poses().shape == (0, 3)


def test_the_same_scans_give_the_same_poses_to_the_last_bit() -> None:
    path = round_trip(1.2)[::3]
    odom = drifting(path, (0.003, 0.0, 0.0006))

    def run() -> np.ndarray:
        rng, closer = np.random.default_rng(0), LoopCloser()
        for pose, told in zip(path, odom, strict=True):
            closer.add(scan_of(ROUND, pose, rng), told, FIRM, converged=True)
        return closer.poses()

    assert np.array_equal(run(), run())
