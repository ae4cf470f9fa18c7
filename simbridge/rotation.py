"""Rotation matrices from angles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def matrix_from_rpy(rpy_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) from roll, pitch, yaw: first roll about x, then pitch about y, then yaw about z, fixed axes."""
    (cr, cp, cy), (sr, sp, sy) = (np.cos(rpy_rad).tolist(), np.sin(rpy_rad).tolist())
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
