"""Position and yaw between and over scans: a Kalman filter on gyro, tilt and the registrations.

State of the planar filter: x, y, vx, vy, bx, by, yaw, yaw rate offset. b is an acceleration that the tilt does not
explain (wind, drag, attitude error); the last is what the gyro still reads at rest.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from companion.messages import Array
from companion.odometry.attitude import AttitudeHistory
from companion.odometry.jit import kernel

GRAVITY = 9.80665
MAX_ACCELERATION = 3.0  # m/s^2 that tilt is believed to give
VELOCITY_NOISE = 0.08  # m/s per sqrt(s): what neither tilt nor b explains
ACCELERATION_WALK = 0.15  # m/s^2 per sqrt(s)
YAW_NOISE = 0.001  # rad per sqrt(s)
GYRO_WALK = 2e-5  # rad/s per sqrt(s)
STEP_S = 0.02
N = 8


class Planar(NamedTuple):
    """Immutable: state (8,), covariance (8, 8), at t_ns."""

    t_ns: int
    x: Array
    p: Array


@kernel
def _carry(x: Array, p: Array, roll: Array, pitch: Array, yaw_gyro: Array, step_s: float) -> tuple[Array, Array]:
    """Carry state and covariance through samples of attitude, evenly spaced by step_s."""
    x, p = x.copy(), p.copy()
    f = np.eye(8)
    for i in range(len(roll) - 1):
        forward = min(max(9.80665 * np.tan(pitch[i]), -3.0), 3.0)
        left = min(max(-9.80665 * np.tan(roll[i]), -3.0), 3.0)
        c, s = np.cos(x[6]), np.sin(x[6])
        ax, ay = c * forward - s * left + x[4], s * forward + c * left + x[5]
        x[0] += x[2] * step_s + 0.5 * ax * step_s**2
        x[1] += x[3] * step_s + 0.5 * ay * step_s**2
        x[2] += ax * step_s
        x[3] += ay * step_s
        x[6] += yaw_gyro[i + 1] - yaw_gyro[i] - x[7] * step_s
        f[0, 2] = f[1, 3] = f[2, 4] = f[3, 5] = step_s
        f[6, 7] = -step_s
        p = f @ p @ f.T
        for k in range(2):
            p[2 + k, 2 + k] += 0.08**2 * step_s
            p[4 + k, 4 + k] += 0.15**2 * step_s
        p[6, 6] += 0.001**2 * step_s
        p[7, 7] += 2e-5**2 * step_s
    return x, p


def start(t_ns: int) -> Planar:
    """At the origin of `map`, by definition exactly; standing still as far as is known."""
    sigma = np.array([1e-4, 1e-4, 0.3, 0.3, 0.1, 0.1, 1e-5, 2e-3])
    return Planar(t_ns, np.zeros(N), np.diag(sigma**2))


def carry(state: Planar, history: AttitudeHistory, t_ns: int) -> Planar:
    """The state at t_ns, by tilt and gyro; unchanged when t_ns is not later."""
    dt_s = (t_ns - state.t_ns) * 1e-9
    if dt_s <= 0.0:
        return state
    steps = max(1, min(250, round(dt_s / STEP_S)))
    times = state.t_ns + (np.arange(steps + 1) * (t_ns - state.t_ns)) // steps
    a = history.at(times.astype(np.int64))
    x, p = _carry(state.x, state.p, a[:, 0], a[:, 1], a[:, 2], dt_s / steps)
    return Planar(t_ns, x, p)


POSE = [0, 1, 6]
_C = np.zeros((3, N))
_C[[0, 1, 2], POSE] = 1.0


def update(
    state: Planar, pose: Array, information: Array, apparent: Array, prior_information: Array, floor_variance: Array
) -> Planar:
    """Fuse a registration that was found with a prior about the state's own pose.

    pose: (3,) where points and prior agree. information: (3, 3) of the points alone, may be singular.
    apparent: (3, 3) the information that the registration itself went by.
    floor_variance: (3,) what a registration errs by however many points agree (the walls' own errors).
    """
    shift = (apparent + prior_information) @ (pose - state.x[POSE])  # = apparent (ML pose - state's pose)
    gradient = information @ np.linalg.solve(apparent + 1e-3 * np.eye(3), shift)
    discount = np.linalg.inv(np.eye(3) + information * floor_variance)
    information = discount @ information
    total = np.linalg.inv(state.p)
    total[np.ix_(POSE, POSE)] += 0.5 * (information + information.T)
    p = np.linalg.inv(total)
    p = 0.5 * (p + p.T)
    x = state.x + p[:, POSE] @ (discount @ gradient)
    return Planar(state.t_ns, x, p)


class Vertical(NamedTuple):
    """Immutable: z and vz with their covariance (2, 2), at t_ns."""

    t_ns: int
    x: Array
    p: Array


CLIMB_NOISE = 0.35  # m/s per sqrt(s): the motors may do this at any time


def start_vertical(t_ns: int) -> Vertical:
    return Vertical(t_ns, np.zeros(2), np.diag([1e-8, 0.05**2]))


def carry_vertical(state: Vertical, t_ns: int) -> Vertical:
    dt = (t_ns - state.t_ns) * 1e-9
    if dt <= 0.0:
        return state
    p00, p01, p11 = state.p[0, 0], state.p[0, 1], state.p[1, 1]
    q = CLIMB_NOISE**2 * dt
    a = p00 + 2 * dt * p01 + dt * dt * p11 + q * dt * dt / 3
    b = p01 + dt * p11 + q * dt / 2
    return Vertical(t_ns, np.array([state.x[0] + dt * state.x[1], state.x[1]]), np.array([[a, b], [b, p11 + q]]))


def update_vertical(state: Vertical, z_m: float, variance: float) -> Vertical:
    gain = state.p[:, 0] / (state.p[0, 0] + variance)
    x = state.x + gain * (z_m - state.x[0])
    p = state.p - np.outer(gain, state.p[0])
    return Vertical(state.t_ns, x, 0.5 * (p + p.T))


def let_go(state: Planar, gyro_offset_radps: float, stood_s: float) -> Planar:
    """Standing has just ended: near the origin still, and slow; what the gyro read meanwhile is its offset."""
    offset_sigma = min(2e-3, max(3e-5, 6e-4 / max(stood_s, 1e-3) ** 0.5))
    sigma = np.array([0.01, 0.01, 0.05, 0.05, 0.1, 0.1, 0.005, offset_sigma])
    x = np.zeros(N)
    x[7] = gyro_offset_radps
    return Planar(state.t_ns, x, np.diag(sigma**2))


def let_go_vertical(state: Vertical, z_m: float) -> Vertical:
    return Vertical(state.t_ns, np.array([z_m, 0.0]), np.diag([0.05**2, 0.5**2]))


def restart(state: Planar, pose: Array) -> Planar:
    """After the pose was found anew: there, velocity unknown."""
    x = np.zeros(N)
    x[POSE] = pose
    x[7] = state.x[7]
    sigma = np.array([0.05, 0.05, 0.5, 0.5, 0.2, 0.2, 0.02, 2e-3])
    return Planar(state.t_ns, x, np.diag(sigma**2))
