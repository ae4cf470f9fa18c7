"""Position and yaw between and over scans: a Kalman filter on gyro, tilt and the registrations.

State of the planar filter: x, y, vx, vy, bx, by, yaw, yaw rate offset. b is an acceleration that the tilt does not
explain (wind, drag, attitude error); the last is what the gyro still reads at rest.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.jit import kernel
from companion.messages import Array
from companion.odometry.attitude import AttitudeHistory, interpolate_at

GRAVITY = 9.80665
MAX_ACCELERATION = 3.0  # m/s^2 that tilt is believed to give
VELOCITY_NOISE = 0.08  # m/s per sqrt(s): what neither tilt nor b explains
ACCELERATION_WALK = 0.15  # m/s^2 per sqrt(s)
YAW_NOISE = 3e-4  # rad per sqrt(s): of the gyro, and of when its samples and the scans were
GYRO_TURN_NOISE = 4e-3  # rad per sqrt(rad) turned: a scale that is 0.3 % off, over a quarter turn
GYRO_WALK = 1e-5  # rad/s per sqrt(s)
STEP_S = 0.02
MAX_STEPS = 250
N = 8
YAW = 6  # in the state; its rate's offset comes after it


class Planar(NamedTuple):
    """Immutable: state (8,), covariance (8, 8), at t_ns."""

    t_ns: int
    x: Array
    p: Array


@kernel
def _carry(
    x: Array, p: Array, t_ns: int, span_ns: int, steps: int, sample_ns: NDArray[np.int64], samples: Array
) -> tuple[Array, Array]:
    """State and covariance carried on by span_ns from t_ns, in even steps, through the attitude as it was sampled.

    sample_ns, samples: (N,), (N, 4) as of AttitudeHistory.
    """
    x, p = x.copy(), p.copy()
    step_s = float(span_ns) * 1e-9 / steps
    roll, pitch, gyro_yaw, _ = interpolate_at(t_ns, sample_ns, samples)
    for i in range(1, steps + 1):
        forward = min(max(GRAVITY * math.tan(pitch), -MAX_ACCELERATION), MAX_ACCELERATION)
        left = min(max(-GRAVITY * math.tan(roll), -MAX_ACCELERATION), MAX_ACCELERATION)
        c, s = math.cos(x[6]), math.sin(x[6])
        ax, ay = c * forward - s * left + x[4], s * forward + c * left + x[5]
        before = gyro_yaw
        roll, pitch, gyro_yaw, _ = interpolate_at(t_ns + i * span_ns // steps, sample_ns, samples)
        x[0] += x[2] * step_s + 0.5 * ax * step_s**2
        x[1] += x[3] * step_s + 0.5 * ay * step_s**2
        x[2] += ax * step_s
        x[3] += ay * step_s
        x[6] += gyro_yaw - before - x[7] * step_s
        _spread(p, step_s, abs(gyro_yaw - before))
    return x, p


@kernel
def _spread(p: Array, step_s: float, turned_rad: float) -> None:
    """F P F' plus noise, in place, of a step that turned by so much.

    F is the unit matrix and: position from velocity, velocity from b, yaw from offset.
    """
    for k in range(N):
        for i in range(4):
            p[i, k] += step_s * p[i + 2, k]
        p[6, k] -= step_s * p[7, k]
    for k in range(N):
        for i in range(4):
            p[k, i] += step_s * p[k, i + 2]
        p[k, 6] -= step_s * p[k, 7]
    for k in range(2):
        p[2 + k, 2 + k] += VELOCITY_NOISE**2 * step_s
        p[4 + k, 4 + k] += ACCELERATION_WALK**2 * step_s
    p[6, 6] += YAW_NOISE**2 * step_s + GYRO_TURN_NOISE**2 * turned_rad
    p[7, 7] += GYRO_WALK**2 * step_s


def start(t_ns: int) -> Planar:
    """At the origin of `map`, by definition exactly; standing still as far as is known."""
    sigma = np.array([1e-4, 1e-4, 0.3, 0.3, 0.1, 0.1, 1e-5, 2e-3])
    return Planar(t_ns, np.zeros(N), np.diag(sigma**2))


def carry(state: Planar, history: AttitudeHistory, t_ns: int) -> Planar:
    """The state at t_ns, by tilt and gyro; unchanged when t_ns is not later."""
    span_ns = t_ns - state.t_ns
    if span_ns <= 0:
        return state
    steps = max(1, min(MAX_STEPS, round(span_ns * 1e-9 / STEP_S)))
    x, p = _carry(state.x, state.p, state.t_ns, span_ns, steps, history.t_ns, history.values)
    return Planar(t_ns, x, p)


def velocity_level(planar: Planar, vertical: Vertical) -> Array:
    """(3,) m/s in the z-up frame with the body's heading."""
    vx, vy, yaw = float(planar.x[2]), float(planar.x[3]), float(planar.x[6])
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([c * vx + s * vy, -s * vx + c * vy, vertical.x[1]])


POSE = [0, 1, 6]
POSE_BLOCK = np.ix_(POSE, POSE)


def update(
    state: Planar,
    pose: Array,
    information: Array,
    apparent: Array,
    prior_information: Array,
    floor_variance: Array,
    *,
    holds_yaw: bool = False,
) -> Planar:
    """Fuse a registration that was found with a prior about the state's own pose.

    pose: (3,) where points and prior agree. information: (3, 3) of the points alone, may be singular.
    apparent: (3, 3) the information that the registration itself went by.
    floor_variance: (3,) what a registration errs by however many points agree (the walls' own errors).
    holds_yaw: leave yaw to the gyro as it is, and take x and y as seen from that yaw. (Where little tells of yaw, what many
    scans seem to tell of it is the error of their normals, adding up.)
    """
    x, p = _update(
        state.x, state.p, pose, np.ascontiguousarray(information), np.ascontiguousarray(apparent), prior_information,
        floor_variance, holds_yaw,
    )  # fmt: skip
    return Planar(state.t_ns, x, p)


@kernel
def _update(
    x: Array,
    p: Array,
    pose: Array,
    information: Array,
    apparent: Array,
    prior: Array,
    floor_variance: Array,
    holds_yaw: bool,
) -> tuple[Array, Array]:
    """State (8,) and covariance (8, 8) after a registration; arguments as of `update`, matrices C-contiguous."""
    off = np.array([pose[0] - x[0], pose[1] - x[1], pose[2] - x[6]])
    shift = (apparent + prior) @ off  # = apparent (ML pose - state's pose)
    gradient = information @ np.linalg.solve(apparent + 1e-3 * np.eye(3), shift)
    x = x.copy()
    if holds_yaw:
        information = np.zeros((3, 3))
        information[:2, :2] = apparent[:2, :2]
        gradient = np.array([shift[0], shift[1], 0.0])
        p = p.copy()
        p[:YAW, YAW:] = 0.0
        p[YAW:, :YAW] = 0.0
        x[YAW + 1] = 0.0  # the flight controller has taken it out, by the yaw that we told it: twice would run away
    discount = np.linalg.inv(np.eye(3) + information * floor_variance)
    information = discount @ information
    total = np.linalg.inv(p)
    at = (0, 1, 6)  # POSE
    for i in range(3):
        for k in range(3):
            total[at[i], at[k]] += 0.5 * (information[i, k] + information[k, i])
    p = np.linalg.inv(total)
    p = 0.5 * (p + p.T)
    pull = discount @ gradient
    for i in range(N):
        x[i] += p[i, 0] * pull[0] + p[i, 1] * pull[1] + p[i, 6] * pull[2]
    return x, p


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
    (p00, p01), (_, p11) = state.p.tolist()
    z, vz = state.x.tolist()
    q = CLIMB_NOISE**2 * dt
    a = p00 + 2 * dt * p01 + dt * dt * p11 + q * dt * dt / 3
    b = p01 + dt * p11 + q * dt / 2
    return Vertical(t_ns, np.array([z + dt * vz, vz]), np.array([[a, b], [b, p11 + q]]))


def update_vertical(state: Vertical, z_m: float, variance: float) -> Vertical:
    (p00, p01), (p10, p11) = state.p.tolist()
    z, vz = state.x.tolist()
    gain_z, gain_v = p00 / (p00 + variance), p10 / (p00 + variance)
    off = z_m - z
    cross = 0.5 * ((p01 - gain_z * p01) + (p10 - gain_v * p00))
    p = np.array([[p00 - gain_z * p00, cross], [cross, p11 - gain_v * p01]])
    return Vertical(state.t_ns, np.array([z + gain_z * off, vz + gain_v * off]), p)


def stopped_vertical(state: Vertical) -> Vertical:
    """Nobody knows how it climbs: on average not at all."""
    return Vertical(state.t_ns, np.array([float(state.x[0]), 0.0]), state.p)


def found_vertical(state: Vertical, z_m: float, variance: float) -> Vertical:
    """At another height than was thought, which says nothing of how fast it climbs."""
    return Vertical(state.t_ns, np.array([z_m, 0.0]), np.diag([variance, 0.5**2]))


def let_go(state: Planar, gyro_offset_radps: float, stood_s: float, turned_rad: float) -> Planar:
    """Standing has just ended: near the origin still, and slow; what the gyro read meanwhile is its offset. turned_rad: by
    the gyro, since it surely stood."""
    offset_sigma = min(2e-3, max(3e-5, 6e-4 / max(stood_s, 1e-3) ** 0.5))
    sigma = np.array([0.01, 0.01, 0.05, 0.05, 0.1, 0.1, 0.0005, offset_sigma])
    x = np.zeros(N)
    x[6] = turned_rad
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
