"""Returns that belong to nothing solid: dust, edges half hit, strays."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from companion.jit import kernel
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
    return _have_neighbours(levelled.points_level, levelled.origin_level_m, levelled.row, levelled.column, finite)


@kernel
def _have_neighbours(
    points: Array, origin: Array, row: NDArray[np.int64], column: NDArray[np.int64], finite: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """(N,) of (N, 3) points seen from origin (3,): see is_solid. The turn is closed: its ends are neighbours."""
    solid = np.zeros(len(row), np.bool_)
    height, width = 0, 0
    for i in range(len(row)):
        if finite[i] and row[i] >= 0 and column[i] >= 0:
            height, width = max(height, row[i] + 1), max(width, column[i] + 1)
    index = np.full((height, width), -1, np.int64)
    for i in range(len(row)):
        if finite[i] and row[i] >= 0 and column[i] >= 0:
            index[row[i], column[i]] = i
    for r in range(height):
        for c in range(width):
            i = index[r, c]
            if i < 0:
                continue
            x, y, z = points[i, 0] - origin[0], points[i, 1] - origin[1], points[i, 2] - origin[2]
            range_m = math.sqrt(x * x + y * y + z * z)
            near, there = 0, 0
            for k in range(2 * WINDOW_COLUMNS + 2):
                if k < 2 * WINDOW_COLUMNS:
                    step = k // 2 + 1
                    j = index[r, (c + (step if k % 2 else -step)) % width]
                else:
                    step, beside = 1, r + (1 if k % 2 else -1)
                    j = index[beside, c] if 0 <= beside < height else -1
                if j < 0:
                    continue
                there += 1
                dx, dy, dz = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
                near += math.sqrt(dx * dx + dy * dy + dz * dz) < TOLERANCE_M + 0.04 * step * range_m
            solid[i] = near >= min(MIN_NEIGHBOURS, max(there - 1, 1))
    return solid
