"""What leans back is no wall: a pile beside the start does not carry the pose along while the vehicle climbs."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.messages import Array, LevelledScan, LidarGeometry
from companion.odometry.level import LOW_SPACING_M, NO_PILE_ABOVE_M, wall_layer

COLUMNS = 512
DOWN = np.radians([0.0, 11.25, 22.5, 33.75, 45.0])
NOISE_M = 0.12
FOOT_M = 2.0  # from the start to the pile's foot, at -y; the walls are at x = +-20 and y = 15
REPOSE = math.tan(math.radians(35.0))


def seen_from(
    z_m: float, rng: np.random.Generator, rows: int = 5
) -> tuple[LevelledScan, LidarGeometry, NDArray[np.bool_]]:
    """A levelled scan z_m above a level floor, its geometry, and which of its returns lie on the pile."""
    bearing = 2 * np.pi * np.arange(COLUMNS) / COLUMNS
    down = np.radians([0.0]) if rows == 1 else DOWN
    c, s = np.cos(bearing)[:, None], np.sin(bearing)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        wall = np.minimum(20.0 / np.maximum(np.abs(c), 1e-9), np.where(s > 0, 15.0 / np.maximum(s, 1e-9), 1e9))
        pile = (z_m + REPOSE * FOOT_M) / np.maximum(-s * REPOSE + np.tan(down), 1e-9)
        pile = np.where(-s * pile >= FOOT_M, pile, 1e9)
        floor = z_m / np.maximum(np.tan(down), 1e-9) * np.ones_like(s)
    flat = np.minimum(np.minimum(wall, pile), floor)
    on_pile = (pile == flat) & (pile < 1e8)
    slant = flat / np.cos(down) + NOISE_M * rng.standard_normal(flat.shape)
    flat = slant * np.cos(down)
    points = np.stack([c * flat, s * flat, -slant * np.sin(down)], axis=-1).reshape(-1, 3)
    column, row = (a.ravel() for a in np.mgrid[0:COLUMNS, 0 : len(down)])
    directions = np.zeros((len(down), COLUMNS, 3))
    geometry = LidarGeometry(directions=directions, offsets_m=directions, elevation_rad=-down, horizontal_row=0)
    scan = LevelledScan(
        t_ns=0, points_level=points, range_m=slant.ravel(), row=row, column=column, origin_level_m=np.zeros(3)
    )
    return scan, geometry, on_pile.ravel()


def layer_at(z_m: float, rows: int = 5, *, is_climbing: bool = True) -> tuple[Array, Array]:
    """The wall layer at a height, and the horizontal layer's places on the pile."""
    scan, geometry, on_pile = seen_from(z_m, np.random.default_rng(1), rows)
    layer = wall_layer(scan, geometry, 0.1 - z_m, z_m, NOISE_M, is_climbing=is_climbing)
    return layer, scan.points_level[on_pile & (scan.row == 0)][:, :2]


def on_slope(layer: Array) -> int:
    return int(((layer[:, 1] < -0.5 * FOOT_M) & (np.abs(layer[:, 0]) < 19.0)).sum())


@pytest.mark.parametrize(
    ("z_m", "left"), [(1.0, 0.15), (2.0, 0.6), (4.0, 0.4)]
)  # far along the slope two layers see floor
def test_a_slope_beside_the_start_is_no_wall_and_the_walls_are(z_m: float, left: float) -> None:
    layer, pile = layer_at(z_m)
    assert len(pile) > 100
    assert on_slope(layer) < left * len(pile)
    assert (np.hypot(*layer.T) < 1.3 * -pile[:, 1].max()).sum() < 0.1 * len(layer)  # none of it close by
    assert (np.abs(layer[:, 1] - 15.0) < 0.6).sum() > 60
    assert (np.abs(layer[:, 0] - 20.0) < 0.6).sum() > 20


def test_a_wall_behind_a_pile_is_a_wall() -> None:
    """The layer below sees the pile before it, nearer than the wall: that is no slope that goes on up to the layer."""
    z_m, wall_m = 3.0, 5.0  # the pile is 2.1 m high where it meets the wall
    rng = np.random.default_rng(3)
    scan, geometry, _ = seen_from(z_m, rng)
    points = scan.points_level.copy()
    behind = points[:, 1] < -wall_m
    points[behind] *= (wall_m / -points[behind, 1])[:, None]
    points[behind] += 0.01 * rng.standard_normal((behind.sum(), 3))
    layer = wall_layer(
        dataclasses.replace(scan, points_level=points), geometry, 0.1 - z_m, z_m, NOISE_M, is_climbing=True
    )
    on_wall = np.abs(points[scan.row == 0][:, 1] + wall_m) < 0.2
    assert on_wall.sum() > 100
    assert (np.abs(layer[:, 1] + wall_m) < 0.2).sum() > 0.9 * on_wall.sum()


def test_on_the_ground_the_foot_of_a_pile_has_no_majority() -> None:
    layer, pile = layer_at(0.3)
    assert len(pile) > 200
    assert on_slope(layer) < 0.45 * len(layer)


def test_low_down_what_is_close_counts_by_its_width() -> None:
    layer, pile = layer_at(0.3)
    near, seen = np.hypot(*layer.T) < 3.0, np.hypot(*pile.T) < 3.0
    width = np.ptp(pile[seen][:, 0])
    assert seen.sum() > 100
    assert near.sum() == pytest.approx(width / LOW_SPACING_M, rel=0.3)


def test_standing_every_return_above_the_floor_counts() -> None:
    layer, pile = layer_at(0.3, is_climbing=False)
    assert len(layer) > 0.9 * COLUMNS
    assert on_slope(layer) > 0.9 * len(pile)


def test_while_the_floor_is_not_known_nothing_is_taken_for_a_slope() -> None:
    """The first scan may come before the rangefinder has told the floor: the layer below ends there, a metre off."""
    scan, geometry, _ = seen_from(0.3, np.random.default_rng(4))
    layer = wall_layer(scan, geometry, -math.inf, 0.0, NOISE_M, is_climbing=False)
    assert len(layer) == int((scan.row == 0).sum())


def test_at_the_height_of_flight_every_return_may_be_a_wall() -> None:
    scan, geometry, _ = seen_from(NO_PILE_ABOVE_M + 1.0, np.random.default_rng(2))
    layer = wall_layer(scan, geometry, -NO_PILE_ABOVE_M, NO_PILE_ABOVE_M + 1.0, NOISE_M, is_climbing=True)
    assert len(layer) == int((scan.row == 0).sum())


def test_a_sensor_of_one_layer_keeps_its_slope() -> None:
    layer, pile = layer_at(2.0, rows=1)
    assert len(layer) == COLUMNS
    assert on_slope(layer) > 0.9 * len(pile)
