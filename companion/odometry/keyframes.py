"""Scans that wait for the next keyframe, and how they then go into the maps."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from companion.geometry import rotation2
from companion.messages import Array
from companion.odometry.height_map import HeightMap
from companion.odometry.standstill import NOTICED_LATE
from companion.odometry.wall_map import WallMap

MOST_WAITING = 100  # scans kept until the next keyframe


class PlacedScan(NamedTuple):
    """A registered scan: layer (N, 2), ground (M, 4), sensor (3,), levelled; pose x, y, yaw, and z, map."""

    layer: Array
    ground: Array
    sensor: Array
    pose: Array
    z_m: float
    variance: Array  # (4,) x, y, yaw, z


class WaitingScans:
    """In the order they came; the oldest go first when there are too many."""

    def __init__(self) -> None:
        self._scans: list[PlacedScan] = []

    def add(self, scan: PlacedScan) -> None:
        self._scans.append(scan)
        del self._scans[:-MOST_WAITING]

    def drop_moved(self) -> None:
        """It no longer stands, and has not for about as long as it takes to notice."""
        del self._scans[-NOTICED_LATE:]

    def put_into(self, walls: WallMap, ground: HeightMap, sigma_range_m: float, *, is_standing: bool) -> None:
        """Put them into the maps; while standing the newest wait on, since motion is noticed late."""
        count = len(self._scans) - (NOTICED_LATE if is_standing else 0)
        ready, self._scans = self._scans[:count], self._scans[count:]
        for scan in ready:
            r = rotation2(float(scan.pose[2])).T
            walls.insert(scan.layer @ r + scan.pose[:2], scan.z_m, scan.variance[:3])
            sight = scan.ground.copy()
            sight[:, :2] = scan.ground[:, :2] @ r
            origin = np.array([*scan.pose[:2], scan.z_m])
            sensor = np.array([*(scan.sensor[:2] @ r), scan.sensor[2]])
            ground.insert(sight, origin, sensor, sigma_range_m, float(scan.variance[3]))
