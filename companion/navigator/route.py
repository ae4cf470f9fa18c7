"""The way home: straight if the scan shows it free, else back along the path that was flown."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from companion.navigator.scan_view import BEARING_RAD, ScanView
from companion.navigator.wall_follower import Pose2

SPACING_M = 0.5
NEAR_M = 1.2  # a place flown before that is so near is reached without looking
TRIED_PLACES = 40
REACHED_M = 0.6
BEAM_RAD = math.radians(4)


class Path:
    """Places flown through, each half a metre, from the start on: known to be free air."""

    def __init__(self) -> None:
        self.places: list[tuple[float, float]] = []
        self.length_m = 0.0
        self._home_m, self._home_at = 0.0, 0

    def add(self, pose: Pose2) -> None:
        if self.places:
            x, y = self.places[-1]
            moved = math.hypot(pose.x - x, pose.y - y)
            if moved < SPACING_M:
                return
            self.length_m += moved
        self.places.append((pose.x, pose.y))

    def home_m(self) -> float:
        """Length of the way home along what was flown, loops left out: an estimate from every tenth place."""
        if len(self.places) - self._home_at >= 5:  # it grows slowly: worked out again every few metres
            kept = simplified(self.places[::10] + self.places[-1:], 5.5)
            self._home_m, self._home_at = sum(math.dist(a, b) for a, b in pairwise(kept)), len(self.places)
        return self._home_m


def simplified(places: list[tuple[float, float]], near_m: float) -> list[tuple[float, float]]:
    """From the last place back to the first, jumping at each to the earliest place that lies within near_m."""
    if not places:
        return []
    xy = np.array(places)
    kept, n = [places[-1]], len(places) - 1
    while n > 0:
        d = np.hypot(xy[:n, 0] - xy[n, 0], xy[:n, 1] - xy[n, 1])
        within = np.flatnonzero(d < near_m)
        n = int(within[0]) if len(within) else n - 1
        kept.append(places[n])
    return kept


class Route:
    """Home from where the path ends. only_flown: no short cuts through air that was only looked through."""

    def __init__(self, path: Path, home: tuple[float, float], lane_m: float, *, only_flown: bool) -> None:
        self._home = home
        self._lane = lane_m
        self._only_flown = only_flown
        self._ahead = [*simplified(path.places, NEAR_M), home]  # still to come, home last

    @property
    def target(self) -> tuple[float, float]:
        return self._ahead[0]

    @property
    def is_last(self) -> bool:
        return len(self._ahead) == 1

    def see(self, view: ScanView, pose: Pose2) -> None:
        """Take the farthest place along the way that this scan shows free to fly to."""
        if self._only_flown:
            return
        last = len(self._ahead) - 1
        for n in range(last, 0, -max(1, last // TRIED_PLACES)):
            if self._shows_free(view, pose, self._ahead[n]):
                del self._ahead[:n]
                return

    def step(self, pose: Pose2) -> None:
        while len(self._ahead) > 1 and math.dist(self._ahead[0], (pose.x, pose.y)) < REACHED_M:
            del self._ahead[0]

    def _shows_free(self, view: ScanView, pose: Pose2, place: tuple[float, float]) -> bool:
        distance = math.dist(place, (pose.x, pose.y))
        if distance < 0.3:
            return True
        bearing = math.atan2(place[1] - pose.y, place[0] - pose.x) - pose.yaw
        free, _ = view.ahead(bearing, self._lane, self._lane)
        if free < distance + 0.5:
            return False
        off = np.abs((BEARING_RAD - bearing + math.pi) % (2 * math.pi) - math.pi)
        beams = view.smooth_m[off < BEAM_RAD]
        return bool(np.mean(np.isfinite(beams)) > 0.5)  # seen through to what lies behind
