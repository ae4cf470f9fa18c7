"""Scores against truth: pinned, never aligned."""

from __future__ import annotations

import numpy as np
import pytest

from stockpilot.score import (
    MapPin,
    TruthLog,
    cast_plan,
    cramer_rao_bound_m,
    pin_map,
    score_poses,
    wall_distance_rms_m,
)

HALL = np.array([[0.0, 0.0], [50.0, 0.0], [50.0, 30.0], [0.0, 30.0]])


def straight_flight(y_m: float = 6.0, yaw_rad: float = 0.0) -> TruthLog:
    """Along the long wall at 1 m/s, the wall on the right."""
    n = 400
    return TruthLog(
        t_ns=np.arange(n, dtype=np.int64) * 100_000_000,
        position_world_m=np.column_stack([5.0 + np.arange(n) * 0.1, np.full(n, y_m), np.full(n, 9.0)]),
        yaw_rad=np.full(n, yaw_rad),
        is_following=np.ones(n, dtype=np.bool_),
    )


def test_poses_equal_to_truth_score_zero() -> None:
    truth = straight_flight()
    pin = pin_map(truth, 0)
    poses = pin.to_map(truth.position_world_m)
    score = score_poses(truth, pin, truth.t_ns, poses, np.zeros(len(poses)))
    assert score.e_p_m == pytest.approx(0.0, abs=1e-12)
    assert score.e_yaw_deg == pytest.approx(0.0, abs=1e-12)


def test_constant_offset_is_not_aligned_away() -> None:
    truth = straight_flight()
    pin = pin_map(truth, 0)
    poses = pin.to_map(truth.position_world_m) + np.array([0.3, 0.0, -0.4])
    score = score_poses(truth, pin, truth.t_ns, poses, np.full(len(poses), np.radians(2.0)))
    assert score.e_p_m == pytest.approx(0.5)
    assert score.e_p_xy_m == pytest.approx(0.3)
    assert score.e_z_m == pytest.approx(0.4)
    assert score.e_yaw_deg == pytest.approx(2.0)


def test_pin_maps_to_world_and_back() -> None:
    pin = MapPin(position_world_m=np.array([4.0, -2.0, 0.3]), yaw_rad=2.1)
    points = np.random.default_rng(0).normal(size=(20, 3)) * 10
    np.testing.assert_allclose(pin.to_map(pin.to_world(points)), points, atol=1e-12)
    np.testing.assert_allclose(pin.to_world(np.zeros((1, 3)))[0], pin.position_world_m)


def test_wall_distance_is_measured_to_the_true_wall_on_the_right() -> None:
    assert wall_distance_rms_m(straight_flight(6.0), [HALL], 6.0) == pytest.approx(0.0, abs=1e-9)
    assert wall_distance_rms_m(straight_flight(6.5), [HALL], 6.0) == pytest.approx(0.5)


def test_wall_distance_is_normal_to_the_wall_though_the_heading_is_off() -> None:
    assert wall_distance_rms_m(straight_flight(6.0, yaw_rad=0.1), [HALL], 6.0) == pytest.approx(0.0, abs=1e-9)


def test_rays_meet_walls_where_they_stand() -> None:
    distance, normal = cast_plan(np.array([10.0, 10.0]), np.radians([0.0, 90.0, 180.0, 270.0]), [HALL])
    np.testing.assert_allclose(distance, [40.0, 20.0, 10.0, 10.0])
    np.testing.assert_allclose(np.abs(normal), [[1, 0], [0, 1], [1, 0], [0, 1]], atol=1e-12)


def test_cramer_rao_bound_of_the_hall_is_about_a_centimetre_and_scales_with_noise() -> None:
    truth = straight_flight()
    t = truth.t_ns[::40]
    bound = cramer_rao_bound_m(truth, t, [HALL], noise_m=0.12, max_range_m=100.0)
    half = cramer_rao_bound_m(truth, t, [HALL], noise_m=0.06, max_range_m=100.0)
    assert bound is not None
    assert half is not None
    assert 0.005 < bound < 0.02
    assert half == pytest.approx(bound / 2, rel=1e-6)
