"""One horizontal scan as the wall follower sees it: smoothed ranges, the wall's line, the free way ahead."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.messages import Array, WallRanges

SECTORS = 360
BEARING_RAD = np.radians(np.arange(SECTORS))
DIRECTION = np.column_stack([np.cos(BEARING_RAD), np.sin(BEARING_RAD)])
SMOOTH_SECTORS = 5  # to each side
SMOOTH_GATE_M = 0.5  # about 4 sigma of the range noise (0.12 m): a wall is averaged, an edge is kept
FIT_RADIUS_M = 4.0
FIT_GATES_M = (1.0, 0.7, 0.5, 0.4, 0.4)  # of Tukey's weight, one an iteration: pilasters drop out, the wall stays
FIT_MIN_POINTS = 12
FIT_MIN_LENGTH_M = 1.5
FIT_MAX_OFFSET_M = 0.7  # a line may lie this far behind the nearest return: pilasters, not piles
FAR_M = 1e9
BESIDE_RATIO = math.tan(math.radians(60))

_NEIGHBOURS = (np.arange(SECTORS)[:, None] + np.arange(-SMOOTH_SECTORS, SMOOTH_SECTORS + 1)[None, :]) % SECTORS


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
        raw = np.asarray(walls.ranges_m, dtype=np.float64)
        ok = np.isfinite(raw) & (raw > 0.2)
        ranges = np.where(ok, raw, FAR_M)
        around = ranges[_NEIGHBOURS]
        same = np.abs(around - ranges[:, None]) < SMOOTH_GATE_M
        count = same.sum(axis=1)
        # The inverse range of a straight wall is a sinusoid of bearing: its mean over a few degrees has no bias.
        smooth = count / np.where(same, 1.0 / around, 0.0).sum(axis=1)
        smooth = np.where(ok & (count >= 2), smooth, np.inf)
        points = np.where(ok, raw, np.nan)[:, None] * DIRECTION
        return ScanView(t_ns=walls.t_ns, smooth_m=smooth, points=points)

    def nearest(self, low_rad: float, high_rad: float) -> tuple[float, float] | None:
        """(range, bearing) of the nearest surface between two bearings, counter-clockwise from low to high."""
        inside = window(low_rad, high_rad)
        ranges = np.where(inside, self.smooth_m, np.inf)
        n = int(np.argmin(ranges))
        if not math.isfinite(ranges[n]):
            return None
        return float(ranges[n]), float(BEARING_RAD[n])

    def wall(self, low_rad: float, high_rad: float) -> Wall | None:
        """The wall nearest between two bearings: a fitted line if there is one, else the nearest surface."""
        found = self.nearest(low_rad, high_rad)
        if found is None:
            return None
        distance, bearing = found
        line = self._fit(distance, bearing)
        return line if line is not None else Wall(distance, bearing, False)

    def ahead(
        self, bearing_rad: float, left_m: float, right_m: float, beside_m: float = math.inf
    ) -> tuple[float, float]:
        """How far one can fly that way until something lies in a lane so wide to the left and to the right, and the
        bearing of that thing; (inf, bearing_rad) if nothing does. What is rather beside than ahead, and farther off
        the middle than beside_m, does not count: it is being passed."""
        c, s = math.cos(bearing_rad), math.sin(bearing_rad)
        usable = np.isfinite(self.smooth_m)
        places = np.where(usable, self.smooth_m, 0.0)[:, None] * DIRECTION
        along = places[:, 0] * c + places[:, 1] * s
        across = -places[:, 0] * s + places[:, 1] * c
        inside = usable & (along > 0) & (across < left_m) & (across > -right_m)
        if math.isfinite(beside_m):
            inside &= (np.abs(across) < beside_m) | (np.abs(across) < BESIDE_RATIO * along)
        if not inside.any():
            return math.inf, bearing_rad
        n = int(np.argmin(np.where(inside, along, np.inf)))
        return float(along[n]), float(BEARING_RAD[n])

    def _fit(self, distance_m: float, bearing_rad: float) -> Wall | None:
        """Total least squares with Tukey's weights through the returns about the nearest place."""
        normal = np.array([math.cos(bearing_rad), math.sin(bearing_rad)])
        foot = distance_m * normal
        off = self.points - foot
        with np.errstate(invalid="ignore"):
            near = off[:, 0] ** 2 + off[:, 1] ** 2 < FIT_RADIUS_M**2
        points = self.points[near]
        if len(points) < FIT_MIN_POINTS:
            return None
        d, centre, weight = distance_m, foot, np.ones(len(points))
        for gate in FIT_GATES_M:
            residual = (points @ normal - d) / gate
            weight = np.where(np.abs(residual) < 1.0, (1.0 - residual**2) ** 2, 0.0)
            total = float(weight.sum())
            if total < 0.4 * FIT_MIN_POINTS:
                return None
            centre = weight @ points / total
            x, y = (points - centre).T
            sxx, sxy, syy = float(weight @ (x * x)), float(weight @ (x * y)), float(weight @ (y * y))
            along = 0.5 * math.atan2(2.0 * sxy, sxx - syy)
            normal = np.array([-math.sin(along), math.cos(along)])
            d = float(normal @ centre)
            if d < 0:
                normal, d = -normal, -d
        return _accept(points, weight, centre, normal, d, distance_m, bearing_rad)


def _accept(
    points: Array, weight: Array, centre: Array, normal: Array, d: float, nearest_m: float, bearing_rad: float
) -> Wall | None:
    """The line, if it is long enough, well held, and its nearest place to us lies on it rather than beyond its end."""
    used = weight > 0.2
    if int(used.sum()) < FIT_MIN_POINTS:
        return None
    tangent = np.array([-normal[1], normal[0]])
    along = (points[used] - centre) @ tangent
    low, high = float(along.min()), float(along.max())
    here = -float(centre @ tangent)
    if high - low < FIT_MIN_LENGTH_M or not low - 0.3 <= here <= high + 0.3:
        return None
    angle = math.atan2(float(normal[1]), float(normal[0]))
    if abs(d - nearest_m) > FIT_MAX_OFFSET_M or math.cos(angle - bearing_rad) < 0.8:
        return None
    return Wall(d, angle, True, (here - low, high - here))


def window(low_rad: float, high_rad: float) -> NDArray[np.bool_]:
    """(360,) True for the sectors from low counter-clockwise to high."""
    return np.asarray((BEARING_RAD - low_rad) % (2 * math.pi) <= high_rad - low_rad)
