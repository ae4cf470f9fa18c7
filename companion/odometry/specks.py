"""Returns that stand alone: in dusty air they are dust, and neither registration nor the ground's map may see them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from companion.jit import kernel
from companion.messages import LevelledScan, LidarScan
from companion.odometry.ranges import (
    MOST_SPECKS_RATIO,
    NEAR_M,
    THICK_BESIDE_COLUMNS,
    THICK_COMPANIONS,
    beside,
    has_beside,
)

LEANING = 0.02  # more for each metre of range and column between them: a surface seen at 60 deg
DUSTY_RATIO = 0.03  # of all returns stand alone in front of something


def without_specks(scan: LidarScan, levelled: LevelledScan) -> LevelledScan:
    """The scan without the returns that stand alone in their layer, where these are so many that the air is dusty; the very
    same scan where it is clean.

    With a mean free path L a beam finds a dust grain within a metre with probability 1 / L: eight neighbours at 20 m range
    have 0.4 grains in common reach with one at L = 60 m, so three of them are a surface. In dust so thick that every near
    return stops the vehicle (`ranges.MOST_SPECKS_RATIO`) it stays as well: what would be left of the ground is too little.
    """
    is_lone, in_front = lone_returns(scan.range_m)
    if in_front <= DUSTY_RATIO * np.count_nonzero(scan.range_m > 0.0):
        return levelled
    layer = scan.geometry.horizontal_row
    near = np.count_nonzero(is_lone[layer] & (scan.range_m[layer] < NEAR_M))
    if near > MOST_SPECKS_RATIO * scan.range_m.shape[1]:
        return levelled
    keep = ~is_lone[levelled.row, levelled.column]
    return replace(
        levelled,
        points_level=levelled.points_level[keep],
        range_m=levelled.range_m[keep],
        row=levelled.row[keep],
        column=levelled.column[keep],
    )


@kernel
def lone_returns(range_m: NDArray[np.float32]) -> tuple[NDArray[np.bool_], int]:
    """(rows, columns) whether a return has too few companions beside it; False where nothing came back (0, NaN, inf). And how
    many of them stand in front of what most of their neighbours see: others are alone because their neighbours got lost."""
    rows, columns = range_m.shape
    in_front = 0
    is_lone = np.zeros((rows, columns), np.bool_)
    for i in range(rows):
        for c in range(columns):
            own = float(range_m[i, c])
            if not 0.0 < own < np.inf:
                continue
            if has_beside(range_m[i], c, THICK_BESIDE_COLUMNS, LEANING, THICK_COMPANIONS):
                continue
            _, farther = beside(range_m[i], c, THICK_BESIDE_COLUMNS, LEANING)
            is_lone[i, c] = True
            in_front += int(farther > THICK_BESIDE_COLUMNS)
    return is_lone, in_front
