"""Velodyne captures to scans, by velodyne-decoder (extra "import"): recordings only, nothing that flies uses it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from companion.errors import FileFormatError
from companion.messages import Array


@dataclass(frozen=True, slots=True)
class VelodyneScan:
    """t_ns: the device's time of the last return, ns since 1970. points_lidar: (N, 3), x forward, y left, z up.
    t_point_ns: (N,) time of each point."""

    t_ns: int
    points_lidar: Array
    t_point_ns: np.ndarray[tuple[int], np.dtype[np.int64]]


def read_velodyne(path: Path) -> Iterator[VelodyneScan]:
    """Each full turn in a capture. Raises: FileFormatError: the decoder is not installed, or knows no such sensor."""
    try:
        import velodyne_decoder
    except ImportError:
        raise FileFormatError(
            f'{path}: Velodyne captures need the extra "import": pip install "stockpilot[import]"'
        ) from None
    try:
        for stamp, points in velodyne_decoder.read_pcap(str(path)):
            end_ns = round(float(stamp.device) * 1e9)
            columns = np.asarray(points, dtype=np.float64)  # x, y, z, intensity, ring, time
            xyz = np.ascontiguousarray(columns[:, :3])
            times = end_ns + np.round(columns[:, 5] * 1e9).astype(np.int64)
            yield VelodyneScan(end_ns, xyz, times)
    except (RuntimeError, ValueError) as error:
        raise FileFormatError(f"{path}: not a Velodyne capture that can be decoded: {error}") from None
