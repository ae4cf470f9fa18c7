"""What others get to see of the odometry's state, at any time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from companion.geometry import matrix_from_quat, quat_from_rpy
from companion.messages import Array, OdometryEstimate
from companion.odometry.attitude import AttitudeHistory
from companion.odometry.filter import POSE, Planar, Vertical, carry, carry_vertical

TILT_SIGMA_RAD = 0.005  # of roll and pitch as the flight controller gives them


_PLACE = np.ix_([0, 1, 5], [0, 1, 5])  # x, y, yaw in a pose's covariance
_POSE_BLOCK = np.ix_(POSE, POSE)


class Snapshot(NamedTuple):
    """Immutable state after a scan; map_variance: (4,) of the map itself where it was used, x, y, yaw, z."""

    t_scan_ns: int
    planar: Planar
    vertical: Vertical
    map_variance: Array
    tilt_offset_rad: tuple[float, float]
    tilt_variance: float
    quality: int
    reset_counter: int
    converged: bool
    is_degenerate: bool
    inliers: int
    iterations: int
    keyframe_id: int
    is_keyframe: bool


def estimate_at(snapshot: Snapshot, history: AttitudeHistory, t_ns: int, *, is_scan: bool) -> OdometryEstimate:
    """The estimate carried on to t_ns (not before the snapshot), its covariance grown accordingly."""
    planar = carry(snapshot.planar, history, t_ns)
    vertical = carry_vertical(snapshot.vertical, t_ns)
    attitude = history.at(np.array([t_ns], np.int64))[0]
    roll, pitch = attitude[0] + snapshot.tilt_offset_rad[0], attitude[1] + snapshot.tilt_offset_rad[1]
    q = quat_from_rpy(float(roll), float(pitch), float(planar.x[6]))
    r = matrix_from_quat(q)
    velocity_map = np.array([planar.x[2], planar.x[3], vertical.x[1]])
    covariance = np.zeros((6, 6))
    covariance[_PLACE] = planar.p[_POSE_BLOCK] + np.diag(snapshot.map_variance[:3])
    covariance[2, 2] = vertical.p[0, 0] + snapshot.map_variance[3]
    covariance[3, 3] = covariance[4, 4] = TILT_SIGMA_RAD**2
    velocity_covariance = np.zeros((3, 3))
    velocity_covariance[:2, :2] = planar.p[2:4, 2:4]
    velocity_covariance[2, 2] = vertical.p[1, 1]
    return OdometryEstimate(
        t_ns=t_ns,
        t_scan_ns=snapshot.t_scan_ns,
        position_map_m=np.array([planar.x[0], planar.x[1], vertical.x[0]]),
        q_map_body_wxyz=q,
        velocity_body_mps=r.T @ velocity_map,
        rate_body_radps=history.rate_body_radps,
        pose_covariance=covariance,
        velocity_covariance=r.T @ velocity_covariance @ r,
        quality=snapshot.quality,
        reset_counter=snapshot.reset_counter,
        converged=snapshot.converged,
        is_degenerate=snapshot.is_degenerate,
        inliers=snapshot.inliers,
        iterations=snapshot.iterations,
        keyframe_id=snapshot.keyframe_id,
        is_keyframe=snapshot.is_keyframe and is_scan,
    )
