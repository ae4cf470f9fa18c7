"""What a crest hides: behind it the surface lies somewhere between where sight ends and the steepest fall of material.

Heights between seen places are linear, and carried on at the walls: behind a crest both are as high as the surface can be
without being seen, or higher than beams that passed there. Loose material falls behind its crest as in front of it. So what
is hidden is laid in the middle of what it can be, and the interval is told how far apart the ends are. So are summits too near the
sensor's own height to give anything back: between a lid over what was seen around them and their flanks going on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from companion.jit import kernel
from companion.messages import Array, PointMap
from companion.volume.grid import Grid, Index, Mask
from companion.volume.surface import CellState, Surface

STEEPEST_FALL = 0.84  # 40 deg: angle of repose of coarse bulk
APART_M = 2.5  # between the places of the path that are looked from
LEAST_PLACES = 4
LOOK_M = 12.0  # from farther off the sensor's few layers leave gaps of their own
PASSED_M = 8.0  # of a beam before its end: what it passed over at the walls and behind crests
PASSED_NOISE_M = 0.05  # the lowest of many beams is low by as much
AROUND_M = 6.0  # looked for seen places
SIDES = 16
HIDDEN_M = 0.15  # a fall of less is within what interpolation errs by
STEEPEST_BEAM_QUANTILE = 0.995


@dataclass(frozen=True, slots=True, kw_only=True)
class Shadow:
    """surface: with what is hidden laid in the middle. sigma_m: (ny, nx) 1 sigma of its height there, one error for each
    patch; 0 elsewhere."""

    surface: Surface
    sigma_m: Array


def lay_hidden(point_map: PointMap, grid: Grid, surface: Surface, floor_z: Array, noise_m: float) -> Shadow:
    """Lower what was not seen, where it could not be seen. Maps without a path are left as they are.

    floor_z: (ny, nx). noise_m: 1 sigma of a range.
    """
    nothing = Shadow(surface=surface, sigma_m=np.zeros(grid.shape))
    seen: Mask = np.asarray(surface.gap_m == 0.0)
    gaps = ~seen & (surface.state != CellState.OUTSIDE) & (surface.z_m - floor_z > HIDDEN_M)
    places = _places(point_map)
    if not gaps.any() or len(places) < LEAST_PLACES or not seen.any():
        return nothing
    rows, columns = np.nonzero(gaps)
    z, floor = surface.z_m[gaps], floor_z[gaps]
    blocking = np.where(seen, surface.z_m, -np.inf)
    reach = np.minimum(2.0 * surface.gap_m[gaps] + 1.0, AROUND_M)
    least, is_enclosed = _around(rows, columns, blocking, reach, grid.cell_m)
    lowest = np.minimum(np.maximum(floor, least), z)
    origin = np.array([grid.x0_m, grid.y0_m, 0.0])
    at = np.column_stack([grid.x_m[columns], grid.y_m[rows]]) - origin[:2]
    in_sight = _sight_ends(at, places - origin, blocking, grid.cell_m, _steepest_beam(point_map))
    scan = point_map.scan_index
    assert scan is not None
    path = point_map.path_map - origin
    passed = _passed(point_map.points_map - origin, path, scan, grid.shape, grid.cell_m, 3.0 * noise_m)[gaps]
    highest = np.maximum(np.minimum(z, passed), lowest)
    too_high = np.maximum(z - highest - PASSED_NOISE_M, 0.0)
    on_way = np.where(is_enclosed, 0.0, _on_way(too_high, gaps, seen))
    highest = np.where(on_way > too_high, np.maximum(z - on_way - PASSED_NOISE_M, lowest), highest)
    is_hidden = ~is_enclosed & (np.minimum(highest, in_sight) - lowest > HIDDEN_M)
    rise = _summits(surface, gaps, seen, grid, np.where(is_enclosed, passed, -np.inf))
    z_m, sigma_m = surface.z_m.copy(), np.zeros(grid.shape)
    z_m[gaps] = np.where(is_hidden, 0.5 * (highest + lowest), np.minimum(z, highest + PASSED_NOISE_M) + 0.5 * rise)
    sigma_m[gaps] = np.where(is_hidden, highest - lowest, rise) / math.sqrt(12.0)
    return Shadow(surface=replace(surface, z_m=z_m), sigma_m=sigma_m)


def _on_way(too_high_m: Array, gaps: Mask, seen: Mask) -> Array:
    """By what each of the gaps' cells is too high at least, since what is carried on to it from the nearest seen cell is too
    high by that on the way. (Right before a wall beams do not tell: their ends are blurred by noise.)

    too_high_m: of the gaps, by the beams that passed.
    """
    _, (i, j) = ndimage.distance_transform_edt(~seen, return_indices=True)
    rows, columns = np.nonzero(gaps)
    of_cell, most = np.zeros(gaps.shape), np.zeros(len(rows))
    of_cell[gaps] = too_high_m
    for part in (0.25, 0.5, 0.75):
        row = np.rint(rows + part * (i[rows, columns] - rows)).astype(np.int64)
        column = np.rint(columns + part * (j[rows, columns] - columns)).astype(np.int64)
        most = np.maximum(most, of_cell[row, column])
    return most


def _summits(surface: Surface, gaps: Mask, seen: Mask, grid: Grid, passed: Array) -> Array:
    """By how much each of the gaps' cells may lie higher than a plain lid over what was seen: as high as the flanks on all
    sides let it, going on, and beams that passed. The sensor looks level at best, and a summit near its own height gives
    nothing back.

    passed: of the gaps, -inf where none may rise. Returns: of the gaps; 0 in patches that rise by less than HIDDEN_M.
    """
    x, y = grid.centres()
    limit, rise = np.full(grid.shape, -np.inf), np.zeros(grid.shape)
    limit[gaps] = passed
    bound = np.minimum(1.0, STEEPEST_FALL / np.maximum(np.hypot(surface.slope_x, surface.slope_y), 1e-9))
    patches, _ = ndimage.label(limit > -np.inf)
    for n, box in enumerate(ndimage.find_objects(patches), start=1):
        around = tuple(slice(max(0, side.start - 1), side.stop + 1) for side in box)
        patch = patches[around] == n
        rim = ndimage.binary_dilation(patch, np.ones((3, 3), dtype=np.bool_)) & seen[around]
        flanks = (v[around][rim] for v in (surface.z_m, bound * surface.slope_x, bound * surface.slope_y, x, y))
        up, at_x, at_y, lid = (v[around][patch] for v in (limit, x, y, surface.z_m))
        for z, to_x, to_y, from_x, from_y in zip(*flanks, strict=True):
            up = np.minimum(up, z + to_x * (at_x - from_x) + to_y * (at_y - from_y))
        up = np.maximum(up - lid, 0.0)
        if rim.any() and up.max() > HIDDEN_M:
            rise[around][patch] = up
    return rise[gaps]


def _places(point_map: PointMap) -> Array:
    """Of the path that the map was seen from, (P, 3), thinned."""
    if point_map.scan_index is None:
        return np.zeros((0, 3))
    path = point_map.path_map[np.unique(point_map.scan_index)]
    path = path[np.isfinite(path).all(axis=1)]
    _, first = np.unique(np.floor(path[:, :2] / APART_M), axis=0, return_index=True)
    return path[np.sort(first)]


def _steepest_beam(point_map: PointMap) -> float:
    """Fall of the sensor's steepest beams for each metre in plan: what lies below it was not looked at."""
    assert point_map.scan_index is not None
    index = np.arange(0, len(point_map.points_map), max(1, len(point_map.points_map) // 20_000))
    beam = point_map.points_map[index] - point_map.path_map[point_map.scan_index[index]]
    fall = -beam[:, 2] / np.maximum(np.hypot(beam[:, 0], beam[:, 1]), 1e-3)
    return float(np.quantile(fall, STEEPEST_BEAM_QUANTILE))


@kernel
def _around(rows: Index, columns: Index, blocking: Array, reach_m: Array, cell_m: float) -> tuple[Array, Mask]:
    """For each cell: (N,) the lowest that it can be, no fall from a seen cell being steeper than material lies; and whether
    seen cells lie all around it, within reach_m (N,)."""
    ny, nx = blocking.shape
    lowest, is_enclosed = np.full(len(rows), -np.inf), np.zeros(len(rows), dtype=np.bool_)
    wide = int(AROUND_M / cell_m)
    for n in range(len(rows)):
        sides = np.zeros(SIDES, dtype=np.bool_)
        for i in range(max(0, rows[n] - wide), min(ny, rows[n] + wide + 1)):
            for j in range(max(0, columns[n] - wide), min(nx, columns[n] + wide + 1)):
                if blocking[i, j] == -np.inf:
                    continue
                di, dj = i - rows[n], j - columns[n]
                way = math.sqrt(di * di + dj * dj) * cell_m
                lowest[n] = max(lowest[n], blocking[i, j] - STEEPEST_FALL * way)
                if way <= reach_m[n]:
                    sides[int((math.atan2(di, dj) / (2.0 * math.pi) + 1.0) * SIDES) % SIDES] = True
        empty, most = 0, 0
        for side in range(2 * SIDES):
            empty = 0 if sides[side % SIDES] else empty + 1
            most = max(most, empty)
        is_enclosed[n] = most < SIDES // 2
    return lowest, is_enclosed


@kernel
def _sight_ends(at: Array, places: Array, blocking: Array, cell_m: float, steepest: float) -> Array:
    """(N,) lowest height that is in sight from any of the places (P, 3) above each of `at` (N, 2), over what blocks (ny, nx);
    inf where none looks there."""
    ny, nx = blocking.shape
    out = np.full(len(at), np.inf)
    for n in range(len(at)):
        for p in range(len(places)):
            dx, dy, z = at[n, 0] - places[p, 0], at[n, 1] - places[p, 1], places[p, 2]
            way = math.sqrt(dx * dx + dy * dy)
            steps = int(way / cell_m)
            if steps < 2 or way > LOOK_M:
                continue
            end = z - steepest * way
            for k in range(1, steps):
                part = k / steps
                i = int((places[p, 1] + part * dy) / cell_m)
                j = int((places[p, 0] + part * dx) / cell_m)
                if 0 <= i < ny and 0 <= j < nx:
                    end = max(end, z + (blocking[i, j] - z) / part)
            out[n] = min(out[n], end)
    return out


@kernel
def _passed(points: Array, path: Array, scan: Index, shape: tuple[int, int], cell_m: float, blurred_m: float) -> Array:
    """(ny, nx) second lowest height at which a beam passed over each cell on its last PASSED_M; inf where fewer did.

    blurred_m: before its end, where noise may have carried it below the surface.
    """
    ny, nx = shape
    lowest, second = np.full((ny, nx), np.inf), np.full((ny, nx), np.inf)
    for n in range(len(points)):
        fx, fy, fz = path[scan[n], 0], path[scan[n], 1], path[scan[n], 2]
        dx, dy, dz = points[n, 0] - fx, points[n, 1] - fy, points[n, 2] - fz
        way = math.sqrt(dx * dx + dy * dy)
        for k in range(1, int(min(PASSED_M, way) / cell_m)):
            if k * cell_m < blurred_m:
                continue
            part = 1.0 - k * cell_m / way
            i, j = int((fy + part * dy) / cell_m), int((fx + part * dx) / cell_m)
            if not (0 <= i < ny and 0 <= j < nx):
                continue
            z = fz + part * dz
            if z < lowest[i, j]:
                lowest[i, j], second[i, j] = z, lowest[i, j]
            elif z < second[i, j]:
                second[i, j] = z
    return second
