"""How the maps' grids grow with what is seen."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.messages import Array

MARGIN_CELLS = 64  # grown by at least this much at a time
MAX_CELLS = 4_000_000  # 36 hectares at 0.3 m; points beyond are left out


class Growth(NamedTuple):
    """shape: ny, nx of the new grid; held: where the old one lies in it; origin: (2,) its corner, map."""

    shape: tuple[int, int]
    held: tuple[slice, slice]
    origin: Array


def growth(shape: tuple[int, ...], origin: Array, cell_m: float, points: Array) -> Growth | None:
    """How a grid (ny, nx) must grow so that points (N, 2) lie within; None: not at all, or beyond MAX_CELLS."""
    low: NDArray[np.int64] = np.floor((points.min(axis=0) - origin) / cell_m).astype(np.int64)
    high: NDArray[np.int64] = np.floor((points.max(axis=0) - origin) / cell_m).astype(np.int64)
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
