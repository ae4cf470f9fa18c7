"""The plan grid that walls, floor and surface share, and moments over it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from companion.messages import Array

Mask = NDArray[np.bool_]
Index = NDArray[np.int64]

MAX_CELLS = 4_000_000  # bounds memory: 4 million cells of 0.25 m are 500 x 500 m


@dataclass(frozen=True, slots=True, kw_only=True)
class Grid:
    """Square cells in plan. Arrays over it are (ny, nx); cell [0, 0] has its corner at (x0_m, y0_m)."""

    x0_m: float
    y0_m: float
    cell_m: float
    nx: int
    ny: int

    @property
    def x_m(self) -> Array:
        """(nx,) cell centres."""
        return np.asarray(self.x0_m + (np.arange(self.nx) + 0.5) * self.cell_m, dtype=np.float64)

    @property
    def y_m(self) -> Array:
        """(ny,) cell centres."""
        return np.asarray(self.y0_m + (np.arange(self.ny) + 0.5) * self.cell_m, dtype=np.float64)

    @property
    def shape(self) -> tuple[int, int]:
        return self.ny, self.nx

    @property
    def cell_area_m2(self) -> float:
        return self.cell_m * self.cell_m

    def centres(self) -> tuple[Array, Array]:
        """x and y of every cell centre, each (ny, nx)."""
        x, y = np.meshgrid(self.x_m, self.y_m)
        return x, y

    def key(self, points: Array) -> Index:
        """Flat cell index of each point, -1 where it lies outside the grid."""
        ix = np.floor((points[:, 0] - self.x0_m) / self.cell_m).astype(np.int64)
        iy = np.floor((points[:, 1] - self.y0_m) / self.cell_m).astype(np.int64)
        outside = (ix < 0) | (ix >= self.nx) | (iy < 0) | (iy >= self.ny)
        key = iy * self.nx + ix
        key[outside] = -1
        return key

    def count(self, key: Index) -> Array:
        """How many of the (valid) keys fall in each cell, (ny, nx)."""
        return np.bincount(key[key >= 0], minlength=self.nx * self.ny).astype(np.float64).reshape(self.shape)


def grid_around(points: Array, cell_m: float, *, margin_m: float = 2.0) -> Grid:
    """The grid that holds the points; far strays (outermost 0.05 % on each side, when far away) do not stretch it."""
    low, high = np.quantile(points[:, :2], [0.0005, 0.9995], axis=0, method="nearest")
    reach = 0.1 * (high - low) + margin_m
    low = np.maximum(points[:, :2].min(axis=0), low - reach) - margin_m
    high = np.minimum(points[:, :2].max(axis=0), high + reach) + margin_m
    while (high - low).prod() / cell_m**2 > MAX_CELLS:
        cell_m *= 2.0
    low = np.floor(low / cell_m) * cell_m
    nx, ny = (int(n) for n in np.ceil((high - low) / cell_m))
    return Grid(x0_m=float(low[0]), y0_m=float(low[1]), cell_m=cell_m, nx=max(nx, 1), ny=max(ny, 1))


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalPlanes:
    """Plane fitted to the cells around each cell: height at the cell's centre, slopes, and how many cells it used.

    All (ny, nx); NaN where fewer than 3 cells, or cells on one line, were near.
    """

    z_m: Array
    slope_x: Array
    slope_y: Array
    cells: Array
    residual_m: Array


def local_planes(grid: Grid, x: Array, y: Array, z: Array, weight: Array, *, radius_cells: int) -> LocalPlanes:
    """Weighted least squares plane in a square window about every cell.

    x, y, z: (ny, nx) where each cell's own height was taken (its centroid); weight: (ny, nx), 0 where there is none.
    """
    size = 2 * radius_cells + 1
    cx, cy = grid.centres()
    known = weight > 0
    dx = np.where(known, x - cx, 0.0)
    dy = np.where(known, y - cy, 0.0)
    z_ref = float(np.mean(z[known])) if known.any() else 0.0
    dz = np.where(known, z - z_ref, 0.0)
    px = np.where(known, cx + dx - grid.x0_m, 0.0)
    py = np.where(known, cy + dy - grid.y0_m, 0.0)

    def total(values: Array) -> Array:
        return np.asarray(ndimage.uniform_filter(values, size, mode="constant")) * size * size

    w = total(weight)
    w_safe = np.where(w > 1e-9, w, 1.0)
    mx, my, mz = (total(weight * v) / w_safe for v in (px, py, dz))
    sxx = total(weight * px * px) / w_safe - mx * mx
    syy = total(weight * py * py) / w_safe - my * my
    sxy = total(weight * px * py) / w_safe - mx * my
    sxz = total(weight * px * dz) / w_safe - mx * mz
    syz = total(weight * py * dz) / w_safe - my * mz
    szz = total(weight * dz * dz) / w_safe - mz * mz
    determinant = sxx * syy - sxy * sxy
    usable = (w > 1e-9) & (determinant > (0.15 * grid.cell_m) ** 4)
    d = np.where(usable, determinant, 1.0)
    gx = (sxz * syy - syz * sxy) / d
    gy = (syz * sxx - sxz * sxy) / d
    z_centre = z_ref + mz + gx * (cx - grid.x0_m - mx) + gy * (cy - grid.y0_m - my)
    residual = np.sqrt(np.maximum(szz - gx * sxz - gy * syz, 0.0))
    nan = np.nan
    return LocalPlanes(
        z_m=np.where(usable, z_centre, nan),
        slope_x=np.where(usable, gx, nan),
        slope_y=np.where(usable, gy, nan),
        cells=np.rint(total(known.astype(np.float64))),
        residual_m=np.where(usable, residual, nan),
    )


def disc(radius_cells: int) -> Mask:
    """Structuring element: all cells whose centre lies within the radius."""
    r = np.arange(-radius_cells, radius_cells + 1)
    return np.asarray(r[:, None] ** 2 + r[None, :] ** 2 <= radius_cells**2 + 0.5)


def cells_of(length_m: float, grid: Grid) -> int:
    """A length in whole cells, at least 1."""
    return max(1, int(np.ceil(length_m / grid.cell_m - 1e-9)))


def squares(grid: Grid, side_m: float) -> Index:
    """(ny, nx): the number of the square of that side that each cell lies in."""
    side = cells_of(side_m, grid)
    row, column = np.indices(grid.shape) // side
    return np.asarray(row * (column.max() + 1) + column)
