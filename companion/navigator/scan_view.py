"""One horizontal scan as the wall follower sees it: smoothed ranges, the wall's line, the free way ahead."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.messages import Array, WallRanges
from companion.navigator import scan_kernels as sk
from companion.navigator.scan_kernels import BEARING_RAD, DIRECTION, SECTORS

__all__ = ["BEARING_RAD", "DIRECTION", "FAR_M", "SECTORS", "ScanView", "Wall"]

FAR_M = 1e9


@dataclass(frozen=True, slots=True)
class Wall:
    """The wall nearest in some direction. distance_m: perpendicular. normal_rad: body bearing of its nearest place.

    is_line: a straight line was fitted through enough returns; else it is the nearest return (corner, column, pile).
    ends_m: how far the line is seen to the clockwise and to the counter-clockwise side of its nearest place.
    """

    distance_m: float
    normal_rad: float
    is_line: bool
    ends_m: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class ScanView:
    """smooth_m: (360,) range averaged over neighbours on the same surface, inf where free, unseen or a lone return.
    points: (360, 2) raw returns in the levelled body frame (NaN where none). t_ns: of the scan."""

    t_ns: int
    smooth_m: Array
    points: Array

    @staticmethod
    def of(walls: WallRanges) -> ScanView:
        """Bad values (NaN, negative, too near to be anything but the vehicle) count as nothing seen."""
        smooth, points = sk.smoothed(np.asarray(walls.ranges_m, dtype=np.float64))
        return ScanView(t_ns=walls.t_ns, smooth_m=smooth, points=points)

    def nearest(self, low_rad: float, high_rad: float) -> tuple[float, float] | None:
        """(range, bearing) of the nearest surface between two bearings, counter-clockwise from low to high."""
        n = sk.nearest_between(self.smooth_m, low_rad, high_rad)
        return (float(self.smooth_m[n]), float(BEARING_RAD[n])) if n >= 0 else None

    def wall(self, low_rad: float, high_rad: float) -> Wall | None:
        """The wall nearest between two bearings: a fitted line if there is one, else the nearest surface."""
        found = self.nearest(low_rad, high_rad)
        if found is None:
            return None
        distance, bearing = found
        is_line, line_m, normal_rad, clockwise_m, counter_m = sk.fit_wall(self.points, distance, bearing)
        return Wall(line_m, normal_rad, True, (clockwise_m, counter_m)) if is_line else Wall(distance, bearing, False)

    def ahead(
        self, bearing_rad: float, left_m: float, right_m: float, beside_m: float = math.inf
    ) -> tuple[float, float]:
        """How far one can fly that way until something lies in a lane so wide to the left and to the right, and the
        bearing of that thing; (inf, bearing_rad) if nothing does. What is rather beside than ahead, and farther off
        the middle than beside_m, does not count: it is being passed."""
        along, n = sk.nearest_in_lane(self.smooth_m, bearing_rad, left_m, right_m, beside_m)
        return (along, float(BEARING_RAD[n])) if n >= 0 else (math.inf, bearing_rad)
