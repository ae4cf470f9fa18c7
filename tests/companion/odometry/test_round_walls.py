"""A wall that is round: the line through a piece of it lies inside of it on all sides, and must not pass for tilt."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.messages import Array
from companion.odometry.height_map import HeightMap
from companion.odometry.wall_map import WallMap
from tests.companion.odometry.hall import Hall, circle, rectangle

RADIUS_M = 16.0
SILO = Hall([circle(RADIUS_M, 0.0, 0.0, corners=720)])
ROWS = np.radians([-11.25, -22.5, -33.75, -45.0])
COLUMN_RAD = 2 * math.pi / 512
NOISE_M = 0.12


def layer(hall: Hall, place: Array, noise_m: float, rng: np.random.Generator) -> Array:
    """(512, 2) the horizontal layer's returns in map, from a place (3,)."""
    a = np.arange(512) * COLUMN_RAD
    d = np.stack((np.cos(a), np.sin(a), np.zeros(512)), axis=1)
    reach = hall.cast(np.tile(place, (512, 1)), d) + rng.normal(size=512) * noise_m
    return np.asarray(place[:2] + reach[:, None] * d[:, :2])


def mapped(hall: Hall, noise_m: float, radius_m: float = 10.0) -> WallMap:
    """From a lap at that radius, climbing."""
    rng, walls = np.random.default_rng(1), WallMap()
    for n, angle in enumerate(np.linspace(0.0, 2 * math.pi, 240)):
        place = np.array([radius_m * math.cos(angle), radius_m * math.sin(angle), 1.0 + n / 30.0])
        walls.insert(layer(hall, place, noise_m, rng), float(place[2]), np.zeros(3))
    return walls


@pytest.mark.parametrize(("noise_m", "bound_m"), [(0.0, 0.0004), (NOISE_M, 0.003)])
def test_lines_of_a_round_wall_lie_on_it(noise_m: float, bound_m: float) -> None:
    a = np.linspace(0.0, 2 * math.pi, 500, endpoint=False)
    on_wall = RADIUS_M * np.column_stack([np.cos(a), np.sin(a), np.zeros(500)])
    at = mapped(SILO, noise_m).lines_at(on_wall, np.zeros(3))
    assert (at[:, 0] == 2.0).all()
    off = np.sum(at[:, 2:4] * (on_wall[:, :2] - at[:, 4:6]), axis=1)
    inward = off * np.sign(np.sum(at[:, 2:4] * on_wall[:, :2], axis=1))
    assert abs(float(np.mean(inward))) < bound_m  # 7 mm were they straight
    assert float(np.median(np.abs(at[:, 7]))) == pytest.approx(1.0 / RADIUS_M, rel=0.3)


def test_straight_walls_and_their_corners_stay_straight() -> None:
    hall = Hall([rectangle(40.0, 30.0, -20.0, -15.0)])
    x = np.linspace(-19.5, 19.5, 200)
    on_wall = np.column_stack([x, np.full(200, -15.0), np.zeros(200)])
    at = mapped(hall, NOISE_M).lines_at(on_wall, np.zeros(3))
    middle = np.abs(x) < 18.0
    assert float(np.median(np.abs(at[middle, 7]))) < 0.012
    off = np.sum(at[:, 2:4] * (on_wall[:, :2] - at[:, 4:6]), axis=1)
    assert float(np.abs(off[middle & (at[:, 0] == 2.0)]).max()) < 0.03


def blocks(place: Array) -> Array:
    """(N, 4) means of four returns each of the lower layers, levelled, without noise."""
    azimuth, elevation = (v.ravel() for v in np.meshgrid(np.arange(512) * COLUMN_RAD, ROWS))
    d = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1)
    points = SILO.cast(np.tile(place, (len(d), 1)), d)[:, None] * d
    means = points.reshape(-1, 4, 3).mean(axis=1)
    alike = np.ptp(points[:, 2].reshape(-1, 4), axis=1) < 0.2  # of the wall, or of the floor
    return np.column_stack([means, np.full(len(means), 4.0)])[alike]


def test_a_round_wall_does_not_pass_for_tilt() -> None:
    walls, ground = mapped(SILO, 0.0), HeightMap()
    xy = np.stack(np.meshgrid(*2 * [np.arange(-RADIUS_M, RADIUS_M, 0.2)]), axis=-1).reshape(-1, 2)
    floor = np.column_stack([xy, np.zeros(len(xy)), np.full(len(xy), 4.0)])
    ground.insert(floor, np.zeros(3), np.array([0.0, 0.0, 5.0]), NOISE_M, 1e-6)
    tilts = []
    for angle in np.linspace(0.0, 2 * math.pi, 12, endpoint=False):
        place = np.array([10.0 * math.cos(angle), 10.0 * math.sin(angle), 9.0])
        fit = ground.fit(
            blocks(place), np.array([place[0], place[1], 0.0]), 9.0, walls, sigma_range_m=NOISE_M / 2, gate_m=0.6,
            seen_spread_m=8.0, lean=np.zeros(2), tilt_information=np.diag([1e4, 1e4, 1e8, 1e8]),
            shift_information=np.eye(2) / 0.01**2,
        )  # fmt: skip
        assert fit.wall_points > 100
        # the side of the near wall down: about the axis across the way from the middle
        tilts.append(math.sin(angle) * fit.correction[1] - math.cos(angle) * fit.correction[2])
    assert abs(math.degrees(float(np.mean(tilts)))) < 0.002
