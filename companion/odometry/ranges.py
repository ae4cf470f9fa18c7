"""What the navigator steers by: distances ahead, to the right, and all round."""

from __future__ import annotations

import math

import numpy as np

from companion.messages import Array, LidarScan, WallRanges
from companion.odometry.level import AllReturns

HALF_WIDTH_RAD = math.radians(4.0)  # beams about the bearing of eq. 4 and 5: the median of a dozen instead of one
MIN_BEAMS = 3


def wall_ranges(scan: LidarScan, every: AllReturns, r_body_lidar: Array, min_range_m: float) -> WallRanges:
    """Distances from the body's centre in the horizontal layer.

    The paper counts beams from behind, clockwise: index r/2 looks ahead and r/4... to the right with its sensor's
    order reversed; here both are found by bearing, so that the order of the beams does not matter (docs/paper.md).
    """
    row = scan.geometry.horizontal_row
    layer = every.row == row
    x, y = every.points_level[layer, 0], every.points_level[layer, 1]
    bearing = np.arctan2(y, x)
    usable = every.range_m[layer] >= min_range_m
    front = _median_ahead(x, bearing, usable)  # eq. 4
    right = _median_ahead(-y, bearing + math.pi / 2, usable)  # eq. 5
    ranges = np.full(360, np.inf)
    np.minimum.at(ranges, _sectors(bearing), np.hypot(x, y))
    is_seen = np.isfinite(ranges)
    looked = scan.geometry.directions[row, scan.column_valid] @ r_body_lidar.T
    is_seen[_sectors(np.arctan2(looked[:, 1], looked[:, 0]))] = True  # also where nothing came back
    return WallRanges(t_ns=scan.t_ns, front_m=front, right_m=right, ranges_m=ranges, is_seen=is_seen)


def _sectors(bearing_rad: Array) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    """Whole degrees, 0 to 359."""
    return np.floor(np.degrees(bearing_rad) + 0.5).astype(np.int64) % 360


def _median_ahead(
    distance: Array, off_axis_rad: Array, usable: np.ndarray[tuple[int], np.dtype[np.bool_]]
) -> float | None:
    """Median of the distance along the axis over the beams about it; None when too few came back."""
    off = (off_axis_rad + math.pi) % (2 * math.pi) - math.pi
    near = (np.abs(off) <= HALF_WIDTH_RAD) & usable
    if int(near.sum()) < MIN_BEAMS:
        return None
    return float(np.median(distance[near]))
