"""Odometry of a planar scanner alone: no attitude, no flight controller. The wall map that flies, a simpler motion model.

Its frame is `odom`: the origin is the first scan, poses never jump, and drift stays (loop_closure takes it out).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from companion.geometry import rotation2, wrap_angle
from companion.messages import Array
from companion.odometry.likelihood import LikelihoodGrid, thinned
from companion.odometry.pose_graph import composed, relative
from companion.odometry.wall_map import Registration, WallMap

CELL_M = (0.1, 0.5)  # by how far apart a scan's points lie: a wall's line is fitted to 5 cells, and wants 5 points
SIGMA_RANGE_M = 0.02
GATE_M = 0.4
SPEED_OVER_S = 0.9  # logs stamp scans as they are written, at times two at once: speed is taken over this long at least
FORGET_S = 1.0  # a gap longer than this: the speed before it says nothing
GUESS_SIGMA = np.array([0.03, 0.03, 0.02])  # m, m, rad: of the predicted pose, where the last scan is a moment old
GUESS_ACCELERATION = np.array([0.5, 0.5, 2.0])  # 1 sigma of m/s2, m/s2, rad/s2: by how much a robot's motion changes
GUESS_SPEED = np.array([0.5, 0.5, 0.5])  # 1 sigma of the motion itself, where it is not known
FOUND_SIGMA = np.array([0.10, 0.10, 0.05])  # of a pose that was searched for
GOOD_RATIO = 0.7  # share of the points that lie on a wall, below which the pose is searched for
LEAST_RATIO = 0.35  # below which the scan is not placed
CLEARLY_MORE = 1.1  # inliers for which what the search found is believed
SEARCH_M, SEARCH_RAD = 0.5, math.radians(25.0)  # about the prediction
SEARCH_MPS, SEARCH_RADPS = 0.8, math.radians(90.0)  # and for each second since the last scan
MAX_SEARCH_M, MAX_SEARCH_RAD = 3.0, math.radians(150.0)
KEYFRAME_M = 0.15
KEYFRAME_RAD = math.radians(5.0)
SUBMAP_M = 8.0  # a map is begun anew each so far, and used from half of it on: what lies further back has drifted
SUBMAP_KEYFRAMES = 120
MIN_POINTS = 20


@dataclass(frozen=True, slots=True)
class Match:
    """pose: x, y, yaw of the scanner in odom. A poor match keeps the predicted pose.

    information: (3, 3) of the pose against the map about it, in the scanner's frame; along a bare corridor there is none.
    """

    pose: Array
    converged: bool
    inliers: int
    information: Array


@dataclass(slots=True)
class Submap:
    """What was seen of late. points: the same as the walls hold, for the search."""

    walls: WallMap
    points: list[Array]
    length_m: float = 0.0
    grid: LikelihoodGrid | None = None


class PlanarMatcher:
    """Registers each scan to the map of those before. One instance for one recording; scans in the order of their times."""

    def __init__(self) -> None:
        self._submaps: list[Submap] = []
        self._cell_m = CELL_M[0]
        self._pose = np.zeros(3)
        self._t_ns = 0
        self._past: deque[tuple[int, Array]] = deque()
        self._keyframe = np.zeros(3)

    def match(self, points: Array, t_ns: int) -> Match:
        """points: (N, 2) in the scanner's frame, finite."""
        if not self._submaps:
            return self._begin(points, t_ns)
        dt_s = (t_ns - self._t_ns) * 1e-9
        guess = composed(self._pose, self._twist() * dt_s)
        self._t_ns = t_ns
        found = self._register(points, guess, dt_s)
        if found is None:
            self._past.clear()  # a speed that led astray does not lead further
            return Match(self._pose.copy(), False, 0, np.zeros((3, 3)))
        self._pose = np.append(found.pose[:2], wrap_angle(float(found.pose[2])))
        self._remember(t_ns)
        if self._is_new_place():
            self._insert(points)
        back = rotation2(-float(self._pose[2]))
        turn = np.block([[back, np.zeros((2, 1))], [np.zeros((1, 2)), np.ones((1, 1))]])
        return Match(self._pose.copy(), True, found.inliers, turn @ found.information @ turn.T)

    def _begin(self, points: Array, t_ns: int) -> Match:
        self._t_ns = t_ns
        if len(points) < MIN_POINTS:
            return Match(self._pose.copy(), False, 0, np.zeros((3, 3)))
        apart = np.hypot(*np.diff(points, axis=0).T)
        self._cell_m = float(np.clip(1.5 * np.median(apart), *CELL_M))
        self._insert(points)
        self._remember(t_ns)
        return Match(self._pose.copy(), True, len(points), np.zeros((3, 3)))

    # ---- where it may be ---------------------------------------------------------------------------------------------

    def _remember(self, t_ns: int) -> None:
        """Keep the poses that speed is taken from: the youngest that is old enough, and all after it."""
        if self._past and t_ns - self._past[-1][0] > FORGET_S * 1e9:
            self._past.clear()
        self._past.append((t_ns, self._pose.copy()))
        while len(self._past) > 2 and t_ns - self._past[1][0] >= SPEED_OVER_S * 1e9:
            self._past.popleft()

    def _twist(self) -> Array:
        """m/s, m/s, rad/s in the scanner's frame; 0 where nothing is known of it."""
        if len(self._past) < 2:
            return np.zeros(3)
        (since_ns, since), (until_ns, until) = self._past[0], self._past[-1]
        dt_s = (until_ns - since_ns) * 1e-9
        if dt_s < SPEED_OVER_S / 2:
            return np.zeros(3)
        step = relative(since, until) / dt_s
        step[:2] = rotation2(-float(step[2]) * dt_s / 2) @ step[:2]
        return step

    def _register(self, points: Array, guess: Array, dt_s: float) -> Registration | None:
        """From the predicted pose; where that fits badly, from the best one of all about it. None: nothing fits."""
        if len(points) < MIN_POINTS:
            return None
        sigma = GUESS_SIGMA + GUESS_ACCELERATION * dt_s**2 + (0.0 if len(self._past) > 1 else dt_s) * GUESS_SPEED
        best = self._try(points, guess, sigma)
        if best.inliers < GOOD_RATIO * len(points):
            fit = self._grid().search(
                thinned(points),
                guess,
                window_m=min(SEARCH_M + SEARCH_MPS * dt_s, MAX_SEARCH_M),
                window_rad=min(SEARCH_RAD + SEARCH_RADPS * dt_s, MAX_SEARCH_RAD),
            )
            other = self._try(points, fit.pose, FOUND_SIGMA)
            best = other if other.inliers > CLEARLY_MORE * best.inliers else best
        return best if best.inliers >= max(MIN_POINTS, LEAST_RATIO * len(points)) else None

    def _try(self, points: Array, guess: Array, sigma: Array) -> Registration:
        return self._submaps[0].walls.register(
            points,
            guess,
            np.diag(1.0 / sigma**2),
            sigma_range_m=SIGMA_RANGE_M,
            gate_m=GATE_M,
            max_iterations=20,
        )

    # ---- the map about it --------------------------------------------------------------------------------------------

    def _grid(self) -> LikelihoodGrid:
        submap = self._submaps[0]
        if submap.grid is None:
            submap.grid = LikelihoodGrid(np.concatenate(submap.points))
        return submap.grid

    def _is_new_place(self) -> bool:
        moved = self._pose - self._keyframe
        return math.hypot(moved[0], moved[1]) > KEYFRAME_M or abs(wrap_angle(float(moved[2]))) > KEYFRAME_RAD

    def _insert(self, points: Array) -> None:
        """Into the maps: the one in use, and from half its life on also the one that follows it."""
        step_m = float(np.hypot(*(self._pose - self._keyframe)[:2]))
        self._keyframe = self._pose.copy()
        placed = points @ rotation2(float(self._pose[2])).T + self._pose[:2]
        if not self._submaps or (len(self._submaps) == 1 and _is_half_full(self._submaps[0])):
            self._submaps.append(Submap(WallMap(self._cell_m), []))
        elif len(self._submaps) == 2 and _is_half_full(self._submaps[1]):
            del self._submaps[0]
            self._submaps.append(Submap(WallMap(self._cell_m), []))
        for submap in self._submaps:
            submap.walls.insert(placed, 0.0, np.zeros(3))
            submap.points.append(placed)
            submap.length_m += step_m
            submap.grid = None


def _is_half_full(submap: Submap) -> bool:
    return (submap.length_m > SUBMAP_M / 2 and len(submap.points) > SUBMAP_KEYFRAMES / 4) or (
        len(submap.points) > SUBMAP_KEYFRAMES / 2
    )
