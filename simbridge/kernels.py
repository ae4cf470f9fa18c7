"""The arithmetic of each step, compiled. Plain loops over small arrays; `warm_up` compiles all before time matters."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


def _rotation(q: Array, out: Array) -> None:
    """(3, 3) matrix of a unit quaternion (w, x, y, z)."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    out[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    out[0, 1] = 2.0 * (x * y - w * z)
    out[0, 2] = 2.0 * (x * z + w * y)
    out[1, 0] = 2.0 * (x * y + w * z)
    out[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    out[1, 2] = 2.0 * (y * z - w * x)
    out[2, 0] = 2.0 * (x * z - w * y)
    out[2, 1] = 2.0 * (y * z + w * x)
    out[2, 2] = 1.0 - 2.0 * (x * x + y * y)


def _rotors(
    commands: Array,
    states: Array,
    sites: Array,
    pose: Array,
    motion: Array,
    wind: Array,
    params: Array,
    wrench: Array,
) -> float:
    """Rotor lag, thrust law, reaction torque and drag: writes force and torque (6,) in `world`; total thrust, N.

    commands, states: (4,) 0..1; states are updated; a command that is no number counts as 0.
    sites: (4, 3) x, y (FLU) and torque per thrust about body z. pose (7,), motion (6,): of MuJoCo's free joint.
    params: share of the step that the lag lets through, Tmax, curve c, drag. T = Tmax ((1 - c) u + c u^2).
    """
    through, max_thrust, curve, drag = params[0], params[1], params[2], params[3]
    total = 0.0
    tx = 0.0
    ty = 0.0
    tz = 0.0
    for i in range(4):
        command = min(commands[i], 1.0) if commands[i] > 0.0 else 0.0  # not a number: 0
        states[i] += through * (command - states[i])
        u = states[i]
        thrust = max_thrust * ((1.0 - curve) * u + curve * u * u)
        total += thrust
        tx += sites[i, 1] * thrust
        ty -= sites[i, 0] * thrust
        tz += sites[i, 2] * thrust
    r = np.empty((3, 3))
    rotation(pose[3:7], r)
    for k in range(3):
        wrench[k] = r[k, 2] * total - drag * (motion[k] - wind[k])
        wrench[3 + k] = r[k, 0] * tx + r[k, 1] * ty + r[k, 2] * tz
    return total


def _inertial(before: Array, pose: Array, v1: Array, step_s: float, gravity: float, out: Array) -> None:
    """Means over a step, FRD, from the states at both ends: specific force into out[0:3], turn rate into out[3:6].

    before: (13,) pose and motion at the beginning; pose (7,), v1 (6,) at the end. Motion is that of MuJoCo's free joint:
    velocity in `world`, turn rate in body (FLU).
    """
    q0, v0, q1 = before[3:7], before[7:13], pose[3:7]
    q = q0 + q1 if q0[0] * q1[0] + q0[1] * q1[1] + q0[2] * q1[2] + q0[3] * q1[3] >= 0.0 else q0 - q1
    q = q / math.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    r = np.empty((3, 3))
    rotation(q, r)
    ax = (v1[0] - v0[0]) / step_s
    ay = (v1[1] - v0[1]) / step_s
    az = (v1[2] - v0[2]) / step_s + gravity
    for k in range(3):
        sign = 1.0 if k == 0 else -1.0
        out[k] = sign * (r[0, k] * ax + r[1, k] * ay + r[2, k] * az)
        out[3 + k] = sign * 0.5 * (v0[3 + k] + v1[3 + k])


def _aim(
    directions: Array,
    first: int,
    count: int,
    t_first_s: float,
    period_s: float,
    before: Array,
    pose: Array,
    motion: Array,
    lever: Array,
    rays: Array,
    shifts: Array,
    origin: Array,
) -> None:
    """World directions of some columns, each at its own time, and how far its origin is from the common one.

    directions: (columns, rows, 3) in body, those from `first` on are cast. t_first_s: of the first column, from the
    middle of the step. before, pose: (7,) position and quaternion at both ends of the step, motion: (6,) at its end,
    velocity in `world`, turn rate in body. lever: the beams' origin in body. rays: (columns * rows * 3,).
    shifts: (columns, 3). origin: (3,) of the beams in the middle of the step.
    """
    quat = np.empty(4)
    for k in range(4):  # neighbours in time: never near opposite signs
        quat[k] = before[3 + k] + pose[3 + k]
    quat /= math.sqrt(quat[0] ** 2 + quat[1] ** 2 + quat[2] ** 2 + quat[3] ** 2)
    r = np.empty((3, 3))
    rotation(quat, r)
    rx, ry, rz = motion[3], motion[4], motion[5]
    lx = ry * lever[2] - rz * lever[1]
    ly = rz * lever[0] - rx * lever[2]
    lz = rx * lever[1] - ry * lever[0]
    for k in range(3):
        origin[k] = 0.5 * (before[k] + pose[k]) + r[k, 0] * lever[0] + r[k, 1] * lever[1] + r[k, 2] * lever[2]
    n = 0
    for c in range(count):
        t = t_first_s + c * period_s
        for k in range(3):
            shifts[c, k] = t * (motion[k] + r[k, 0] * lx + r[k, 1] * ly + r[k, 2] * lz)
        for i in range(directions.shape[1]):
            x, y, z = directions[first + c, i, 0], directions[first + c, i, 1], directions[first + c, i, 2]
            bx = x + t * (ry * z - rz * y)
            by = y + t * (rz * x - rx * z)
            bz = z + t * (rx * y - ry * x)
            scale = 1.0 / math.sqrt(bx * bx + by * by + bz * bz)
            for k in range(3):
                rays[n] = scale * (r[k, 0] * bx + r[k, 1] * by + r[k, 2] * bz)
                n += 1


def _returns(
    distance: Array,
    normals: Array,
    rays: Array,
    shifts: Array,
    offset: int,
    count: int,
    noise: Array,
    chance: Array,
    params: Array,
    row_index: NDArray[np.int64],
    first: int,
    t_turn_ns: int,
    per_s: int,
    stamps: NDArray[np.uint64],
    range_mm: NDArray[np.uint32],
    signal: NDArray[np.uint16],
) -> None:
    """What the sensor makes of the rays of some columns: writes into the packets of a turn, stamps (packets, 16) in ns,
    range_mm and signal (packets, 16, rows).

    Of the rays (distance, normals, rays, shifts: columns one after the other) those of `count` columns from `offset` on;
    they are the columns from `first` on of the turn, which began at t_turn_ns with per_s columns a second. distance:
    from the common origin, negative where nothing was hit. noise: (columns, rows) standard normal. chance: (columns,
    rows, 3) uniform, for dust, its place, and loss. Both are a whole turn's. params: see `lidar.py`.
    """
    sigma, low, high = params[0], params[1], params[2]
    grazing_cos, dropout, dust_per_m, lost, bias = params[3], params[4], params[5], params[6], params[7]
    rows = row_index.shape[0]
    width = range_mm.shape[1]
    for c in range(count):
        at = offset + c
        column = first + c
        packet, into = column // width, column % width
        stamps[packet, into] = t_turn_ns + column * 1_000_000_000 // per_s
        for i in range(rows):
            n = at * rows + i
            m = 3 * n
            row = row_index[i]
            range_mm[packet, into, row] = 0
            signal[packet, into, row] = 0
            r = distance[n]
            if r < 0.0:
                continue
            facing = rays[m] * normals[m] + rays[m + 1] * normals[m + 1] + rays[m + 2] * normals[m + 2]
            cosine = abs(facing)
            if cosine > 0.02:  # seen from its own origin: exact for a plane
                r -= (
                    shifts[at, 0] * normals[m] + shifts[at, 1] * normals[m + 1] + shifts[at, 2] * normals[m + 2]
                ) / facing
            strength = 4000.0 * cosine
            loss = dropout
            if cosine < grazing_cos:
                loss = max(loss, 1.0 - (cosine / grazing_cos) ** 2)
            if dust_per_m > 0.0:
                clear = math.exp(-dust_per_m * r)
                strength *= clear * clear
                if chance[column, i, 0] > clear:  # caught on the way: at a place as Beer and Lambert have it
                    if (chance[column, i, 0] - clear) / (1.0 - clear) < lost:
                        continue
                    r = -math.log(1.0 - chance[column, i, 1] * (1.0 - clear)) / dust_per_m
                    strength = 200.0
            if chance[column, i, 2] < loss:
                continue
            r += sigma * noise[column, i] + bias
            if r < low or r > high:
                continue
            range_mm[packet, into, row] = np.uint32(r * 1000.0 + 0.5)
            signal[packet, into, row] = np.uint16(min(strength / max(0.04 * r * r, 0.25), 65535.0))


def _triangle(z: Array, x0: float, y0: float, cell_m: float, x: float, y: float) -> tuple[float, float, float]:
    """Height and rise per metre along x and y of the surface's triangle at a place; see `surface.py`."""
    fx, fy = (x - x0) / cell_m, (y - y0) / cell_m
    ix, iy = min(max(int(fx), 0), z.shape[1] - 2), min(max(int(fy), 0), z.shape[0] - 2)
    u, v = min(max(fx - ix, 0.0), 1.0), min(max(fy - iy, 0.0), 1.0)
    a, b = z[iy, ix], z[iy + 1, ix + 1]
    if u >= v:
        along, across = z[iy, ix + 1] - a, b - z[iy, ix + 1]
    else:
        along, across = b - z[iy + 1, ix], z[iy + 1, ix] - a
    return a + u * along + v * across, along / cell_m, across / cell_m


rotation = njit(cache=True)(_rotation)
rotors = njit(cache=True)(_rotors)
inertial = njit(cache=True)(_inertial)
aim = njit(cache=True)(_aim)
returns = njit(cache=True)(_returns)
triangle = njit(cache=True)(_triangle)


def warm_up() -> None:
    """Compile (or load from the cache) every kernel for the types that the loop gives."""
    v, z3 = np.zeros(6), np.zeros(3)
    rotors(np.zeros(4), np.zeros(4), np.zeros((4, 3)), np.ones(7), v, z3, np.zeros(4), np.zeros(6))
    inertial(np.ones(13), np.ones(7), v, 0.004, 9.81, np.zeros(6))
    aim(np.ones((1, 1, 3)), 0, 1, 0.0, 0.0, np.ones(7), np.ones(7), v, z3, np.zeros(3), np.zeros((1, 3)), np.zeros(3))
    triangle(np.zeros((2, 2)), 0.0, 0.0, 1.0, 0.0, 0.0)
    # strided, as in a packet
    column = np.zeros((2, 16), dtype=[("stamp", "<u8"), ("pixel", [("range", "<u4"), ("signal", "<u2")], (2,))])
    pixel = column["pixel"]
    returns(
        np.ones(1), np.ones(3), np.ones(3), np.zeros((1, 3)), 0, 1, np.zeros((1, 1)), np.zeros((1, 1, 3)), np.zeros(8),
        np.zeros(1, dtype=np.int64), 0, 0, 1, column["stamp"], pixel["range"], pixel["signal"],
    )  # fmt: skip
