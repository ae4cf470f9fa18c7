"""Returns that stand alone: in dusty air they are dust, and neither registration nor the ground's map may see them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from companion.jit import kernel
from companion.messages import LevelledScan, LidarScan
from companion.odometry.level_kernels import middle_of
from companion.odometry.ranges import (
    LEANING,
    THICK_BESIDE_COLUMNS,
    THICK_COMPANIONS,
    TOGETHER_M,
    beside,
    has_beside,
)

OFF_SIGMAS = 3.0  # off the surface of its neighbours, in dust
LEAST_SIGMA_M = 0.03  # a surface is rough
DUSTY_RATIO = 0.03  # of all returns stand alone in front of something


def specks(scan: LidarScan) -> NDArray[np.bool_] | None:
    """(rows, columns) the returns that stand alone in their layer, where these are so many that the air is dusty, else None.

    With a mean free path L a beam finds a dust grain within a metre with probability 1 / L: eight neighbours at 20 m range
    have 0.4 grains in common reach with one at L = 60 m, so three of them are a surface. What hangs less than that reach in
    front of a surface passes for it, and draws it nearer by reach^2 / 2 L, a centimetre at L = 30 m: `without_dust`.
    """
    is_lone, in_front = lone_returns(scan.range_m)
    return is_lone if in_front > DUSTY_RATIO * np.count_nonzero(scan.range_m > 0.0) else None


def without_dust(scan: LidarScan, levelled: LevelledScan, is_lone: NDArray[np.bool_], sigma_m: float) -> LevelledScan:
    """The scan without its specks and without what lies off the surface of its neighbours by more than noise (1 sigma of a
    range) does: as many sigma on both sides, so that what stays of the noise has mean zero."""
    is_dust = is_lone | off_surface(scan.range_m, is_lone, OFF_SIGMAS * max(sigma_m, LEAST_SIGMA_M))
    keep = ~is_dust[levelled.row, levelled.column]
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


@kernel
def off_surface(range_m: NDArray[np.float32], is_lone: NDArray[np.bool_], limit_m: float) -> NDArray[np.bool_]:
    """(rows, columns) whether a return lies farther than limit_m from the straight surface that its companions tell: the
    median of their ranges, each carried to its column by the median of the slopes between them."""
    rows, columns = range_m.shape
    off = np.zeros((rows, columns), np.bool_)
    at, near = np.empty(2 * THICK_BESIDE_COLUMNS), np.empty(2 * THICK_BESIDE_COLUMNS)
    slopes = np.empty(THICK_BESIDE_COLUMNS * (2 * THICK_BESIDE_COLUMNS - 1))
    for i in range(rows):
        for c in range(columns):
            own = float(range_m[i, c])
            if is_lone[i, c] or not 0.0 < own < np.inf:
                continue
            n = 0
            for k in range(-THICK_BESIDE_COLUMNS, THICK_BESIDE_COLUMNS + 1):
                beside_m = float(range_m[i, (c + k) % columns])
                if k != 0 and beside_m > 0.0 and abs(beside_m - own) <= TOGETHER_M + LEANING * abs(k) * own:
                    at[n], near[n] = k, beside_m
                    n += 1
            m = 0
            for a in range(n):
                for b in range(a + 1, n):
                    slopes[m] = (near[b] - near[a]) / (at[b] - at[a])
                    m += 1
            if m == 0:
                continue
            slope = middle_of(slopes, m)
            for a in range(n):
                near[a] -= slope * at[a]
            off[i, c] = abs(own - middle_of(near, n)) > limit_m
    return off
