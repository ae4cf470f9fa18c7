"""Odometry of a planar scanner alone: no attitude, no flight controller. The wall map that flies, a simpler motion model."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.geometry import rotation2, wrap_angle
from companion.messages import Array
from companion.odometry.wall_map import Registration, WallMap

CELL_M = (0.1, 0.5)  # by how far apart a scan's points lie: a wall's line is fitted to 5 cells, and wants 5 points
SIGMA_RANGE_M = 0.02
GATE_M = 0.4
ACCELERATION_MPS2 = 1.0  # 1 sigma of what a wheeled robot does between two scans
TURN_MPS2 = 1.5  # the same of its heading, rad/s2
MAX_ACCELERATION_MPS2 = 4.0
MAX_SPEED_MPS = 10.0  # where nothing is known of the speed yet
SLOW_MPS = 0.5
MAX_TURN_RADPS2 = 6.0
KEYFRAME_M = 0.15
KEYFRAME_RAD = math.radians(5.0)
GOOD_RATIO = 0.5  # share of the points with a wall to go to, below which other headings are tried
SEARCH_RAD = tuple(math.radians(d) for d in (-12, 12, -25, 25, -40, 40))
CLEARLY_MORE = 1.3  # inliers for which another heading is believed
FORGET_S = 1.0  # a gap longer than this: the speed before it says nothing
MIN_POINTS = 20


@dataclass(frozen=True, slots=True)
class Match:
    """pose: x, y, yaw of the scanner in the map, whose origin is the first scan. A poor match keeps the predicted pose."""

    pose: Array
    converged: bool
    inliers: int


class PlanarMatcher:
    """Registers each scan to the map of those before. One instance for one recording; scans in the order of their times."""

    def __init__(self) -> None:
        self._walls = WallMap(CELL_M[0])
        self._pose = np.zeros(3)
        self._twist = np.zeros(3)  # m/s, m/s, rad/s in the scanner's frame
        self._t_ns: int | None = None
        self._keyframe = np.zeros(3)
        self._is_speed_known = False  # at first the scanner may be under way already

    def match(self, points: Array, t_ns: int) -> Match:
        """points: (N, 2) in the scanner's frame, finite."""
        if self._t_ns is None or self._walls.is_empty:
            self._t_ns = t_ns
            if len(points) < MIN_POINTS:
                return Match(self._pose.copy(), False, 0)
            apart = np.hypot(*np.diff(points, axis=0).T)
            self._walls = WallMap(float(np.clip(1.5 * np.median(apart), *CELL_M)))
            self._insert(points)
            return Match(self._pose.copy(), True, len(points))
        dt = (t_ns - self._t_ns) * 1e-9
        self._t_ns = t_ns
        if dt > FORGET_S:
            self._twist[:] = 0.0
        guess = _moved(self._pose, self._twist * dt)
        found = self._register(points, guess, dt)
        if found is None or not _is_plausible(found.pose, guess, dt, is_speed_known=self._is_speed_known):
            self._pose = guess
            self._twist *= 0.5
            self._is_speed_known = self._is_speed_known and bool(np.hypot(*self._twist[:2]) < SLOW_MPS)
            return Match(guess.copy(), False, 0)
        step = found.pose - self._pose
        step[:2] = rotation2(-self._pose[2]) @ step[:2]
        step[2] = wrap_angle(float(step[2]))
        self._twist = step / dt
        self._is_speed_known = True
        self._pose = found.pose
        if self._is_new_place():
            self._insert(points)
        return Match(found.pose.copy(), True, found.inliers)

    def _register(self, points: Array, guess: Array, dt: float) -> Registration | None:
        """From the predicted pose; where that fits badly, from other headings too. None: nothing fits."""
        if len(points) < MIN_POINTS:
            return None
        sigma = np.array([ACCELERATION_MPS2, ACCELERATION_MPS2, TURN_MPS2]) * dt * dt + np.array([0.02, 0.02, 0.01])
        if not self._is_speed_known:
            sigma += np.array([MAX_SPEED_MPS, MAX_SPEED_MPS, 0.0]) * dt
        best = self._try(points, guess, sigma)
        if best.matched_ratio < GOOD_RATIO:
            for turn in SEARCH_RAD:
                other = self._try(points, guess + np.array([0.0, 0.0, turn]), sigma + 0.2)
                best = other if other.inliers > CLEARLY_MORE * best.inliers else best
        return best if best.inliers >= max(MIN_POINTS, len(points) // 4) else None

    def _try(self, points: Array, guess: Array, sigma: Array) -> Registration:
        prior = np.diag(1.0 / sigma**2)
        return self._walls.register(
            points, guess, prior, z_m=0.0, sigma_range_m=SIGMA_RANGE_M, gate_m=GATE_M, max_iterations=20
        )

    def _is_new_place(self) -> bool:
        moved = self._pose - self._keyframe
        return math.hypot(moved[0], moved[1]) > KEYFRAME_M or abs(wrap_angle(float(moved[2]))) > KEYFRAME_RAD

    def _insert(self, points: Array) -> None:
        self._keyframe = self._pose.copy()
        placed = points @ rotation2(float(self._pose[2])).T + self._pose[:2]
        self._walls.insert(placed, 0.0, np.zeros(3))


def _is_plausible(pose: Array, guess: Array, dt: float, *, is_speed_known: bool) -> bool:
    """Whether a robot can have come there: no jumps, however well the walls seem to fit."""
    off = pose - guess
    reach = MAX_ACCELERATION_MPS2 * dt * dt if is_speed_known else MAX_SPEED_MPS * dt
    near = math.hypot(off[0], off[1]) <= 0.15 + reach
    return near and abs(wrap_angle(float(off[2]))) <= 0.15 + MAX_TURN_RADPS2 * dt * dt


def _moved(pose: Array, step: Array) -> Array:
    moved = pose.copy()
    moved[:2] += rotation2(float(pose[2] + step[2] / 2)) @ step[:2]
    moved[2] += step[2]
    return moved
