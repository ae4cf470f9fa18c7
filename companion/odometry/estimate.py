"""What others get to see of the odometry's state, at any time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.geometry import quat_from_rpy, rotation_matrix
from companion.jit import kernel
from companion.messages import Array, OdometryEstimate
from companion.odometry.attitude import AttitudeHistory, interpolate_at
from companion.odometry.filter import Planar, Vertical, carry, carry_vertical

TILT_SIGMA_RAD = 0.005  # of roll and pitch as the flight controller gives them

_quaternion, _rotation = kernel(quat_from_rpy), kernel(rotation_matrix)


class Snapshot(NamedTuple):
    """Immutable state after a scan; map_variance: (4,) of the map itself where it was used, x, y, yaw, z; drift_variance: of
    z, by the tilt that the ground's map was built with."""

    t_scan_ns: int
    planar: Planar
    vertical: Vertical
    map_variance: Array
    tilt_offset_rad: tuple[float, float]
    drift_variance: float
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
    map_variance = snapshot.map_variance + np.array([0.0, 0.0, 0.0, snapshot.drift_variance])
    position, q, velocity_body, pose_covariance, velocity_covariance = _seen_from_outside(
        planar.x, planar.p, vertical.x, vertical.p, map_variance, t_ns, history.t_ns, history.values,
        *snapshot.tilt_offset_rad,
    )  # fmt: skip
    return OdometryEstimate(
        t_ns=t_ns,
        t_scan_ns=snapshot.t_scan_ns,
        position_map_m=position,
        q_map_body_wxyz=q,
        velocity_body_mps=velocity_body,
        rate_body_radps=history.rate_body_radps,
        pose_covariance=pose_covariance,
        velocity_covariance=velocity_covariance,
        quality=snapshot.quality,
        reset_counter=snapshot.reset_counter,
        converged=snapshot.converged,
        is_degenerate=snapshot.is_degenerate,
        inliers=snapshot.inliers,
        iterations=snapshot.iterations,
        keyframe_id=snapshot.keyframe_id,
        is_keyframe=snapshot.is_keyframe and is_scan,
    )


@kernel
def _seen_from_outside(
    x: Array,
    p: Array,
    vertical_x: Array,
    vertical_p: Array,
    map_variance: Array,
    t_ns: int,
    sample_ns: NDArray[np.int64],
    samples: Array,
    roll_offset_rad: float,
    pitch_offset_rad: float,
) -> tuple[Array, Array, Array, Array, Array]:
    """Position (3,), q wxyz (4,), body velocity (3,), pose (6, 6) and body velocity (3, 3) covariance at t_ns.

    x, p: planar state (8,), (8, 8); vertical_x, vertical_p: z and vz, (2,), (2, 2); sample_ns, samples: as of
    AttitudeHistory.
    """
    roll, pitch, _, _ = interpolate_at(t_ns, sample_ns, samples)
    q = _quaternion(roll + roll_offset_rad, pitch + pitch_offset_rad, x[6])
    r = _rotation(q[0], q[1], q[2], q[3])
    position = np.array([x[0], x[1], vertical_x[0]])
    velocity = np.array([x[2], x[3], vertical_x[1]])  # in map, as is its covariance
    variance = np.array([[p[2, 2], p[2, 3], 0.0], [p[3, 2], p[3, 3], 0.0], [0.0, 0.0, vertical_p[1, 1]]])
    pose = np.zeros((6, 6))
    source, target = (0, 1, 6), (0, 1, 5)  # x, y, yaw in the state and in a pose's covariance
    for i in range(3):
        for k in range(3):
            pose[target[i], target[k]] = p[source[i], source[k]]
        pose[target[i], target[i]] += map_variance[i]
    pose[2, 2] = vertical_p[0, 0] + map_variance[3]
    pose[3, 3] = pose[4, 4] = TILT_SIGMA_RAD**2
    velocity_body, half, turned = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
    for i in range(3):
        for k in range(3):
            velocity_body[i] += r[k, i] * velocity[k]
            for j in range(3):
                half[i, k] += r[j, i] * variance[j, k]
    for i in range(3):
        for k in range(3):
            for j in range(3):
                turned[i, k] += half[i, j] * r[j, k]
    return position, q, velocity_body, pose, turned
