"""Yaw: by the walls where they tell it, else by the gyro alone."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.messages import AttitudeSample
from companion.odometry import filter as kalman
from companion.odometry.attitude import AttitudeBuffer
from companion.odometry.degeneracy import is_yaw_weak
from companion.odometry.standstill import NOTICED_LATE, Standstill
from companion.odometry.wall_map import Registration, WallMap

FLOOR = np.array([0.004, 0.004, 0.0004]) ** 2
PRIOR = np.diag([1 / 0.06**2, 1 / 0.06**2, 1 / 0.02**2])
AWAY = np.array([9.0, 0.0])  # of the body from the middle of the hall


def seen(outline: np.ndarray, noise_m: float, rng: np.random.Generator) -> np.ndarray:
    return np.ascontiguousarray(outline - AWAY + rng.normal(0.0, noise_m, outline.shape))


def registered(outline: np.ndarray, noise_m: float = 0.03) -> Registration:
    """Of one scan against a map of forty from the same place."""
    rng = np.random.default_rng(3)
    walls = WallMap()
    for _ in range(40):
        walls.insert(seen(outline, noise_m, rng) + AWAY, 5.0, np.full(3, 1e-6))
    return walls.register(seen(outline, noise_m, rng), np.append(AWAY, 0.0), PRIOR, z_m=5.0, sigma_range_m=noise_m)


def ring(radius_m: float, centre: tuple[float, float], n: int) -> np.ndarray:
    angle = np.linspace(-math.pi, math.pi, n, endpoint=False)
    return np.column_stack([np.cos(angle), np.sin(angle)]) * radius_m + np.array(centre)


def square(half_m: float, n: int) -> np.ndarray:
    along = np.linspace(-half_m, half_m, n // 4)
    side = np.column_stack([along, np.full_like(along, half_m)])
    return np.concatenate([side, -side, side[:, ::-1], -side[:, ::-1]])


def test_walls_of_a_square_hall_tell_yaw_and_those_of_a_round_one_do_not() -> None:
    assert not is_yaw_weak(registered(square(16.0, 500)).information)
    assert is_yaw_weak(registered(ring(16.0, (0.0, 0.0), 500)).information)


def test_little_that_tells_yaw_is_doubted() -> None:
    """Few returns tell of it, and err alike from scan to scan: believed, they turned a map by 1.9 deg over a flight."""
    fin = np.column_stack([np.zeros(4), np.linspace(11.0, 12.0, 4)])
    found = registered(np.concatenate([ring(16.0, (0.0, 0.0), 500), fin]), 0.3)
    assert is_yaw_weak(found.information)
    assert not is_yaw_weak(found.apparent_information)


def test_in_a_round_hall_place_hangs_on_yaw_by_the_way_to_its_middle() -> None:
    per_yaw = registered(ring(16.0, (0.0, 0.0), 500)).per_yaw_m
    assert np.allclose(per_yaw, (0.0, 9.0), atol=0.5) or np.allclose(per_yaw, (0.0, -9.0), atol=0.5)


def test_held_yaw_stays_and_place_is_taken_as_seen_from_it() -> None:
    state = kalman.start(0)
    x = state.x.copy()
    x[kalman.YAW], x[kalman.YAW + 1] = 0.3, 1e-3
    wide = kalman.Planar(0, x, np.diag([0.1, 0.1, 0.1, 0.1, 0.1, 0.1, 0.01, 1e-6]))
    information = np.diag([1e4, 1e4, 0.0])
    prior = np.asarray(np.linalg.inv(wide.p[kalman.POSE_BLOCK]))
    after = kalman.update(wide, np.array([0.2, -0.1, 0.35]), information, information, prior, FLOOR, holds_yaw=True)
    assert after.x[kalman.YAW] == 0.3
    assert after.p[kalman.YAW, kalman.YAW] == pytest.approx(0.01)
    assert after.x[:2] == pytest.approx([0.2, -0.1], abs=0.01)
    assert after.x[kalman.YAW + 1] == 0.0  # taken out by the flight controller: twice, the two ran away by 0.02 deg/s


def test_what_it_turned_while_motion_was_noticed_is_not_lost() -> None:
    """In the second until then the gyro turned by 0.6 deg; the registrations of a climb were believed instead."""
    buffer, still = AttitudeBuffer(), Standstill()
    shift, sigma = np.zeros(4), np.full(4, 0.01)
    rate = 0.0
    for k in range(3000):
        if k == 3000 - 5 * (NOTICED_LATE - 1):
            rate = 0.012
        buffer.add(
            AttitudeSample(
                t_ns=k * 20_000_000,
                q_ref_body_wxyz=np.array([1.0, 0.0, 0.0, 0.0]),
                rate_body_radps=np.array([0.0, 0.0, rate]),
            )
        )
        if k % 5 == 4:
            assert buffer.history is not None
            assert still.on_scan(buffer.history, shift, sigma)
    assert still.turned_rad == pytest.approx(0.012 * 0.02 * 5 * (NOTICED_LATE - 1), rel=0.15)
    assert kalman.let_go(kalman.start(0), 0.0, 6.0, still.turned_rad).x[kalman.YAW] == still.turned_rad
