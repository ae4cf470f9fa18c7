"""Between the companion's frames (map, body: forward/left/up) and the autopilot's (local NED, FRD body).

The only file that knows NED and FRD. The autopilot's local frame is `map` turned half a turn about x, so one sign
pattern (1, -1, -1) serves for both ways and for the body too. That map's x is called north is a convention: with
vision as the source of yaw the autopilot takes it over.
"""

from __future__ import annotations

import numpy as np

from companion.messages import Array

# Upper triangle of a (6, 6), row by row: MAVLink's 21 elements.
_ROWS, _COLUMNS = np.triu_indices(6)
_FLIP6 = np.array([1.0, -1.0, -1.0, 1.0, -1.0, -1.0])
_TRIANGLE = _ROWS * 6 + _COLUMNS
_TRIANGLE_SIGN = _FLIP6[_ROWS] * _FLIP6[_COLUMNS]
_NAN = float("nan")


def flip(vector: Array) -> tuple[float, float, float]:
    """map -> NED, NED -> map, FLU -> FRD, FRD -> FLU: it is its own inverse."""
    x, y, z = vector.tolist()
    return x, -y, -z


def vector_from_frd(x: float, y: float, z: float) -> Array:
    """NED -> map, FRD -> FLU."""
    return np.array([x, -y, -z])


def quaternion_to_ned_frd(q_map_body_wxyz: Array) -> tuple[float, float, float, float]:
    """Rotation FRD body -> NED for the same attitude, normalised in double precision: rounded to float32 its norm is
    then off by no more than 1e-7, where PX4 allows 1e-5 (PX4.md, 5)."""
    w, x, y, z = q_map_body_wxyz.tolist()
    scale = 1.0 / (w * w + x * x + y * y + z * z) ** 0.5
    return w * scale, x * scale, -y * scale, -z * scale


def quaternion_from_ned_frd(w: float, x: float, y: float, z: float) -> Array | None:
    """FLU body -> z-up reference; None when it is no rotation (zero, NaN)."""
    norm2 = w * w + x * x + y * y + z * z
    if not 0.5 < norm2 < 2.0:
        return None
    scale = 1.0 / norm2**0.5
    return np.array([w * scale, x * scale, -y * scale, -z * scale])


def pose_covariance_to_ned(covariance: Array) -> list[float]:
    """(6, 6) in map -> 21 elements in NED: x, y, z, roll, pitch, yaw."""
    out: list[float] = (covariance.ravel()[_TRIANGLE] * _TRIANGLE_SIGN).tolist()
    return out


def velocity_covariance_to_frd(covariance: Array) -> list[float]:
    """(3, 3) in FLU -> 21 elements in FRD; what belongs to the turn rates is not known: NaN."""
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = covariance.tolist()
    n = _NAN
    return [xx, -xy, -xz, n, n, n, yy, yz, n, n, n, zz, n, n, n, n, n, n, n, n, n]
