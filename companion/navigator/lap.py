"""When a lap has closed: back where the path was before, the same way round, with one whole turn in between."""

from __future__ import annotations

import math
from enum import Enum

import numpy as np

from companion.geometry import wrap_angle
from companion.navigator.wall_follower import Pose2

SPACING_M = 0.5
CLOSE_M = 1.5
HEADING_RAD = math.radians(35)
TURN_TOLERANCE_RAD = math.radians(60)
MIN_PATH_M = 8.0


class Lap(Enum):
    OPEN = "open"
    CLOSED = "closed"  # once counter-clockwise: the hall's own wall
    ISLAND = "island"  # once clockwise: something that stands free in the hall


class LapTracker:
    """The path since following began: places each 0.5 m with heading unwrapped, so that turns are counted.

    A path that leaves the wall to round a column and comes back has net turned nothing; a path round the hall +360
    degrees, round a free-standing thing -360. Any earlier place may close the lap, not only the first, which may lie
    where the wall had not been reached yet.
    """

    def __init__(self) -> None:
        self._x: list[float] = []
        self._y: list[float] = []
        self._heading: list[float] = []  # unwrapped
        self._length: list[float] = []
        self._last_yaw = 0.0
        self._turned = 0.0

    @property
    def turned_rad(self) -> float:
        return self._turned - (self._heading[0] if self._heading else 0.0)

    def loop_places(self) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
        """(N, 2) the path so far."""
        return np.column_stack([np.array(self._x), np.array(self._y)])

    def add(self, pose: Pose2) -> Lap:
        """Take in a pose (often: turns below 180 degrees in between) and say whether it closes a lap."""
        if not self._x:
            self._last_yaw = self._turned = pose.yaw
            self._append(pose, 0.0)
            return Lap.OPEN
        self._turned += wrap_angle(pose.yaw - self._last_yaw)
        self._last_yaw = pose.yaw
        moved = math.hypot(pose.x - self._x[-1], pose.y - self._y[-1])
        if moved < SPACING_M:
            return Lap.OPEN
        self._append(pose, self._length[-1] + moved)
        return self._closes(pose)

    def _append(self, pose: Pose2, length: float) -> None:
        self._x.append(pose.x)
        self._y.append(pose.y)
        self._heading.append(self._turned)
        self._length.append(length)

    def _closes(self, pose: Pose2) -> Lap:
        near = np.hypot(np.array(self._x) - pose.x, np.array(self._y) - pose.y) < CLOSE_M
        far_back = self._length[-1] - np.array(self._length) > MIN_PATH_M
        turned = self._turned - np.array(self._heading)
        same_way = np.abs((turned + math.pi) % (2 * math.pi) - math.pi) < HEADING_RAD
        candidates = turned[near & far_back & same_way]
        if np.any(np.abs(candidates - 2 * math.pi) < TURN_TOLERANCE_RAD):
            return Lap.CLOSED
        if np.any(np.abs(candidates + 2 * math.pi) < TURN_TOLERANCE_RAD):
            return Lap.ISLAND
        return Lap.OPEN
