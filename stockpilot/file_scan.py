"""A scan out of somebody's recording, whatever kind of file it was in."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from companion.messages import Array
from stockpilot.file_kinds import FileKind

HORIZONTAL_BAND_RAD = math.radians(1.5)  # of a 3D scan, what is nearer to the horizon than this makes the planar scan
CUT = "what follows: the file is cut or broken"
_SICK_BEAMS, _SICK_STEP_RAD = 180, math.radians(1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class FileScan:
    """One scan in its sensor's frame (x forward, y left, z up).

    points: (N, 2) float64, the horizontal layer. points_3d: (M, 3), all of it (z 0 for a 2D scanner).
    """

    t_ns: int
    points: Array
    points_3d: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanFile:
    """A recording's scans and where they come from (for people)."""

    kind: FileKind
    sensor: str
    scans: Iterator[FileScan]
    dropped: dict[str, int]


def scan_from_ranges(t_ns: int, ranges: Array, angles: Array, range_min: float, range_max: float) -> FileScan:
    """A 2D scan; beams without a return (out of bounds, inf, NaN) are left out."""
    with np.errstate(invalid="ignore"):
        seen = np.isfinite(ranges) & (ranges >= range_min) & (ranges < range_max) & (ranges > 0)
    r, a = ranges[seen], angles[seen]
    points = np.stack([r * np.cos(a), r * np.sin(a)], axis=1)
    return FileScan(t_ns=t_ns, points=points, points_3d=np.column_stack([points, np.zeros(len(points))]))


def scan_from_points(t_ns: int, points_3d: Array) -> FileScan:
    """A 3D scan: its points near the horizon make the planar one."""
    points_3d = points_3d[np.isfinite(points_3d).all(axis=1)]
    flat = np.hypot(points_3d[:, 0], points_3d[:, 1])
    near = (flat > 0.3) & (np.abs(points_3d[:, 2]) <= flat * math.tan(HORIZONTAL_BAND_RAD))
    return FileScan(t_ns=t_ns, points=points_3d[near, :2].copy(), points_3d=points_3d)


def beam_step(count: int, step_rad: float) -> float:
    """The angle between two beams. 180 beams said to span just half a turn are a SICK LMS's, 1 degree apart: the
    converters that made such files divided by 179 (Freiburg's Intel and ACES logs)."""
    if count == _SICK_BEAMS and abs(step_rad - math.pi / (_SICK_BEAMS - 1)) < 1e-5:
        return _SICK_STEP_RAD
    return step_rad
