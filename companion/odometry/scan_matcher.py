"""Odometry of any horizontal laser scanner, without flight controller: the same wall map and registration alone.

For other people's recordings. What a flight gets from gyro and tilt is missing here: the guess is constant velocity, tried
with several turns when it does not fit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.geometry import rotation2, wrap_angle
from companion.messages import Array
from companion.odometry.wall_map import Registration, WallMap

TURNS_RAD = (0.0, -0.1, 0.1, -0.2, 0.2, -0.35, 0.35)  # tried about the guess
STEPS_M = (0.0, -0.3, 0.3)  # along the way of motion
GOOD_INLIER_RATIO = 0.75
MIN_INLIER_RATIO = 0.3
KEYFRAME_M, KEYFRAME_RAD = 0.15, 0.1  # moved by this much, a scan goes into the map
MAX_SPEED_MPS, MAX_RATE_RADPS = 3.0, 3.0


@dataclass(frozen=True, slots=True)
class Match2D:
    """Pose x, y, yaw in the frame of the first scan; is_matched: False where it was carried on by constant velocity."""

    t_ns: int
    pose: Array
    is_matched: bool
    inliers: int
    iterations: int


class ScanMatcher2D:
    """Scan to map, point to line. cell_m: a fifth of the window that a line is fitted to."""

    def __init__(self, *, cell_m: float = 0.1, range_sigma_m: float = 0.03) -> None:
        self.walls = WallMap(cell_m)
        self._gate_m = 4.0 * cell_m
        self._sigma_m = range_sigma_m
        self._pose = np.zeros(3)
        self._speed = np.zeros(3)  # in the body's frame: forward, left, turn
        self._t_ns: int | None = None
        self._keyframe = np.zeros(3)

    def match(self, points: Array, t_ns: int) -> Match2D:
        """Place (N, 2) points of the scanner's frame, finite, metres, seen at t_ns; times must not fall."""
        if self._t_ns is None:
            self._t_ns = t_ns
            self._insert(points)
            return Match2D(t_ns, self._pose, True, len(points), 0)
        dt_s = max((t_ns - self._t_ns) * 1e-9, 0.0)
        step = self._speed * min(dt_s, 1.0)
        guess = self._pose + np.append(rotation2(float(self._pose[2])) @ step[:2], step[2])
        found = self._best(points, guess)
        ok = found is not None and found.inliers >= MIN_INLIER_RATIO * len(points)
        pose = found.pose if found is not None and ok else guess
        self._learn_speed(pose, dt_s)
        self._pose, self._t_ns = np.array([pose[0], pose[1], wrap_angle(float(pose[2]))]), t_ns
        moved = self._pose - self._keyframe
        if ok and (np.hypot(moved[0], moved[1]) > KEYFRAME_M or abs(wrap_angle(float(moved[2]))) > KEYFRAME_RAD):
            self._insert(points)
        inliers, iterations = (found.inliers, found.iterations) if found is not None else (0, 0)
        return Match2D(t_ns, self._pose, ok, inliers, iterations)

    def _best(self, points: Array, guess: Array) -> Registration | None:
        """The registration from the guess, or the best of those from around it when that one fits badly."""
        prior = np.diag([25.0, 25.0, 25.0])
        best: Registration | None = None
        for turn in TURNS_RAD:
            for along in STEPS_M:
                ahead = rotation2(float(guess[2])) @ np.array([along, 0.0])
                trial = guess + np.array([ahead[0], ahead[1], turn])
                found = self.walls.register(
                    points,
                    trial,
                    prior,
                    sigma_range_m=self._sigma_m,
                    sigma_surface_m=0.01,
                    gate_m=self._gate_m,
                    max_iterations=20,
                )
                if np.isfinite(found.pose).all() and (best is None or found.inliers > best.inliers):
                    best = found
                if best is not None and best.inliers >= GOOD_INLIER_RATIO * len(points):
                    return best
        return best

    def _learn_speed(self, pose: Array, dt_s: float) -> None:
        if dt_s <= 0.0:
            return
        d = pose - self._pose
        body = np.append(rotation2(-float(self._pose[2])) @ d[:2], wrap_angle(float(d[2]))) / dt_s
        limit = np.array([MAX_SPEED_MPS, MAX_SPEED_MPS, MAX_RATE_RADPS])
        self._speed = 0.5 * self._speed + 0.5 * np.clip(body, -limit, limit)

    def _insert(self, points: Array) -> None:
        self.walls.insert(points @ rotation2(float(self._pose[2])).T + self._pose[:2], 0.0, np.zeros(3))
        self._keyframe = self._pose
