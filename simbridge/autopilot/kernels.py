"""Compiled loops of the emulated flight controller: the estimator.

Everything is float64 and works in place on arrays that the callers own. Axes are FRD (body) and NED (local).

Layouts
    x (16,)          delayed state: q 0:4 (wxyz, body to NED), v 4:7, p 7:10, gyro bias 10:13, accelerometer bias 13:16
    P (15, 15)       its error covariance: rotation (NED), v, p, gyro bias, accelerometer bias
    o (25,)          newest state: q 0:4, v 4:7, p 7:10, rates 10:13, acceleration NED 13:16, velocity error sum 16:19,
                     position error sum 19:22, attitude correction per step 22:25
    ring_imu (N, 7)  delta angle 0:3, delta velocity 3:6, duration 6; ring_out (N, 10): q, v, p of the newest state then
    acc (8,)         delta angle 0:3 and delta velocity 3:6 being summed, duration 6, samples 7
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
GRAVITY = 9.80665  # m/s2, the constant PX4 uses
RING = 20  # samples of 8 ms: the horizon is 19 of them, 152 ms, behind (EKF2_DELAY_MAX 200 ms, EKF2_PREDICT_US 10 ms)
SAMPLES_PER_UPDATE = 2  # 250 Hz summed to 8 ms, the nearest to EKF2_PREDICT_US 10 ms from below


@njit(cache=True)
def _rotate(q: Array, v0: float, v1: float, v2: float) -> tuple[float, float, float]:
    """The vector of the body frame in NED."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return (
        (1 - 2 * (y * y + z * z)) * v0 + 2 * (x * y - w * z) * v1 + 2 * (x * z + w * y) * v2,
        2 * (x * y + w * z) * v0 + (1 - 2 * (x * x + z * z)) * v1 + 2 * (y * z - w * x) * v2,
        2 * (x * z - w * y) * v0 + 2 * (y * z + w * x) * v1 + (1 - 2 * (x * x + y * y)) * v2,
    )


@njit(cache=True)
def to_ned(q: Array, v0: float, v1: float, v2: float) -> tuple[float, float, float]:
    """A vector of the body frame in NED. q: quaternion in the first four (wxyz, body to NED)."""
    return _rotate(q, v0, v1, v2)


@njit(cache=True)
def _turn_body(q: Array, a0: float, a1: float, a2: float) -> None:
    """q times the small rotation a (rad, body frame), normalised."""
    n2 = a0 * a0 + a1 * a1 + a2 * a2
    s = 0.5 - n2 / 48.0
    c = 1.0 - n2 / 8.0
    b0, b1, b2 = a0 * s, a1 * s, a2 * s
    w, x, y, z = q[0], q[1], q[2], q[3]
    q[0] = w * c - x * b0 - y * b1 - z * b2
    q[1] = w * b0 + x * c + y * b2 - z * b1
    q[2] = w * b1 - x * b2 + y * c + z * b0
    q[3] = w * b2 + x * b1 - y * b0 + z * c
    n = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    for i in range(4):
        q[i] *= n


@njit(cache=True)
def turn_ned(q: Array, a0: float, a1: float, a2: float) -> None:
    """The small rotation a (rad, NED) times q."""
    n2 = a0 * a0 + a1 * a1 + a2 * a2
    n = math.sqrt(n2)
    s = 0.5 - n2 / 48.0 if n < 0.1 else math.sin(0.5 * n) / n
    c = math.cos(0.5 * n)
    b0, b1, b2 = a0 * s, a1 * s, a2 * s
    w, x, y, z = q[0], q[1], q[2], q[3]
    q[0] = c * w - b0 * x - b1 * y - b2 * z
    q[1] = c * x + b0 * w + b1 * z - b2 * y
    q[2] = c * y - b0 * z + b1 * w + b2 * x
    q[3] = c * z + b0 * y - b1 * x + b2 * w
    n = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    for i in range(4):
        q[i] *= n


@njit(cache=True)
def yaw_of(q: Array) -> float:
    """Heading, rad, in (-pi, pi]."""
    return math.atan2(2 * (q[0] * q[3] + q[1] * q[2]), 1 - 2 * (q[2] * q[2] + q[3] * q[3]))


@njit(cache=True)
def _propagate_rows(M: Array, R: Array, f0: float, f1: float, f2: float, dt: float) -> None:
    """M = F M in place, each block before the ones it reads are changed. R: body to NED; f: delta velocity, NED."""
    for c in range(15):
        t0, t1, t2 = M[0, c], M[1, c], M[2, c]
        for i in range(3):
            M[6 + i, c] += dt * M[3 + i, c]
        M[3, c] += f2 * t1 - f1 * t2
        M[4, c] += f0 * t2 - f2 * t0
        M[5, c] += f1 * t0 - f0 * t1
        for i in range(3):
            M[3 + i, c] -= dt * (R[i, 0] * M[12, c] + R[i, 1] * M[13, c] + R[i, 2] * M[14, c])
            M[i, c] -= dt * (R[i, 0] * M[9, c] + R[i, 1] * M[10, c] + R[i, 2] * M[11, c])


@njit(cache=True)
def _predict(x: Array, P: Array, d: Array, noise: Array) -> None:
    """Carry the delayed state and its covariance over one summed sample. noise: gyro, accelerometer, their biases (sd)."""
    dt = d[6]
    if dt <= 0.0:
        return
    q = x[0:4]
    f0, f1, f2 = _rotate(q, d[3] - x[13] * dt, d[4] - x[14] * dt, d[5] - x[15] * dt)
    R = np.empty((3, 3))
    for j in range(3):
        e0 = 1.0 if j == 0 else 0.0
        e1 = 1.0 if j == 1 else 0.0
        e2 = 1.0 if j == 2 else 0.0
        R[0, j], R[1, j], R[2, j] = _rotate(q, e0, e1, e2)
    _propagate_rows(P, R, f0, f1, f2, dt)
    _propagate_rows(P.T, R, f0, f1, f2, dt)
    for i in range(3):
        P[i, i] += (noise[0] * dt) ** 2
        P[3 + i, 3 + i] += (noise[1] * dt) ** 2
        P[9 + i, 9 + i] += (noise[2] * dt) ** 2
        P[12 + i, 12 + i] += (noise[3] * dt) ** 2
    for i in range(3):
        g = GRAVITY * dt if i == 2 else 0.0
        f = f0 if i == 0 else (f1 if i == 1 else f2)
        x[7 + i] += (x[4 + i] + 0.5 * (f + g)) * dt
        x[4 + i] += f + g
    _turn_body(q, d[0] - x[10] * dt, d[1] - x[11] * dt, d[2] - x[12] * dt)


@njit(cache=True)
def _inject(x: Array, P: Array, gain: Array, innovation: float) -> None:
    turn_ned(x[0:4], gain[0] * innovation, gain[1] * innovation, gain[2] * innovation)
    for i in range(3, 15):
        x[i + 1] += gain[i] * innovation
    for i in range(3):  # EKF2_GYR_B_LIM 0.15 rad/s, EKF2_ABL_LIM 0.4 m/s2
        x[10 + i] = min(max(x[10 + i], -0.15), 0.15)
        x[13 + i] = min(max(x[13 + i], -0.4), 0.4)


@njit(cache=True)
def fuse_state(x: Array, P: Array, index: int, innovation: float, variance: float) -> None:
    """Scalar update by a direct measurement of error state `index` (3:9 or 9:12); innovation: measured minus state."""
    s = P[index, index] + variance
    gain = P[:, index] / s
    row = P[index, :].copy()
    for i in range(15):
        for j in range(15):
            P[i, j] -= gain[i] * row[j]
    _inject(x, P, gain, innovation)


@njit(cache=True, error_model="numpy")  # a gate of 0 refuses all, it does not raise
def gate_and_fuse(
    x: Array,
    P: Array,
    first: int,
    measured: tuple[float, ...],
    variances: tuple[float, ...],
    gate: float,
    allowed: bool,
) -> float:
    """Fuse direct measurements of the error states from `first` on or, if one fails its gate or it is not allowed, none.

    Returns: the worst innovation against its gate, squared: fused if allowed and at most 1.
    """
    worst = 0.0
    for i in range(len(measured)):
        innovation = measured[i] - x[first + 1 + i]
        ratio = innovation**2 / (gate**2 * (P[first + i, first + i] + variances[i]))
        if i == 0 or ratio > worst:
            worst = ratio
    if allowed and not worst > 1.0:
        for i in range(len(measured)):
            fuse_state(x, P, first + i, measured[i] - x[first + 1 + i], variances[i])
    return worst


@njit(cache=True)
def yaw_row(x: Array) -> tuple[float, float]:
    """Derivatives of heading by rotation about north and east; by rotation about down it is 1."""
    q = x[0:4]
    sin_pitch = min(max(2 * (q[0] * q[2] - q[3] * q[1]), -0.99), 0.99)
    tan_pitch = sin_pitch / math.sqrt(1 - sin_pitch * sin_pitch)
    yaw = yaw_of(q)
    return math.cos(yaw) * tan_pitch, math.sin(yaw) * tan_pitch


@njit(cache=True)
def yaw_variance(x: Array, P: Array) -> float:
    """Variance of the heading, rad2."""
    h0, h1 = yaw_row(x)
    a = h0 * P[0, 0] + h1 * P[1, 0] + P[2, 0]
    b = h0 * P[0, 1] + h1 * P[1, 1] + P[2, 1]
    c = h0 * P[0, 2] + h1 * P[1, 2] + P[2, 2]
    variance: float = a * h0 + b * h1 + c
    return variance


@njit(cache=True)
def fuse_yaw(x: Array, P: Array, innovation: float, variance: float) -> None:
    """Scalar update by a heading; innovation: measured minus state, wrapped."""
    h0, h1 = yaw_row(x)
    ph = h0 * P[:, 0] + h1 * P[:, 1] + P[:, 2]
    s = h0 * ph[0] + h1 * ph[1] + ph[2] + variance
    gain = ph / s
    for i in range(15):
        for j in range(15):
            P[i, j] -= gain[i] * ph[j]
    _inject(x, P, gain, innovation)


@njit(cache=True)
def reset_block(P: Array, first: int, count: int, variance: float) -> None:
    """Make `count` states from `first` independent of the rest with this variance."""
    for i in range(first, first + count):
        for j in range(15):
            P[i, j] = 0.0
            P[j, i] = 0.0
    for i in range(first, first + count):
        P[i, i] = variance


@njit(cache=True)
def _correct_output(
    x: Array, o: Array, delayed: Array, ring_out: Array, dt: float, tau_vel: float, tau_pos: float
) -> None:
    """Pull the newest state to the delayed one by its error at the horizon (PX4's output observer)."""
    qe = x[0:4]
    qo = delayed[0:4]
    # error angle, body frame: inverse(qe) * qo
    w = qe[0] * qo[0] + qe[1] * qo[1] + qe[2] * qo[2] + qe[3] * qo[3]
    e0 = qe[0] * qo[1] - qe[1] * qo[0] - qe[2] * qo[3] + qe[3] * qo[2]
    e1 = qe[0] * qo[2] + qe[1] * qo[3] - qe[2] * qo[0] - qe[3] * qo[1]
    e2 = qe[0] * qo[3] - qe[1] * qo[2] + qe[2] * qo[1] - qe[3] * qo[0]
    k = (-2.0 if w >= 0 else 2.0) * 0.5 * dt / ((RING - 1) * dt) / SAMPLES_PER_UPDATE
    o[22], o[23], o[24] = k * e0, k * e1, k * e2
    gain_vel = dt / tau_vel
    gain_pos = dt / tau_pos
    for i in range(3):
        err_vel = x[4 + i] - delayed[4 + i]
        err_pos = x[7 + i] - delayed[7 + i]
        o[16 + i] += err_vel
        o[19 + i] += err_pos
        dv = err_vel * gain_vel + o[16 + i] * gain_vel * gain_vel * 1.1
        dp = err_pos * gain_pos + o[19 + i] * gain_pos * gain_pos * 1.1
        for r in range(RING):
            ring_out[r, 4 + i] += dv
            ring_out[r, 7 + i] += dp
        o[4 + i] += dv
        o[7 + i] += dp


@njit(cache=True)
def imu_step(
    x: Array,
    P: Array,
    o: Array,
    acc: Array,
    ring_imu: Array,
    ring_out: Array,
    head: int,
    accel: Array,
    gyro: Array,
    dt: float,
    tuning: Array,
) -> bool:
    """Carry the newest state over one IMU sample; every second one also moves the horizon by 8 ms: then True.

    head: slot of the rings that this sample's sum goes to. tuning: gyro, accelerometer, gyro bias and accelerometer
    bias noise, then time constants of the output's velocity and position.
    """
    a0 = (gyro[0] - x[10]) * dt
    a1 = (gyro[1] - x[11]) * dt
    a2 = (gyro[2] - x[12]) * dt
    for i in range(3):
        o[10 + i] = gyro[i] - x[10 + i]
    _turn_body(o[0:4], a0 + o[22], a1 + o[23], a2 + o[24])
    n, e, d = _rotate(o[0:4], accel[0] - x[13], accel[1] - x[14], accel[2] - x[15])
    o[13], o[14], o[15] = n, e, d + GRAVITY
    for i in range(3):
        o[7 + i] += (o[4 + i] + 0.5 * o[13 + i] * dt) * dt
        o[4 + i] += o[13 + i] * dt
        acc[i] += gyro[i] * dt
        acc[3 + i] += accel[i] * dt
    acc[6] += dt
    acc[7] += 1.0
    if acc[7] < SAMPLES_PER_UPDATE:
        return False
    for i in range(7):
        ring_imu[head, i] = acc[i]
    for i in range(10):
        ring_out[head, i] = o[i]
    for i in range(8):
        acc[i] = 0.0
    oldest = (head + 1) % RING
    update_dt = ring_imu[oldest, 6]
    _predict(x, P, ring_imu[oldest], tuning)
    if update_dt > 0.0:
        _correct_output(x, o, ring_out[oldest], ring_out, update_dt, tuning[4], tuning[5])
    return True


@njit(cache=True)
def shift_output(o: Array, ring_out: Array, delta: Array) -> None:
    """After a reset of the delayed state by delta (v 0:3, p 3:6): the same jump for the newest state and its history."""
    for i in range(6):
        o[4 + i] += delta[i]
        for r in range(RING):
            ring_out[r, 4 + i] += delta[i]
    for i in range(6):
        o[16 + i] = 0.0


@njit(cache=True)
def turn_output(o: Array, ring_out: Array, angle: float) -> None:
    """After a reset of the delayed heading by angle: the same turn for the newest attitude and its history."""
    turn_ned(o[0:4], 0.0, 0.0, angle)
    for r in range(RING):
        turn_ned(ring_out[r, 0:4], 0.0, 0.0, angle)
