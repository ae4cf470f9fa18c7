"""What the navigator steers by: distances ahead, to the right, and all round."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from companion.jit import kernel
from companion.messages import Array, LidarScan, WallRanges
from companion.odometry.level import AllReturns
from companion.odometry.level_kernels import middle_of

HALF_WIDTH_RAD = math.radians(4.0)  # beams about the bearing of eq. 4 and 5: the median of a dozen instead of one
MIN_BEAMS = 3
SCANS = 4  # that are compared: this one and those before it
NEAR_M = 4.0  # nearer than this a return that stands alone may be a speck of dust, and would stop the vehicle
TOGETHER_M = 0.4  # of range between returns of one thing: three sigma of the noise
BESIDE_COLUMNS = 3  # how far off its neighbours may be
BEFORE_COLUMNS = 2  # how far off itself one scan before: 14 deg/s at 10 Hz
COMPANIONS = 2  # neighbours that make a thing of a return: a hand's breadth at two metres
HAZE_RATIO = 0.035  # of the layer's columns are specks: in thicker dust specks come together by chance more often, so
THICK_BESIDE_COLUMNS = 4  # a thing needs more
THICK_COMPANIONS = 3  # neighbours, or has to be there
THICK_BEFORE_COLUMNS = 1  # so near to itself, and a scan longer
LEANING = 0.02  # more for each metre of range and column between two returns of one thing: a surface seen at 60 deg
MOST_SPECKS_RATIO = 0.12  # of the layer's columns: in still thicker dust every return counts, and stops the vehicle


def layer_ranges(scan: LidarScan) -> Array:
    """(columns,) ranges of the horizontal layer, inf where nothing came back."""
    layer = np.asarray(scan.range_m[scan.geometry.horizontal_row], np.float64)
    return np.where((layer > 0.0) & (layer < np.inf) & scan.column_valid, layer, np.inf)


def wall_ranges(
    scan: LidarScan,
    every: AllReturns,
    r_body_lidar: Array,
    min_range_m: float,
    layers: Sequence[Array] = (),
    *,
    is_dusty: bool = False,
) -> WallRanges:
    """Distances from the body's centre in the horizontal layer.

    layers: `layer_ranges` of this scan and the three before it, newest first; fewer: every return counts. A near return
    counts where it has neighbours, or where it came in the two scans before too (three in thick dust); one that stands
    alone is a speck of dust, and nobody knows what lies behind it. is_dusty: so are those farther off, by the rules of
    thick dust: else a lap is spent braking before walls and columns that are none.

    The paper counts beams from behind, clockwise: index r/2 looks ahead and r/4... to the right with its sensor's
    order reversed; here both are found by bearing, so that the order of the beams does not matter (docs/paper.md).
    """
    is_comparable = len(layers) == SCANS and len({layer.shape for layer in layers}) == 1
    is_speck = _specks(np.stack(layers), is_dusty) if is_comparable else np.zeros(len(scan.column_valid), np.bool_)
    front, right, ranges, is_seen = _look_around(
        every.points_level,
        every.range_m,
        every.row,
        every.column,
        is_speck,
        scan.geometry.horizontal_row,
        min_range_m,
        scan.geometry.directions[scan.geometry.horizontal_row],
        scan.column_valid,
        r_body_lidar,
    )
    return WallRanges(
        t_ns=scan.t_ns,
        front_m=None if math.isnan(front) else front,
        right_m=None if math.isnan(right) else right,
        ranges_m=ranges,
        is_seen=is_seen,
    )


@kernel
def _look_around(
    points: Array,
    range_m: Array,
    row: NDArray[np.int64],
    column: NDArray[np.int64],
    is_speck: NDArray[np.bool_],
    layer_row: int,
    min_range_m: float,
    directions: Array,
    column_valid: NDArray[np.bool_],
    r_body_lidar: Array,
) -> tuple[float, float, Array, NDArray[np.bool_]]:
    """Front and right (NaN: too few beams), (360,) nearest by bearing, (360,) where anybody looked.

    points: (N, 3) levelled, range_m, row, column: (N,) of all returns. is_speck: (columns,) of the layer.
    directions: (columns, 3) of the layer's beams, lidar frame; column_valid: (columns,) those that arrived.
    """
    ranges, is_seen = np.full(360, np.inf), np.zeros(360, np.bool_)
    ahead, right = np.empty(len(row)), np.empty(len(row))
    n_ahead, n_right = 0, 0
    for i in range(len(row)):
        if row[i] != layer_row or is_speck[column[i]]:
            continue
        x, y = points[i, 0], points[i, 1]
        bearing = math.atan2(y, x)
        sector = _sector(bearing)
        ranges[sector] = min(ranges[sector], math.hypot(x, y))
        if range_m[i] < min_range_m:
            continue
        if _is_about_axis(bearing):
            ahead[n_ahead] = x
            n_ahead += 1
        if _is_about_axis(bearing + math.pi / 2):
            right[n_right] = -y
            n_right += 1
    for k in range(360):
        is_seen[k] = ranges[k] < np.inf
    for c in range(len(column_valid)):
        if column_valid[c] and not is_speck[c]:  # looked there, also where nothing came back
            d = directions[c]
            x = d[0] * r_body_lidar[0, 0] + d[1] * r_body_lidar[0, 1] + d[2] * r_body_lidar[0, 2]
            y = d[0] * r_body_lidar[1, 0] + d[1] * r_body_lidar[1, 1] + d[2] * r_body_lidar[1, 2]
            is_seen[_sector(math.atan2(y, x))] = True
    front_m = middle_of(ahead, n_ahead) if n_ahead >= MIN_BEAMS else np.nan  # eq. 4
    right_m = middle_of(right, n_right) if n_right >= MIN_BEAMS else np.nan  # eq. 5
    return front_m, right_m, ranges, is_seen


@kernel
def _specks(layers: Array, is_dusty: bool) -> NDArray[np.bool_]:
    """(columns,) returns that stand alone, near ones, in dust all. layers: (4, columns) of this scan and those before."""
    columns = layers.shape[1]
    is_speck = _alone(layers, 0.0, NEAR_M, 0.0, BESIDE_COLUMNS, COMPANIONS, BEFORE_COLUMNS, 2)
    thick = (THICK_BESIDE_COLUMNS, THICK_COMPANIONS, THICK_BEFORE_COLUMNS, 3)
    if np.sum(is_speck) > HAZE_RATIO * columns:
        is_speck = _alone(layers, 0.0, NEAR_M, 0.0, *thick)
    if np.sum(is_speck) > MOST_SPECKS_RATIO * columns:
        is_speck[:] = False
    if is_dusty:
        is_speck |= _alone(layers, NEAR_M, np.inf, LEANING, *thick)
    return is_speck


@kernel
def _alone(
    layers: Array,
    from_m: float,
    to_m: float,
    leaning: float,
    beside_columns: int,
    companions: int,
    before_columns: int,
    scans: int,
) -> NDArray[np.bool_]:
    """(columns,) returns in that range with fewer companions in their scan, and not there in each of so many before."""
    columns = layers.shape[1]
    is_alone = np.zeros(columns, np.bool_)
    for c in range(columns):
        reach = layers[0, c]
        if not from_m <= reach < to_m:
            continue
        if not has_beside(layers[0], c, beside_columns, leaning, companions):
            was_there = True
            for n in range(1, scans + 1):
                was_there = was_there and _was_there(layers[n], c, reach, n * before_columns)
            is_alone[c] = not was_there
    return is_alone


@kernel
def beside(row: Array | NDArray[np.float32], column: int, columns: int, leaning: float) -> tuple[int, int]:
    """Of the returns so many columns to each side in a closed row (m; 0 or inf: no return): how many lie at this one's range,
    and how many farther off. leaning: how much more the ranges of one thing differ, for each metre and column."""
    own = float(row[column])
    together, farther = 0, 0
    for k in range(1, columns + 1):
        reach = TOGETHER_M + leaning * k * own
        left, right = _neighbours(row, column, k)
        together += int(left > 0.0 and abs(left - own) <= reach) + int(right > 0.0 and abs(right - own) <= reach)
        farther += int(left > own + reach) + int(right > own + reach)
    return together, farther


@kernel
def has_beside(row: Array | NDArray[np.float32], column: int, columns: int, leaning: float, companions: int) -> bool:
    """Whether so many returns lie together with this one, as `beside` counts them: most are seen in the first columns."""
    own = float(row[column])
    together = 0
    for k in range(1, columns + 1):
        reach = TOGETHER_M + leaning * k * own
        left, right = _neighbours(row, column, k)
        together += int(left > 0.0 and abs(left - own) <= reach) + int(right > 0.0 and abs(right - own) <= reach)
        if together >= companions:
            return True
    return False


@kernel
def _neighbours(row: Array | NDArray[np.float32], column: int, k: int) -> tuple[float, float]:
    """Of a closed row, k columns to the left and right; a remainder is taken only at its seam: it is slow."""
    left, right = column - k, column + k
    if left < 0:
        left = left % len(row)
    if right >= len(row):
        right = right % len(row)
    return float(row[left]), float(row[right])


@kernel
def _was_there(layer: Array, column: int, reach: float, within: int) -> bool:
    found = False
    for k in range(-within, within + 1):
        found = found or abs(layer[(column + k) % len(layer)] - reach) <= TOGETHER_M
    return found


@kernel
def _sector(bearing_rad: float) -> int:
    """Whole degrees, 0 to 359."""
    return math.floor(bearing_rad * (180.0 / math.pi) + 0.5) % 360


@kernel
def _is_about_axis(off_axis_rad: float) -> bool:
    """Whether a beam is one of those whose median is taken."""
    return abs((off_axis_rad + math.pi) % (2 * math.pi) - math.pi) <= HALF_WIDTH_RAD
