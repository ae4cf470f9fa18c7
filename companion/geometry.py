"""Rotations and rigid transforms, in numpy. Quaternions are (w, x, y, z), unit, Hamilton."""

from __future__ import annotations

import math

import numpy as np

from companion.messages import Array


def wrap_angle(angle_rad: float) -> float:
    """The same angle in [-pi, pi)."""
    return (angle_rad + math.pi) % (2.0 * math.pi) - math.pi


def rotation2(yaw_rad: float) -> Array:
    """(2, 2) rotation, counter-clockwise."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    return np.array([[c, -s], [s, c]])


def quat_multiply(a_wxyz: Array, b_wxyz: Array) -> Array:
    """Hamilton product a * b, (4,)."""
    aw, ax, ay, az = a_wxyz
    bw, bx, by, bz = b_wxyz
    return np.array(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


def quat_conjugate(q_wxyz: Array) -> Array:
    return np.array([q_wxyz[0], -q_wxyz[1], -q_wxyz[2], -q_wxyz[3]])


def quat_from_rpy(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Array:
    """Intrinsic z-y'-x'' (yaw, pitch, roll)."""
    cr, sr = math.cos(roll_rad / 2), math.sin(roll_rad / 2)
    cp, sp = math.cos(pitch_rad / 2), math.sin(pitch_rad / 2)
    cy, sy = math.cos(yaw_rad / 2), math.sin(yaw_rad / 2)
    return np.array(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


def rpy_from_quat(q_wxyz: Array) -> tuple[float, float, float]:
    """(roll, pitch, yaw), rad; pitch in [-pi/2, pi/2]."""
    return rpy_from_parts(*q_wxyz.tolist())


def rpy_from_parts(w: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """The same of a quaternion's parts."""
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return roll, pitch, yaw


def yaw_from_quat(q_wxyz: Array) -> float:
    w, x, y, z = q_wxyz.tolist()
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def rotation_matrix(w: float, x: float, y: float, z: float) -> Array:
    """(3, 3) of a unit quaternion's parts."""
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def matrix_from_quat(q_wxyz: Array) -> Array:
    """(3, 3) rotation matrix."""
    return rotation_matrix(*q_wxyz.tolist())


def quat_from_rotvec(rotvec_rad: Array) -> Array:
    """Quaternion of a rotation vector (axis times angle)."""
    angle = math.sqrt(float(rotvec_rad @ rotvec_rad))
    if angle < 1e-12:
        q = np.array([1.0, 0.5 * rotvec_rad[0], 0.5 * rotvec_rad[1], 0.5 * rotvec_rad[2]])
        return q / math.sqrt(float(q @ q))
    s = math.sin(angle / 2) / angle
    return np.array([math.cos(angle / 2), s * rotvec_rad[0], s * rotvec_rad[1], s * rotvec_rad[2]])


def quat_slerp(a_wxyz: Array, b_wxyz: Array, ratio: float) -> Array:
    """Between two quaternions, 0 gives a, 1 gives b, the short way round."""
    dot = float(a_wxyz @ b_wxyz)
    b = -b_wxyz if dot < 0 else b_wxyz
    dot = abs(dot)
    if dot > 0.9995:
        q = a_wxyz + ratio * (b - a_wxyz)
    else:
        theta = math.acos(dot)
        q = (math.sin((1 - ratio) * theta) * a_wxyz + math.sin(ratio * theta) * b) / math.sin(theta)
    return np.asarray(q / math.sqrt(float(q @ q)))
