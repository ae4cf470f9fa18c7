"""What the navigator steers by: distances ahead, to the right, and all round."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from companion.jit import kernel
from companion.messages import Array, LidarScan, WallRanges
from companion.odometry.level import AllReturns
from companion.odometry.level_kernels import middle_of

HALF_WIDTH_RAD = math.radians(4.0)  # beams about the bearing of eq. 4 and 5: the median of a dozen instead of one
MIN_BEAMS = 3


def wall_ranges(scan: LidarScan, every: AllReturns, r_body_lidar: Array, min_range_m: float) -> WallRanges:
    """Distances from the body's centre in the horizontal layer.

    The paper counts beams from behind, clockwise: index r/2 looks ahead and r/4... to the right with its sensor's
    order reversed; here both are found by bearing, so that the order of the beams does not matter (docs/paper.md).
    """
    front, right, ranges, is_seen = _look_around(
        every.points_level,
        every.range_m,
        every.row,
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
    layer_row: int,
    min_range_m: float,
    directions: Array,
    column_valid: NDArray[np.bool_],
    r_body_lidar: Array,
) -> tuple[float, float, Array, NDArray[np.bool_]]:
    """Front and right (NaN: too few beams), (360,) nearest by bearing, (360,) where anybody looked.

    points: (N, 3) levelled, range_m, row: (N,) of all returns. directions: (columns, 3) of the layer's beams, lidar
    frame; column_valid: (columns,) those that arrived.
    """
    ranges, is_seen = np.full(360, np.inf), np.zeros(360, np.bool_)
    ahead, right = np.empty(len(row)), np.empty(len(row))
    n_ahead, n_right = 0, 0
    for i in range(len(row)):
        if row[i] != layer_row:
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
        if column_valid[c]:  # looked there, also where nothing came back
            d = directions[c]
            x = d[0] * r_body_lidar[0, 0] + d[1] * r_body_lidar[0, 1] + d[2] * r_body_lidar[0, 2]
            y = d[0] * r_body_lidar[1, 0] + d[1] * r_body_lidar[1, 1] + d[2] * r_body_lidar[1, 2]
            is_seen[_sector(math.atan2(y, x))] = True
    front_m = middle_of(ahead, n_ahead) if n_ahead >= MIN_BEAMS else np.nan  # eq. 4
    right_m = middle_of(right, n_right) if n_right >= MIN_BEAMS else np.nan  # eq. 5
    return front_m, right_m, ranges, is_seen


@kernel
def _sector(bearing_rad: float) -> int:
    """Whole degrees, 0 to 359."""
    return math.floor(bearing_rad * (180.0 / math.pi) + 0.5) % 360


@kernel
def _is_about_axis(off_axis_rad: float) -> bool:
    """Whether a beam is one of those whose median is taken."""
    return abs((off_axis_rad + math.pi) % (2 * math.pi) - math.pi) <= HALF_WIDTH_RAD
