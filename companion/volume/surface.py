"""The surface: one robust height for each cell (so that dense places weigh no more than thin ones), linear between."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from companion.messages import Array
from companion.volume.grid import Grid, Index, LocalPlanes, Mask, cells_of, disc, local_planes
from companion.volume.linear import linear_on_grid

LAYER_GAP_M = 1.0  # emptiness over one cell that parts the surface from what hangs in the air above it
MIN_POINTS = 3  # a cell with fewer is not seen
MAX_SLOPE = 1.2  # of an extrapolated surface: just above the steepest angle of repose of stored bulk (50 deg)


class CellState(IntEnum):
    """How a cell's height is known."""

    OUTSIDE = 0
    SEEN = 1
    INTERPOLATED = 2
    UNSEEN = 3


@dataclass(frozen=True, slots=True, kw_only=True)
class Cells:
    """Robust height of each cell: mean of its kept returns, at their centroid. All (ny, nx); NaN where not seen.

    sigma_m: 1 sigma of z from the spread of the returns. kept: how many returns. dropped_ratio: share of all returns
    that hung in the air or lay far off the surface. of_point: for each point its cell when kept, else -1.
    meets_in, above_m: (N,) cell in which each kept point's beam meets the surface, -1 for none, and how far the point then
    lies above it; None where no beams were told.
    """

    x: Array
    y: Array
    z: Array
    sigma_m: Array
    kept: Array
    dropped_ratio: float
    of_point: Index
    meets_in: Index | None = None
    above_m: Array | None = None

    @property
    def seen(self) -> Mask:
        return self.kept >= MIN_POINTS


def robust_cells(points: Array, key: Index, grid: Grid) -> Cells:
    """One height for each cell from the points whose key is not -1.

    The lowest layer of a cell that is more than strays is the surface; about it, returns beyond 3.5 robust sigma of
    the local plane are dropped on both sides alike, and the mean of the rest is unbiased by noise along the ray.
    """
    index = np.flatnonzero(key >= 0)
    index = index[np.lexsort((points[index, 2], key[index]))]
    in_cell = np.bincount(key[index], minlength=grid.nx * grid.ny)
    index = index[_lowest_layer(key[index], points[index, 2], in_cell)]
    index = index[~_hanging(_medians(key[index], points[index, 2], grid), grid).ravel()[key[index]]]
    k, p = key[index], points[index]
    x, y, z, n = _means(p, k, grid, np.ones(len(k), dtype=np.bool_))
    median = _medians(k, p[:, 2], grid)
    planes = local_planes(grid, x, y, median, np.where(n >= MIN_POINTS, 1.0, 0.0), radius_cells=1)
    gx, gy = (np.nan_to_num(g).ravel() for g in (planes.slope_x, planes.slope_y))
    r = p[:, 2] - median.ravel()[k] - gx[k] * (p[:, 0] - x.ravel()[k]) - gy[k] * (p[:, 1] - y.ravel()[k])
    scale = _scale(r, k, grid, n)
    keep = (np.abs(r) < 3.5 * scale.ravel()[k]) & ~_upright(scale, n, grid).ravel()[k]
    x, y, z, n = _means(p, k, grid, keep)
    flat = n.ravel()
    square = np.bincount(k[keep], (r[keep]) ** 2, minlength=flat.size) / np.maximum(flat, 1.0)
    # Few returns tell their own spread badly: lean on the neighbourhood's.
    spread = np.maximum(np.sqrt(square).reshape(grid.shape), 0.5 * scale)
    of_point = np.full(len(points), -1, dtype=np.int64)
    of_point[index[keep]] = k[keep]
    # Judged where enough came back to judge by.
    full = in_cell >= 2 * MIN_POINTS
    total = int(in_cell[full].sum())
    return Cells(
        x=x,
        y=y,
        z=z,
        sigma_m=np.where(n > 0, spread / np.sqrt(np.maximum(n, 1.0)), np.nan),
        kept=n,
        dropped_ratio=1.0 - float(flat[full].sum()) / total if total else 0.0,
        of_point=of_point,
    )


def without_strays(cells: Cells, grid: Grid, where: Mask) -> Cells:
    """Cells within `where` that stand above, or sink below, most of their neighbours by more than any slope of loose
    material are taken out: beside a wall, where the material itself is hidden, a few stray returns of it make such."""
    z = np.where(cells.seen, cells.z, np.nan)
    reach = cells_of(0.75, grid)
    padded = np.pad(z, reach, constant_values=np.nan)
    off, known = np.zeros(grid.shape), np.zeros(grid.shape)
    for i, j in np.argwhere(disc(reach)) - reach:
        if i == j == 0:
            continue
        beside = padded[reach + i : reach + i + grid.ny, reach + j : reach + j + grid.nx]
        apart = np.abs(z - beside)
        known += np.isfinite(apart)
        with np.errstate(invalid="ignore"):
            off += apart > MAX_SLOPE * np.hypot(i, j) * grid.cell_m + 0.3
    stray = where & (off > 0.5 * known)
    of_point = np.where((cells.of_point >= 0) & stray.ravel()[np.maximum(cells.of_point, 0)], -1, cells.of_point)
    return replace(
        cells,
        x=np.where(stray, np.nan, cells.x),
        y=np.where(stray, np.nan, cells.y),
        z=np.where(stray, np.nan, cells.z),
        sigma_m=np.where(stray, np.nan, cells.sigma_m),
        kept=np.where(stray, 0.0, cells.kept),
        of_point=of_point,
    )


def _upright(scale: Array, n: Array, grid: Grid) -> Mask:
    """Cells whose returns spread in height as no surface's do: the rim of something upright. They are not believed."""
    usual = float(np.median(scale[n >= MIN_POINTS])) if (n >= MIN_POINTS).any() else 0.0
    return np.asarray(scale > max(0.25, 0.5 * grid.cell_m, 5.0 * usual))


def _hanging(z: Array, grid: Grid) -> Mask:
    """Cells that hang higher above their surroundings than any slope of loose material reaches: dust over floor that
    was not seen. By opening: what stands up and is narrower than the window goes."""
    reach = cells_of(1.0, grid)
    window = disc(reach)
    known = np.isfinite(z)
    lowest = ndimage.grey_erosion(np.where(known, z, np.inf), footprint=window, mode="constant", cval=np.inf)
    opened = ndimage.grey_dilation(
        np.where(np.isfinite(lowest), lowest, -np.inf), footprint=window, mode="constant", cval=-np.inf
    )
    with np.errstate(invalid="ignore"):
        return np.asarray(known & (z - opened > MAX_SLOPE * reach * grid.cell_m + 0.3))


def _lowest_layer(key: Index, z: Array, in_cell: Index) -> Mask:
    """Of points sorted by cell and height: those of the lowest layer in each cell that is more than strays."""
    if len(key) == 0:
        return np.zeros(0, dtype=np.bool_)
    new_layer = np.ones(len(key), dtype=np.bool_)
    new_layer[1:] = (key[1:] != key[:-1]) | (np.diff(z) > LAYER_GAP_M)
    layer = np.cumsum(new_layer) - 1
    size = np.bincount(layer)
    cell = key[new_layer]
    solid = size >= np.maximum(MIN_POINTS, 0.05 * in_cell[cell])
    chosen = np.zeros(len(size), dtype=np.bool_)
    solid_layers = np.flatnonzero(solid)
    _, first = np.unique(cell[solid_layers], return_index=True)
    chosen[solid_layers[first]] = True
    return np.asarray(chosen[layer])


def _means(p: Array, key: Index, grid: Grid, keep: Mask) -> tuple[Array, Array, Array, Array]:
    cells = grid.nx * grid.ny
    k = key[keep]
    n = np.bincount(k, minlength=cells).astype(np.float64)
    with np.errstate(invalid="ignore"):
        x, y, z = (np.bincount(k, p[keep, i], minlength=cells) / np.where(n > 0, n, np.nan) for i in range(3))
    return x.reshape(grid.shape), y.reshape(grid.shape), z.reshape(grid.shape), n.reshape(grid.shape)


def _medians(key: Index, z: Array, grid: Grid) -> Array:
    """Median z of each cell; points sorted by cell, then z."""
    out = np.full(grid.nx * grid.ny, np.nan)
    if len(key):
        first = np.flatnonzero(np.append(True, key[1:] != key[:-1]))
        last = np.append(first[1:], len(key)) - 1
        out[key[first]] = 0.5 * (z[(first + last) // 2] + z[(first + last + 1) // 2])
    return out.reshape(grid.shape)


def _scale(r: Array, key: Index, grid: Grid, n: Array) -> Array:
    """Robust 1 sigma of the residuals in each cell, leaning on the neighbourhood where a cell has few."""
    order = np.lexsort((np.abs(r), key))
    mad = 1.4826 * _medians(key[order], np.abs(r)[order], grid)
    weight = np.minimum(np.where(np.isfinite(mad), n, 0.0), 20.0)
    size = 2 * cells_of(0.5, grid) + 1
    around = ndimage.uniform_filter(weight * np.nan_to_num(mad), size, mode="constant")
    around /= np.maximum(ndimage.uniform_filter(weight, size, mode="constant"), 1e-9)
    blend = np.minimum(n, 20.0) / 20.0
    return np.maximum(blend * np.nan_to_num(mad) + (1 - blend) * around, 0.005)


@dataclass(frozen=True, slots=True, kw_only=True)
class Surface:
    """Height at the centre of every cell inside the walls. All (ny, nx).

    z_m: NaN outside. carried_m: the same, carried on beyond the walls. state: CellState. gap_m: distance to the nearest
    seen cell. slope_x, slope_y: of the local plane.
    """

    z_m: Array
    carried_m: Array
    state: NDArray[np.int8]
    gap_m: Array
    slope_x: Array
    slope_y: Array


def build_surface(
    grid: Grid, cells: Cells, inside: Mask, strip: Mask, *, reach_m: float, strip_width_m: float
) -> Surface:
    """Linear between the seen cells (Delaunay), the local plane carried on into the strip along the walls.

    inside: cells to fill. strip: cells too near to a wall to trust their returns. Cells farther than reach_m from
    any seen one are filled all the same, and called unseen.
    """
    seen = cells.seen & ~strip
    # The wider the strip, the wider the base that the slope into it is taken from: noise asks for both alike.
    radius = cells_of(max(0.5, strip_width_m), grid)
    weight = np.where(seen, np.minimum(cells.kept, 20.0), 0.0)
    planes = local_planes(grid, cells.x, cells.y, cells.z, weight, radius_cells=radius)
    z = np.full(grid.shape, np.nan)
    gap = np.full(grid.shape, np.inf)
    if seen.any():
        gap, nearest = ndimage.distance_transform_edt(~seen, return_indices=True)
        gap = gap * grid.cell_m
        nodes = np.column_stack([cells.x[seen] - grid.x0_m, cells.y[seen] - grid.y0_m])
        z = linear_on_grid(nodes, cells.z[seen], grid.x_m - grid.x0_m, grid.y_m - grid.y0_m)
        carried = _carried_on(grid, cells, planes, nearest)
        z = np.where(strip | ~np.isfinite(z), carried, z)
    state = np.full(grid.shape, CellState.UNSEEN, dtype=np.int8)
    margin_gap = np.where(strip, gap <= reach_m + 1.0, gap <= reach_m)
    state[margin_gap] = CellState.INTERPOLATED
    state[seen | (strip & cells.seen & margin_gap)] = CellState.SEEN
    state[~inside] = CellState.OUTSIDE
    return Surface(
        z_m=np.where(inside, z, np.nan),
        carried_m=z,
        state=state,
        gap_m=gap,
        slope_x=np.nan_to_num(planes.slope_x),
        slope_y=np.nan_to_num(planes.slope_y),
    )


def _carried_on(grid: Grid, cells: Cells, planes: LocalPlanes, nearest: NDArray[np.integer]) -> Array:
    """Height at each cell centre on the plane about its nearest seen cell, its slope bounded."""
    i, j = nearest
    cx, cy = grid.centres()
    gx, gy = np.nan_to_num(planes.slope_x)[i, j], np.nan_to_num(planes.slope_y)[i, j]
    bound = np.minimum(1.0, MAX_SLOPE / np.maximum(np.hypot(gx, gy), 1e-9))
    base = np.where(np.isfinite(planes.z_m), planes.z_m, cells.z)[i, j]
    node_x = np.where(np.isfinite(planes.z_m), cx, cells.x)[i, j]
    node_y = np.where(np.isfinite(planes.z_m), cy, cells.y)[i, j]
    # Far beyond what was seen a slope says nothing more.
    dx, dy = cx - node_x, cy - node_y
    fade = np.minimum(1.0, 1.5 / np.maximum(np.hypot(dx, dy), 1e-9))
    return np.asarray(base + bound * fade * (gx * dx + gy * dy))
