"""Returns that belong to nothing solid: dust, edges half hit, strays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from companion.messages import Array, LevelledScan

WINDOW_COLUMNS = 2
MIN_NEIGHBOURS = 2
TOLERANCE_M = 0.75  # six sigma of the paper's range noise of 0.12 m, between two returns


def is_solid(levelled: LevelledScan, finite: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(N,) which returns have neighbours in the scan that they can share a surface with.

    A surface goes on: of the four returns beside one in its own layer, and the two in the layers above and below, at
    least two lie near it (the more so the farther it is: a grazed floor spreads). Dust hangs alone, nearer than what
    is behind it. On the rim of the field of view, and beside lost returns, fewer neighbours are asked for.
    """
    rows, columns = levelled.row, levelled.column
    usable = finite & (rows >= 0) & (columns >= 0)
    if not usable.any():
        return np.zeros(len(rows), dtype=np.bool_)
    height, width = int(rows[usable].max()) + 1, int(columns[usable].max()) + 1
    xyz = np.full((height, width, 3), np.nan)
    xyz[rows[usable], columns[usable]] = levelled.points_level[usable] - levelled.origin_level_m
    range_m = np.linalg.norm(xyz, axis=2)
    near = np.zeros((height, width), dtype=np.int64)
    there = np.zeros((height, width), dtype=np.int64)
    for step in range(1, WINDOW_COLUMNS + 1):
        for shift in (step, -step):
            near, there = _compare(xyz, range_m, np.roll(xyz, shift, axis=1), step, near, there)
    for shift in (1, -1):
        beside = np.roll(xyz, shift, axis=0)
        beside[0 if shift == 1 else -1] = np.nan
        near, there = _compare(xyz, range_m, beside, 1, near, there)
    solid = (near >= np.minimum(MIN_NEIGHBOURS, np.maximum(there - 1, 1))) & np.isfinite(range_m)
    out = np.zeros(len(rows), dtype=np.bool_)
    out[usable] = solid[rows[usable], columns[usable]]
    return out


def _compare(
    xyz: Array, range_m: Array, other: Array, step: int, near: NDArray[np.int64], there: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    with np.errstate(invalid="ignore"):
        apart = np.linalg.norm(xyz - other, axis=2)
        close = apart < TOLERANCE_M + 0.04 * step * range_m
    return near + close, there + np.isfinite(apart)
