"""Noise along the beam, taken out of the surface: each return counts where its beam meets the surface, not where it came.

A return lies off the surface along its beam. Gathered by where they came, returns of a crease are mixed with those of both
its sides, and where one side sends more of them than the other, even a straight slope is moved (a tip is lowered, a foot is
filled: 0.2 % of a cone in a silo at a noise of 0.12 m). Where the beam meets the surface does not depend on the noise; among
the returns that belong to one place by that, the error along the beam has mean zero, and what mean it has is the surface's.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from companion.jit import kernel
from companion.messages import Array, PointMap
from companion.volume.grid import Grid, Index, Mask, cells_of, disc, local_planes
from companion.volume.surface import MIN_POINTS, Cells

PASSES = 3  # the surface moves by less than a millimetre in the fourth
STEPS = 3  # of a beam's way to the surface
FURTHEST_SIGMA = 4.0  # a return farther from the surface is not of it
GRAZING = 0.1  # least change of height above the surface for a metre of beam
LEAST_NOISE_M = 0.005
LEAST_BEAMS = 2  # that meet a cell, for a height of it: one alone is as far off as its noise
BRIDGED_M = 0.75  # to either side of a cell
WHOLE_SIGMA = 3.0  # so near to where returns were left out, some that belong to a cell are missing


def where_beams_meet(point_map: PointMap, cells: Cells, grid: Grid, wanted: Mask, noise_m: float) -> Cells:
    """The same cells with heights free of the noise along the beams; as they are where the map does not tell the beams.

    wanted: (ny, nx) cells whose returns were given to `cells`. noise_m: 1 sigma of a range.
    """
    if point_map.scan_index is None or noise_m < LEAST_NOISE_M:
        return cells
    index = np.flatnonzero(cells.of_point >= 0)
    points = np.ascontiguousarray(point_map.points_map[index])
    beams = points - point_map.path_map[point_map.scan_index[index]]
    beams /= np.maximum(np.linalg.norm(beams, axis=1), 1e-9)[:, None]
    reach = int(np.ceil(WHOLE_SIGMA * noise_m / grid.cell_m))
    whole = ndimage.binary_erosion(wanted, iterations=reach) & cells.seen
    cell_of, place, met = cells.of_point[index], np.array([grid.x0_m, grid.y0_m, grid.cell_m]), cells
    for _ in range(PASSES):
        planes = local_planes(grid, met.x, met.y, met.z, np.minimum(met.kept, 20.0), radius_cells=1)
        known = np.isfinite(planes.z_m) & met.seen
        sums, cell, above = _gather(
            points, beams, cell_of, known, planes.z_m, planes.slope_x, planes.slope_y, place, FURTHEST_SIGMA * noise_m,
        )  # fmt: skip
        met = _moved(met, sums, grid, whole)
    meets_in, above_m = np.full(len(cells.of_point), -1, dtype=np.int64), np.zeros(len(cells.of_point))
    meets_in[index], above_m[index] = cell, above
    with np.errstate(invalid="ignore", divide="ignore"):
        sigma = np.where(met.seen, cells.sigma_m * np.sqrt(cells.kept / met.kept), np.nan)
    return replace(met, sigma_m=sigma, meets_in=meets_in, above_m=above_m)


def _moved(cells: Cells, sums: Array, grid: Grid, whole: Mask) -> Cells:
    n = sums[..., 0]
    with np.errstate(invalid="ignore", divide="ignore"):
        x, y, z = (sums[..., k] / n for k in (1, 2, 3))
    use = whole & (n >= LEAST_BEAMS)
    # Between two that beams meet, what came where none does was thrown there by its noise: a straight line is better.
    # Wider gaps may hide a foot, which no straight line follows.
    none = whole & ~use & ndimage.binary_closing(use, disc(cells_of(BRIDGED_M, grid)))
    cx, cy = grid.centres()
    return replace(
        cells,
        x=np.where(none, np.nan, np.where(use, x + cx, cells.x)),
        y=np.where(none, np.nan, np.where(use, y + cy, cells.y)),
        z=np.where(none, np.nan, np.where(use, z, cells.z)),
        kept=np.where(none, 0.0, np.where(use, np.maximum(n, MIN_POINTS), cells.kept)),
    )


@kernel
def _gather(
    points: Array,
    beams: Array,
    cell_of: Index,
    known: NDArray[np.bool_],
    z: Array,
    slope_x: Array,
    slope_y: Array,
    grid: Array,
    furthest_m: float,
) -> tuple[Array, Index, Array]:
    """(ny, nx, 4): how many beams meet each cell; times that: their mean place from its centre (2) and height. (N,): flat cell
    in which each beam meets the surface, -1 where it does not; how far its return then lies above the plane, m.

    points, beams: (N, 3), unit. cell_of: (N,) flat cells where they came. known, z, slope_x, slope_y: (ny, nx) planes at the
    cells' centres. grid: x0, y0, cell.
    """
    ny, nx = z.shape
    sums = np.zeros((ny, nx, 4))
    cell, over = np.full(len(points), -1), np.zeros(len(points))
    for n in range(len(points)):
        i, j = cell_of[n] // nx, cell_of[n] % nx
        if not known[i, j]:
            continue
        along = 0.0  # from the return to where its beam meets the surface
        rate, lost = 0.0, False
        for _ in range(STEPS):
            x = points[n, 0] + along * beams[n, 0]
            y = points[n, 1] + along * beams[n, 1]
            dx, dy = x - (grid[0] + (j + 0.5) * grid[2]), y - (grid[1] + (i + 0.5) * grid[2])
            above = points[n, 2] + along * beams[n, 2] - z[i, j] - slope_x[i, j] * dx - slope_y[i, j] * dy
            rate = beams[n, 2] - slope_x[i, j] * beams[n, 0] - slope_y[i, j] * beams[n, 1]
            if rate > -GRAZING:
                lost = True
                break
            along -= above / rate
            if abs(along) > furthest_m:
                lost = True
                break
            to_j = int(np.floor((points[n, 0] + along * beams[n, 0] - grid[0]) / grid[2]))
            to_i = int(np.floor((points[n, 1] + along * beams[n, 1] - grid[1]) / grid[2]))
            if not (0 <= to_i < ny and 0 <= to_j < nx and known[to_i, to_j]):
                lost = True
                break
            i, j = to_i, to_j
        if lost:
            continue
        dx = points[n, 0] + along * beams[n, 0] - (grid[0] + (j + 0.5) * grid[2])
        dy = points[n, 1] + along * beams[n, 1] - (grid[1] + (i + 0.5) * grid[2])
        sums[i, j, 0] += 1.0
        sums[i, j, 1] += dx
        sums[i, j, 2] += dy
        sums[i, j, 3] += z[i, j] + slope_x[i, j] * dx + slope_y[i, j] * dy - along * rate
        cell[n], over[n] = i * nx + j, -along * rate
    return sums, cell, over
