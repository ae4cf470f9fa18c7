"""What a crest hides: a slope that rises to a crest, seen from its own side, and the wall behind it.

And what hides by standing too high: a summit.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from companion.messages import Array, PointMap
from companion.volume.grid import Grid
from companion.volume.shadow import STEEPEST_FALL, Shadow, lay_hidden
from companion.volume.surface import CellState, Surface

CELL_M = 0.25
GRID = Grid(x0_m=0.0, y0_m=0.0, cell_m=CELL_M, nx=60, ny=60)  # 15 x 15 m
CREST_X_M, CREST_Z_M, SLOPE = 11.0, 6.0, 0.6
X, Y = GRID.centres()


def carried_on() -> Array:
    """As the surface is before: the slope goes on beyond the crest, up to the wall at x = 15 m."""
    return CREST_Z_M + SLOPE * (X - CREST_X_M)


def point_map(height_m: float, *, beams_to_wall: bool = True) -> PointMap:
    """A path at x = 8 m along y; each place looks over the crest to the wall, and down the slope in front."""
    path = np.column_stack([np.full(40, 8.0), np.linspace(0.5, 14.5, 40), np.full(40, height_m)])
    over = (CREST_Z_M + 0.05 - height_m) / (CREST_X_M - 8.0)
    on_wall = np.column_stack([np.full(40, 15.0), path[:, 1], np.full(40, height_m + 7.0 * over)])
    in_front = np.column_stack([np.full(40, 6.0), path[:, 1], np.full(40, height_m - 6.0)])
    ends = np.concatenate([in_front, on_wall] if beams_to_wall else [in_front, in_front])
    scan = np.tile(np.arange(40), 2)
    return PointMap(
        points_map=np.repeat(ends, 2, axis=0),
        keyframe_id=np.repeat(scan, 2),
        range_m=np.ones(160),
        path_map=path,
        scan_index=np.repeat(scan, 2),
    )


def laid(seen: Array, of: PointMap, noise_m: float = 0.03) -> Shadow:
    z = carried_on()
    state = np.where(seen, CellState.SEEN, CellState.UNSEEN).astype(np.int8)
    gap = ndimage.distance_transform_edt(~seen) * CELL_M
    flat = np.zeros(GRID.shape)
    surface = Surface(z_m=z, carried_m=z, state=state, gap_m=gap, slope_x=flat, slope_y=flat)
    return lay_hidden(of, GRID, surface, np.zeros(GRID.shape), noise_m)


def test_behind_a_crest_it_is_laid_between_sight_and_the_steepest_fall() -> None:
    shadow = laid(X < CREST_X_M, point_map(7.0))
    middle = np.argmin(np.abs(GRID.y_m - 7.5))
    at = np.argmin(np.abs(GRID.x_m - 13.1))
    behind_m = GRID.x_m[at] - CREST_X_M
    z, sigma = shadow.surface.z_m[middle, at], shadow.sigma_m[middle, at]
    sight, fallen = CREST_Z_M - behind_m * 0.95 / 3.0, CREST_Z_M - behind_m * STEEPEST_FALL
    assert fallen < z < sight < carried_on()[middle, at]
    assert z == pytest.approx((sight + fallen) / 2, abs=0.25)
    assert sigma == pytest.approx((sight - fallen) / np.sqrt(12.0), abs=0.1)
    assert shadow.surface.z_m[middle, 30] == carried_on()[middle, 30]


def test_what_lies_in_sight_and_was_only_not_hit_stays_as_it_is() -> None:
    """From high above the crest the sensor's steep beams look behind it."""
    shadow = laid(X < CREST_X_M, point_map(14.0, beams_to_wall=False))
    assert (shadow.surface.z_m == carried_on())[Y > 2.0].all()


def test_nothing_lies_where_beams_passed() -> None:
    """Seen from high above nothing is hidden; but what is carried on beyond the crest stands in the way of beams."""
    shadow = laid(X < CREST_X_M, point_map(14.0))
    middle, at = np.argmin(np.abs(GRID.y_m - 7.5)), np.argmin(np.abs(GRID.x_m - 12.1))
    passed = 14.0 + (GRID.x_m[at] - 8.0) * (CREST_Z_M + 0.05 - 14.0) / 3.0
    assert shadow.surface.z_m[middle, at] < carried_on()[middle, at] - 1.0
    assert shadow.surface.z_m[middle, at] >= max(passed, CREST_Z_M - STEEPEST_FALL * (GRID.x_m[at] - CREST_X_M)) - 0.15
    assert not shadow.sigma_m[middle, at]


def test_right_before_a_wall_where_noise_blurs_beams_it_is_lowered_as_on_the_way_there() -> None:
    shadow = laid(X < CREST_X_M, point_map(14.0), noise_m=0.3)
    middle = np.argmin(np.abs(GRID.y_m - 7.5))
    lowered = (carried_on() - shadow.surface.z_m)[middle]
    on_way, before_wall = (np.argmin(np.abs(GRID.x_m - x)) for x in (13.6, 14.6))
    assert lowered[on_way] > 1.0
    assert lowered[before_wall] >= lowered[on_way] - 0.01


def test_gap_with_seen_places_all_around_stays_as_it_is() -> None:
    seen = (np.abs(X - 12.5) > 0.6) | (np.abs(Y - 7.5) > 2.0)
    shadow = laid(seen, point_map(7.0, beams_to_wall=False))
    assert (shadow.surface.z_m == carried_on()).all()
    assert not shadow.sigma_m.any()


def heap(seen: Array, *, falling_side: bool = False) -> tuple[Surface, Shadow]:
    """A cone with its peak at (7.5, 7.5) under a lid over what was not seen; falling_side: one flank falls into the gap."""
    r = np.maximum(np.hypot(X - 7.5, Y - 7.5), 1e-9)
    cone = 5.0 - SLOPE * r
    z = np.where(seen, cone, cone[seen].max())
    slope_x, slope_y = -SLOPE * (X - 7.5) / r, -SLOPE * (Y - 7.5) / r
    if falling_side:
        slope_x = np.where(X > 7.5, SLOPE, slope_x)
    state = np.where(seen, CellState.SEEN, CellState.INTERPOLATED).astype(np.int8)
    gap = ndimage.distance_transform_edt(~seen) * CELL_M
    surface = Surface(z_m=z, carried_m=z, state=state, gap_m=gap, slope_x=slope_x, slope_y=slope_y)
    angle = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    path, ends = (
        np.column_stack([7.5 + r * np.cos(angle), 7.5 + r * np.sin(angle), np.full(40, h)])
        for r, h in ((6.0, 5.2), (7.0, 0.8))
    )
    scan = np.arange(40)
    of = PointMap(points_map=ends, keyframe_id=scan, range_m=np.ones(40), path_map=path, scan_index=scan)
    return surface, lay_hidden(of, GRID, surface, np.full(GRID.shape, -10.0), 0.03)


def test_summit_that_was_not_seen_is_laid_between_a_lid_and_its_flanks_going_on() -> None:
    seen = np.hypot(X - 7.5, Y - 7.5) > 1.5
    lid, shadow = heap(seen)
    peak = np.argmin(np.abs(GRID.x_m - 7.5))
    rise = shadow.surface.z_m - lid.z_m
    assert rise[peak, peak] == pytest.approx(0.5 * SLOPE * 1.4, abs=0.12)
    assert shadow.sigma_m[peak, peak] == pytest.approx(SLOPE * 1.4 / np.sqrt(12.0), abs=0.08)
    assert (rise[seen] == 0.0).all()
    assert not shadow.sigma_m[seen].any()
    cone_m = np.maximum(5.0 - SLOPE * np.hypot(X - 7.5, Y - 7.5) - lid.z_m, 0.0)[~seen]
    assert 0.35 * cone_m.sum() < rise.sum() < 0.65 * cone_m.sum()


def test_gap_that_a_flank_falls_into_is_no_summit() -> None:
    lid, shadow = heap(np.hypot(X - 7.5, Y - 7.5) > 1.5, falling_side=True)
    assert (shadow.surface.z_m == lid.z_m).all()
    assert not shadow.sigma_m.any()


def test_small_hole_in_a_summit_stays_as_it_is() -> None:
    lid, shadow = heap(np.hypot(X - 7.5, Y - 7.5) > 0.3)
    assert (shadow.surface.z_m == lid.z_m).all()


def test_map_that_does_not_tell_where_it_was_seen_from_stays_as_it_is() -> None:
    of = point_map(7.0)
    without = PointMap(
        points_map=of.points_map, keyframe_id=of.keyframe_id, range_m=of.range_m, path_map=np.zeros((0, 3))
    )
    shadow = laid(X < CREST_X_M, without)
    assert (shadow.surface.z_m == carried_on()).all()
