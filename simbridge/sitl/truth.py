"""The true pose, for what stands in for sensors of a simulated autopilot.

ArduPilot's JSON protocol asks for the pose itself: its own software makes barometer and other sensors from it. For PX4
it turns the earth's magnetic field. Both estimators still get their position from the companion only.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

WORLD_TO_NED = np.array([1.0, -1.0, -1.0])  # world is x north, y west, z up; the same turns FLU into FRD
MAGNETIC_FIELD_NED_GAUSS = np.array([0.215, 0.01, 0.425])  # at 47.4 N 8.5 E, as in the recording hil_lockstep


class Pose(Protocol):
    """Where the vehicle is. All (3,) in world but q_world_body_wxyz, (4,) unit, body is FLU."""

    @property
    def position_world_m(self) -> Array: ...
    @property
    def velocity_world_mps(self) -> Array: ...
    @property
    def q_world_body_wxyz(self) -> Array: ...


PoseSource = Callable[[], Pose]


def q_ned_frd_wxyz(q_world_body_wxyz: Array) -> Array:
    """The same attitude, of the FRD body in NED: y and z of the axis change their sign."""
    w, x, y, z = q_world_body_wxyz
    return np.array([w, x, -y, -z])


def rotate_inverse(q_wxyz: Array, vector: Array) -> Array:
    """A vector of the outer frame in the inner one; q inner to outer, unit."""
    w, x, y, z = q_wxyz.tolist()
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )
    a, b, c = vector.tolist()
    return np.array([r[0] * a + r[1] * b + r[2] * c for r in rows])


def magnetic_field_frd_gauss(pose: Pose, noise_gauss: Array) -> Array:
    """(3,) what an ideal magnetometer in the body reads, plus the noise given."""
    return rotate_inverse(q_ned_frd_wxyz(pose.q_world_body_wxyz), MAGNETIC_FIELD_NED_GAUSS) + noise_gauss
