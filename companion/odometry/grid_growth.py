"""How the maps' grids grow with what is seen."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.jit import kernel
from companion.messages import Array

MARGIN_CELLS = 64  # grown by at least this much at a time
MAX_CELLS = 4_000_000  # 36 hectares at 0.3 m; points beyond are left out


class Growth(NamedTuple):
    """shape: ny, nx of the new grid; held: where the old one lies in it; origin: (2,) its corner, map."""

    shape: tuple[int, int]
    held: tuple[slice, slice]
    origin: Array


@kernel
def _cells(points: Array, origin: Array, cell_m: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """(2,) the lowest and the highest x and y of points (N, 2), N > 0, in cells from the origin."""
    low, high = np.empty(2, np.int64), np.empty(2, np.int64)
    for k in range(2):
        least = most = points[0, k]
        for i in range(1, points.shape[0]):
            least, most = min(least, points[i, k]), max(most, points[i, k])
        low[k], high[k] = math.floor((least - origin[k]) / cell_m), math.floor((most - origin[k]) / cell_m)
    return low, high


def growth(shape: tuple[int, ...], origin: Array, cell_m: float, points: Array) -> Growth | None:
    """How a grid (ny, nx) must grow so that points (N, 2) lie within; None: not at all, or beyond MAX_CELLS."""
    low, high = _cells(points, origin, cell_m)
    ny, nx = shape
    if low[0] >= 0 and low[1] >= 0 and high[0] < nx and high[1] < ny:
        return None
    before = np.where(low < 0, -low + MARGIN_CELLS, 0)
    after = np.where(high >= (nx, ny), high - (nx, ny) + 1 + MARGIN_CELLS, 0)
    new_nx, new_ny = int(nx + before[0] + after[0]), int(ny + before[1] + after[1])
    if new_nx * new_ny > MAX_CELLS:
        return None
    held = slice(int(before[1]), int(before[1]) + ny), slice(int(before[0]), int(before[0]) + nx)
    return Growth((new_ny, new_nx), held, origin - before * cell_m)
