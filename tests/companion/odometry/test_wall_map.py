"""Registration to the wall map: accuracy, degeneracy, refusal, finding the way back."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.odometry import kernels, solve_kernels
from companion.odometry.degeneracy import is_yaw_weak, judge, weak_direction
from companion.odometry.relocalise import relocalise
from companion.odometry.wall_map import WallMap
from tests.companion.odometry.hall import Hall, circle, rectangle

LOOSE = np.diag([300.0, 300.0, 2000.0])


def layer(hall: Hall, pose: tuple[float, float, float], rng: np.random.Generator, noise_m: float = 0.12) -> np.ndarray:
    """A horizontal layer of 512 points in the body frame at a true pose; returns beyond 50 m are lost."""
    a = np.arange(512) * 2 * math.pi / 512
    d = np.stack((np.cos(a + pose[2]), np.sin(a + pose[2]), np.zeros(512)), axis=1)
    true = hall.cast(np.tile([pose[0], pose[1], 5.0], (512, 1)), d)
    r = true + rng.normal(size=512) * noise_m
    return np.stack((r * np.cos(a), r * np.sin(a)), axis=1)[true < 50.0]


def mapped(hall: Hall, poses: list[tuple[float, float, float]], rng: np.random.Generator) -> WallMap:
    walls = WallMap()
    for pose in poses:
        c, s = math.cos(pose[2]), math.sin(pose[2])
        points = layer(hall, pose, rng) @ np.array([[c, s], [-s, c]]) + pose[:2]
        walls.insert(points, 5.0, np.zeros(3))
    return walls


HALL = Hall([rectangle(40, 25)])
CORRIDOR = Hall([rectangle(400, 6, -200.0)])
SILO = Hall([circle(14.0, 0.0, 0.0)])


def test_registration_finds_the_pose_without_bias() -> None:
    rng = np.random.default_rng(1)
    walls = mapped(HALL, [(8 + 0.2 * k, 9.0, 0.05 * k) for k in range(60)], rng)
    errors = []
    for _ in range(60):
        true = np.array([rng.uniform(9, 18), rng.uniform(8, 12), rng.uniform(-3, 3)])
        guess = true + rng.normal(size=3) * (0.05, 0.05, 0.01)
        found = walls.register(layer(HALL, tuple(true), rng), guess, LOOSE, z_m=5.0, sigma_range_m=0.12)
        assert found.converged
        errors.append(found.pose - true)
    mean, std = np.mean(errors, axis=0), np.std(errors, axis=0)
    assert (np.abs(mean) < (0.006, 0.006, 0.0005)).all()
    assert (std < (0.015, 0.015, 0.001)).all()


def test_covariance_tells_the_spread_of_the_registrations() -> None:
    rng = np.random.default_rng(2)
    walls = mapped(HALL, [(10.0, 9.0, 0.03 * k) for k in range(80)], rng)
    free = np.diag([1e-3, 1e-3, 1e-3])
    true = (10.3, 9.2, 0.4)
    found = [
        walls.register(layer(HALL, true, rng), np.array(true), free, z_m=5.0, sigma_range_m=0.12) for _ in range(150)
    ]
    spread = np.std([f.pose for f in found], axis=0)
    told = np.mean([np.sqrt(np.diag(np.linalg.inv(f.information))) for f in found], axis=0)
    assert (spread / told > 0.6).all()
    assert (spread / told < 1.5).all()


@pytest.mark.parametrize(
    ("hall", "pose", "is_weak"), [(HALL, (10.0, 9.0, 0.3), False), (CORRIDOR, (0.0, 3.0, 0.3), True)]
)
def test_a_corridor_is_degenerate_and_a_hall_is_not(
    hall: Hall, pose: tuple[float, float, float], is_weak: bool
) -> None:
    rng = np.random.default_rng(3)
    walls = mapped(hall, [pose] * 20, rng)
    points = layer(hall, pose, rng)
    found = walls.register(points, np.array(pose), LOOSE, z_m=5.0, sigma_range_m=0.12)
    verdict = judge(found, np.array(pose), np.diag([1e-4, 1e-4, 1e-6]), len(points))
    assert verdict.is_accepted
    assert verdict.is_degenerate is is_weak
    if is_weak:
        assert abs(verdict.weak_axis[0]) > 0.99  # along the corridor
        sigma = 1 / np.sqrt(found.information[0, 0] + 1e-9)
        assert sigma > 5 / np.sqrt(found.information[1, 1])


def test_a_round_silo_leaves_yaw_to_the_gyro() -> None:
    rng = np.random.default_rng(4)
    walls = mapped(SILO, [(4.0, 0.0, 0.05 * k) for k in range(40)], rng)
    found = walls.register(
        layer(SILO, (4.0, 0.0, 0.2), rng), np.array([4.0, 0.0, 0.2]), LOOSE, z_m=5.0, sigma_range_m=0.12
    )
    assert weak_direction(found.information)[0] > 0.2
    assert is_yaw_weak(found.information)
    hall = mapped(HALL, [(10.0, 9.0, 0.0)] * 20, rng)
    points = layer(HALL, (10.0, 9.0, 0.0), rng)
    assert not is_yaw_weak(
        hall.register(points, np.array([10.0, 9.0, 0.0]), LOOSE, z_m=5.0, sigma_range_m=0.12).information
    )


def test_a_jump_against_the_prediction_is_refused() -> None:
    rng = np.random.default_rng(5)
    walls = mapped(HALL, [(10.0, 9.0, 0.02 * k) for k in range(40)], rng)
    points = layer(HALL, (10.4, 9.0, 0.0), rng)
    guess = np.array([10.0, 9.0, 0.0])
    found = walls.register(points, guess, np.eye(3), z_m=5.0, sigma_range_m=0.12)
    assert abs(found.pose[0] - 10.4) < 0.05
    assert (
        judge(found, guess, np.diag([1e-4, 1e-4, 1e-6]), len(points)).refused_because == "jump against the prediction"
    )
    assert judge(found, guess, np.diag([0.1, 0.1, 0.01]), len(points)).is_accepted


def test_a_scan_of_another_place_is_refused() -> None:
    rng = np.random.default_rng(6)
    walls = mapped(HALL, [(10.0, 9.0, 0.02 * k) for k in range(40)], rng)
    points = layer(Hall([rectangle(21, 13, 3.0, 2.0)]), (10.0, 9.0, 0.0), rng)
    guess = np.array([10.0, 9.0, 0.0])
    found = walls.register(points, guess, LOOSE, z_m=5.0, sigma_range_m=0.12)
    assert not judge(found, guess, np.diag([1e-3, 1e-3, 1e-5]), len(points)).is_accepted


def test_the_search_finds_the_pose_from_a_metre_away() -> None:
    rng = np.random.default_rng(7)
    walls = mapped(HALL, [(10.0 + 0.1 * k, 9.0, 0.1 * k) for k in range(60)], rng)
    true = np.array([12.0, 9.5, 0.7])
    points = layer(HALL, tuple(true), rng)
    found = relocalise(walls, points, true + (0.9, -0.8, 0.2), np.diag([0.1, 0.1, 0.01]), 5.0, 0.12)
    assert found is not None
    assert np.abs(found.pose - true).max() < 0.05
    stranger = layer(Hall([rectangle(21, 13, 3.0, 2.0)]), (10.0, 9.0, 0.0), rng)
    assert relocalise(walls, stranger, np.array([10.0, 9.0, 0.0]), np.diag([0.1, 0.1, 0.01]), 5.0, 0.12) is None


def test_the_map_grows_in_every_direction_and_keeps_what_it_has() -> None:
    walls = WallMap()
    first = np.stack((np.linspace(0, 3, 200), np.zeros(200)), axis=1)
    walls.insert(first, 0.0, np.zeros(3))
    for shift in ((-60.0, 0.0), (80.0, 0.0), (0.0, -70.0), (0.0, 90.0)):
        walls.insert(first + shift, 0.0, np.zeros(3))
    assert walls.sums[..., kernels.W].sum() == pytest.approx(1000)
    out = walls.lines_at(np.array([[1.5, 0.0, 0.0], [1.5, 90.0, 0.0], [30.0, 30.0, 0.0]]), np.zeros(3))
    assert out[:, 0].tolist() == [2.0, 2.0, 0.0]
    assert abs(out[1, 3]) == pytest.approx(1.0)  # its normal is along y


def test_points_absurdly_far_do_not_blow_up_the_map() -> None:
    walls = WallMap()
    walls.insert(np.array([[0.0, 0.0], [1e7, -1e7]]), 0.0, np.zeros(3))
    assert walls.state.size < 5_000_000


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=50, deadline=None)
def test_small_solvers_agree_with_numpy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(3, 5))
    spd, b = a @ a.T + 0.1 * np.eye(3), rng.normal(size=3)
    assert np.allclose(solve_kernels.solve3(spd, b), np.linalg.solve(spd, b), rtol=1e-6, atol=1e-9)
    a = rng.normal(size=(4, 6))
    spd, b = a @ a.T + 0.1 * np.eye(4), rng.normal(size=4)
    assert np.allclose(solve_kernels.solve_spd(spd, b), np.linalg.solve(spd, b), rtol=1e-6, atol=1e-9)
    assert np.allclose(solve_kernels.without(spd, 2), np.linalg.inv(np.linalg.inv(spd)[:2, :2]))
