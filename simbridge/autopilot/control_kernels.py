"""Compiled control cascade: position, velocity, attitude, rate, mixer. PX4's structure and gains (MPC_*, MC_*).

Layouts
    setpoint sp (11,)   position 0:3, velocity 3:6, acceleration 6:9 (NED, NaN where not wanted), yaw 9, yaw rate 10
    memory c (MEMORY,)  what the cascade remembers between steps, see the indices below
    gains g (GAINS,)    parameters by the indices below
"""

# mypy: allow-untyped-decorators

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from simbridge.autopilot.kernels import GRAVITY

Array = NDArray[np.float64]

# memory
VEL_INT, VEL_LAST, VEL_DOT, THRUST, Q_SP, RATE_INT, RATE_LAST, RATE_DOT = 0, 3, 6, 9, 12, 16, 19, 22
YAW_TORQUE, HOVER, FLYING, VEL_UP, VEL_DOWN, RATE_SP, COLLECTIVE, VEL_SP, YAW_RATE_SP, STARTED = (
    25,
    26,
    27,
    28,
    29,
    30,
    33,
    34,
    37,
    38,
)
ACC_SP, TILT_LIMIT, MEMORY = 39, 42, 43
# gains
XY_P, Z_P, XY_V_P, XY_V_I, XY_V_D, Z_V_P, Z_V_I, Z_V_D, XY_V_MAX, THR_MIN, THR_MAX, THR_XY_MARGIN = range(12)
ROLL_P, PITCH_P, YAW_P, YAW_WEIGHT, RATE_MAX, YAW_RATE_MAX, RR_P, RR_I, RR_D, PR_P, PR_I, PR_D, YR_P, YR_I = range(
    12, 26
)
RATE_INT_LIM, YAW_TORQUE_HZ, THR_MDL_FAC, VELD_LP_HZ, GAINS = 26, 27, 28, 29, 30
RATE_D_LP_HZ = 30.0  # IMU_DGYRO_CUTOFF


@njit(cache=True)
def _clip(v: float, low: float, high: float) -> float:
    return min(max(v, low), high)


@njit(cache=True)
def _alpha(dt: float, cutoff_hz: float) -> float:
    """Share of the new value in a first order low pass."""
    if cutoff_hz <= 0.0:
        return 1.0
    rc = 1.0 / (2.0 * math.pi * cutoff_hz)
    return dt / (dt + rc)


@njit(cache=True)
def velocity_control(o: Array, sp: Array, c: Array, g: Array, dt: float) -> None:
    """Position and velocity loops: setpoint to thrust vector (NED, 1 is full collective) and attitude setpoint."""
    a = _alpha(dt, g[VELD_LP_HZ])
    for i in range(3):
        if c[STARTED] > 0.0:
            c[VEL_DOT + i] += a * ((o[4 + i] - c[VEL_LAST + i]) / dt - c[VEL_DOT + i])
        c[VEL_LAST + i] = o[4 + i]
    c[STARTED] = 1.0
    for i in range(3):
        p = g[XY_P] if i < 2 else g[Z_P]
        v = sp[3 + i]
        if not math.isnan(sp[i]):
            v = p * (sp[i] - o[7 + i]) + (0.0 if math.isnan(v) else v)
        c[VEL_SP + i] = v
    speed = math.hypot(c[VEL_SP], c[VEL_SP + 1])
    if speed > g[XY_V_MAX]:
        c[VEL_SP] *= g[XY_V_MAX] / speed
        c[VEL_SP + 1] *= g[XY_V_MAX] / speed
    if not math.isnan(c[VEL_SP + 2]):
        c[VEL_SP + 2] = max(min(c[VEL_SP + 2], c[VEL_DOWN]), -c[VEL_UP])  # the take-off ramp's limit goes first
    error = np.zeros(3)
    for i in range(3):
        ff = 0.0 if math.isnan(sp[6 + i]) else sp[6 + i]
        if math.isnan(c[VEL_SP + i]):
            c[VEL_INT + i] = 0.0
            c[ACC_SP + i] = ff
            continue
        error[i] = c[VEL_SP + i] - o[4 + i]
        kp, kd = (g[XY_V_P], g[XY_V_D]) if i < 2 else (g[Z_V_P], g[Z_V_D])
        c[ACC_SP + i] = ff + kp * error[i] + c[VEL_INT + i] - kd * c[VEL_DOT + i]
    _thrust(sp, c, g)
    _integrate_velocity(error, c, g, dt)


@njit(cache=True)
def _thrust(sp: Array, c: Array, g: Array) -> None:
    """Acceleration setpoint to thrust vector: vertical first, then what is left for the horizontal."""
    hover = c[HOVER]
    ax, ay, az = c[ACC_SP], c[ACC_SP + 1], c[ACC_SP + 2]
    tilt_max = c[TILT_LIMIT]
    horizontal = math.hypot(ax, ay)
    if horizontal > GRAVITY * math.tan(tilt_max):
        scale = GRAVITY * math.tan(tilt_max) / horizontal
        ax, ay = ax * scale, ay * scale
    n = math.sqrt(ax * ax + ay * ay + GRAVITY * GRAVITY)
    bx, by, bz = ax / n, ay / n, -GRAVITY / n  # direction of thrust, NED
    collective = -(az * (hover / GRAVITY) - hover)
    collective = _clip(collective / -bz, g[THR_MIN], g[THR_MAX])
    tz = bz * collective
    tx, ty = bx * collective, by * collective
    reserve = math.sqrt(max(g[THR_MAX] ** 2 - tz * tz, 0.0))
    txy = math.hypot(tx, ty)
    if txy > reserve and txy > 0.0:
        tx, ty = tx * reserve / txy, ty * reserve / txy
    c[THRUST], c[THRUST + 1], c[THRUST + 2] = tx, ty, tz


@njit(cache=True)
def _integrate_velocity(error: Array, c: Array, g: Array, dt: float) -> None:
    """Sum the velocity errors, not against a saturated thrust."""
    if c[FLYING] <= 0.0:
        for i in range(3):
            c[VEL_INT + i] = 0.0
        return
    up = -c[THRUST + 2]
    saturated = (up >= g[THR_MAX] - 1e-6 and error[2] < 0.0) or (up <= g[THR_MIN] + 1e-6 and error[2] > 0.0)
    for i in range(2):
        produced = c[THRUST + i] * GRAVITY / max(c[HOVER], 0.1)
        lost = c[ACC_SP + i] - produced if abs(c[ACC_SP + i]) > 2.0 * abs(produced) + 2.0 else 0.0
        c[VEL_INT + i] += (g[XY_V_I] * error[i] - 2.0 / max(g[XY_V_P], 0.1) * lost) * dt
        c[VEL_INT + i] = _clip(c[VEL_INT + i], -5.0, 5.0)
    if not saturated:
        c[VEL_INT + 2] = _clip(c[VEL_INT + 2] + g[Z_V_I] * error[2] * dt, -GRAVITY, GRAVITY)


@njit(cache=True)
def attitude_setpoint(o: Array, sp: Array, c: Array) -> None:
    """Thrust vector and heading to the attitude setpoint; without a heading the present one is kept."""
    tx, ty, tz = c[THRUST], c[THRUST + 1], c[THRUST + 2]
    n = math.sqrt(tx * tx + ty * ty + tz * tz)
    if n < 1e-6:
        zx, zy, zz = 0.0, 0.0, 1.0
        c[COLLECTIVE] = 0.0
    else:
        zx, zy, zz = -tx / n, -ty / n, -tz / n
        c[COLLECTIVE] = n
    yaw = sp[9]
    if math.isnan(yaw):
        yaw = math.atan2(2 * (o[0] * o[3] + o[1] * o[2]), 1 - 2 * (o[2] * o[2] + o[3] * o[3]))
    c[YAW_RATE_SP] = 0.0 if math.isnan(sp[10]) else sp[10]
    # body y is right of the heading and square to thrust, body x completes
    yx, yy = -math.sin(yaw), math.cos(yaw)
    xx, xy, xz = yy * zz, -yx * zz, yx * zy - yy * zx
    n = math.sqrt(xx * xx + xy * xy + xz * xz)
    xx, xy, xz = xx / n, xy / n, xz / n
    rx, ry, rz = zy * xz - zz * xy, zz * xx - zx * xz, zx * xy - zy * xx
    _quaternion(xx, rx, zx, xy, ry, zy, xz, rz, zz, c)


@njit(cache=True)
def _quaternion(
    m00: float, m01: float, m02: float, m10: float, m11: float, m12: float, m20: float, m21: float, m22: float, c: Array
) -> None:
    w = math.sqrt(max(1.0 + m00 + m11 + m22, 0.0)) / 2
    x = math.copysign(math.sqrt(max(1.0 + m00 - m11 - m22, 0.0)) / 2, m21 - m12)
    y = math.copysign(math.sqrt(max(1.0 - m00 + m11 - m22, 0.0)) / 2, m02 - m20)
    z = math.copysign(math.sqrt(max(1.0 - m00 - m11 + m22, 0.0)) / 2, m10 - m01)
    n = math.sqrt(w * w + x * x + y * y + z * z)
    c[Q_SP], c[Q_SP + 1], c[Q_SP + 2], c[Q_SP + 3] = w / n, x / n, y / n, z / n


@njit(cache=True)
def _mul(aw: float, ax: float, ay: float, az: float, b: Array) -> Array:
    r = np.empty(4)
    r[0] = aw * b[0] - ax * b[1] - ay * b[2] - az * b[3]
    r[1] = aw * b[1] + ax * b[0] + ay * b[3] - az * b[2]
    r[2] = aw * b[2] - ax * b[3] + ay * b[0] + az * b[1]
    r[3] = aw * b[3] + ax * b[2] - ay * b[1] + az * b[0]
    return r


@njit(cache=True)
def attitude_control(o: Array, c: Array, g: Array) -> None:
    """Attitude to rate setpoint: the thrust axis at full gain, heading at its weight (Brescianini 2013, as PX4 does)."""
    q = o[0:4]
    qd = c[Q_SP : Q_SP + 4]
    # thrust axes, present and wanted
    ex, ey, ez = 2 * (q[1] * q[3] + q[0] * q[2]), 2 * (q[2] * q[3] - q[0] * q[1]), 1 - 2 * (q[1] * q[1] + q[2] * q[2])
    dx, dy = 2 * (qd[1] * qd[3] + qd[0] * qd[2]), 2 * (qd[2] * qd[3] - qd[0] * qd[1])
    dz = 1 - 2 * (qd[1] * qd[1] + qd[2] * qd[2])
    dot = ex * dx + ey * dy + ez * dz
    if dot > -0.999:
        w = 1.0 + dot
        cx, cy, cz = ey * dz - ez * dy, ez * dx - ex * dz, ex * dy - ey * dx
        n = math.sqrt(w * w + cx * cx + cy * cy + cz * cz)
        reduced = _mul(w / n, cx / n, cy / n, cz / n, q)
    else:
        reduced = qd.copy()
    mix = _mul(reduced[0], -reduced[1], -reduced[2], -reduced[3], qd)
    if mix[0] < 0.0:
        mix = -mix
    weight = g[YAW_WEIGHT]
    turn = weight * math.asin(_clip(mix[3], -1.0, 1.0))
    last = np.zeros(4)
    last[0], last[3] = math.cos(turn), math.sin(turn)
    wanted = _mul(reduced[0], reduced[1], reduced[2], reduced[3], last)
    e = _mul(q[0], -q[1], -q[2], -q[3], wanted)
    s = 2.0 if e[0] >= 0.0 else -2.0
    yaw_p = g[YAW_P] / weight if weight > 0.01 else 0.0
    # a yaw rate is about the vertical: its part along each body axis
    down0, down1, down2 = 2 * (q[1] * q[3] - q[0] * q[2]), 2 * (q[2] * q[3] + q[0] * q[1]), ez
    rate = c[YAW_RATE_SP]
    c[RATE_SP] = _clip(s * e[1] * g[ROLL_P] + down0 * rate, -g[RATE_MAX], g[RATE_MAX])
    c[RATE_SP + 1] = _clip(s * e[2] * g[PITCH_P] + down1 * rate, -g[RATE_MAX], g[RATE_MAX])
    c[RATE_SP + 2] = _clip(s * e[3] * yaw_p + down2 * rate, -g[YAW_RATE_MAX], g[YAW_RATE_MAX])


@njit(cache=True)
def rate_control(o: Array, c: Array, g: Array, u: Array, dt: float) -> None:
    """Rates to torque to the four motors of an X: front right, rear left (turn nose right), front left, rear right."""
    torque = np.empty(3)
    a = _alpha(dt, RATE_D_LP_HZ)
    for i in range(3):
        rate = o[10 + i]
        c[RATE_DOT + i] += a * ((rate - c[RATE_LAST + i]) / dt - c[RATE_DOT + i])
        c[RATE_LAST + i] = rate
        error = c[RATE_SP + i] - rate
        kp = g[RR_P] if i == 0 else (g[PR_P] if i == 1 else g[YR_P])
        ki = g[RR_I] if i == 0 else (g[PR_I] if i == 1 else g[YR_I])
        kd = g[RR_D] if i == 0 else (g[PR_D] if i == 1 else 0.0)
        torque[i] = kp * error + c[RATE_INT + i] - kd * c[RATE_DOT + i]
        if c[FLYING] > 0.0:
            c[RATE_INT + i] = _clip(c[RATE_INT + i] + ki * error * dt, -g[RATE_INT_LIM], g[RATE_INT_LIM])
        else:
            c[RATE_INT + i] = 0.0
    c[YAW_TORQUE] += _alpha(dt, g[YAW_TORQUE_HZ]) * (torque[2] - c[YAW_TORQUE])
    _mix(torque[0], torque[1], c[YAW_TORQUE], c[COLLECTIVE], g, u)


@njit(cache=True)
def _mix(roll: float, pitch: float, yaw: float, thrust: float, g: Array, u: Array) -> None:
    """Torques and collective to motors; less tilt torque rather than negative thrust (MC_AIRMODE 0), heading last."""
    h = 0.70710678  # PX4 scales the allocation of an X so that a unit of roll moves each motor by this
    tilt = np.empty(4)
    tilt[0], tilt[1], tilt[2], tilt[3] = h * (pitch - roll), h * (roll - pitch), h * (pitch + roll), -h * (pitch + roll)
    largest = max(np.max(tilt), 1e-9)
    scale = min(1.0, thrust / largest)  # the four tilt parts are two pairs of opposite sign
    top = thrust + scale * largest
    if top > 1.0:
        thrust -= min(top - 1.0, thrust)
        scale = min(scale, thrust / largest)
    room = min(thrust - scale * largest, 1.0 - thrust - scale * largest)
    yaw = _clip(yaw, -max(room, 0.0), max(room, 0.0))
    f = g[THR_MDL_FAC]
    for i in range(4):
        t = _clip(thrust + scale * tilt[i] + (yaw if i < 2 else -yaw), 0.0, 1.0)
        if f > 0.0:
            t = (f - 1.0 + math.sqrt((1.0 - f) ** 2 + 4.0 * f * t)) / (2.0 * f)
        u[i] = t


@njit(cache=True)
def control_step(o: Array, sp: Array, c: Array, g: Array, u: Array, dt: float, dt_position: float) -> None:
    """One step of the cascade; the position loop runs only where dt_position > 0."""
    if dt_position > 0.0:
        velocity_control(o, sp, c, g, dt_position)
        attitude_setpoint(o, sp, c)
    attitude_control(o, c, g)
    rate_control(o, c, g, u, dt)
