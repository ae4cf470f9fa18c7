"""What the navigator steers by: distances ahead, to the right, and all round."""

from __future__ import annotations

import math

import numpy as np

from companion.messages import Array, WallRanges
from companion.odometry.level import AllReturns

HALF_WIDTH_RAD = math.radians(4.0)  # beams about the bearing of eq. 4 and 5: the median of a dozen instead of one
MIN_BEAMS = 3


def wall_ranges(t_ns: int, every: AllReturns, horizontal_row: int, min_range_m: float) -> WallRanges:
    """Distances from the body's centre in the horizontal layer.

    The paper counts beams from behind, clockwise: index r/2 looks ahead and r/4... to the right with its sensor's
    order reversed; here both are found by bearing, so that the order of the beams does not matter (docs/paper.md).
    """
    layer = every.row == horizontal_row
    x, y = every.points_level[layer, 0], every.points_level[layer, 1]
    bearing = np.arctan2(y, x)
    usable = every.range_m[layer] >= min_range_m
    front = _median_ahead(x, bearing, usable)  # eq. 4
    right = _median_ahead(-y, bearing + math.pi / 2, usable)  # eq. 5
    ranges = np.full(360, np.inf)
    sector = np.floor(np.degrees(bearing) + 0.5).astype(np.int64) % 360
    np.minimum.at(ranges, sector, np.hypot(x, y))
    return WallRanges(t_ns=t_ns, front_m=front, right_m=right, ranges_m=ranges, is_seen=np.isfinite(ranges))


def _median_ahead(
    distance: Array, off_axis_rad: Array, usable: np.ndarray[tuple[int], np.dtype[np.bool_]]
) -> float | None:
    """Median of the distance along the axis over the beams about it; None when too few came back."""
    off = (off_axis_rad + math.pi) % (2 * math.pi) - math.pi
    near = (np.abs(off) <= HALF_WIDTH_RAD) & usable
    if int(near.sum()) < MIN_BEAMS:
        return None
    return float(np.median(distance[near]))
