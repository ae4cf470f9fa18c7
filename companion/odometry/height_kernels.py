"""Inner loops of the height estimate: planes in a grid of moments, and the fit of z and tilt to them and to walls."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from companion.messages import Array
from companion.odometry import kernels
from companion.odometry.jit import kernel

WINDOW = 1
W, X, Y, Z, XX, XY, YY, XZ, YZ, ZZ, VZ = range(11)
SUMS = 11
# a plane: z at (cx, cy), slopes, centre (2), variance about it, slope covariance xx xy yy, weight, pose variance
A, BX, BY, CX, CY, ABOUT, SXX, SXY, SYY, WEIGHT, PZ = range(11)
PLANE = 11
DIRTY, VALID, NO_PLANE = 0, 1, 2
MIN_WEIGHT = 4.0
SLOPE_SIGMA = 0.5  # of slopes where nothing is known of them; material lies at up to 0.8
LEAN_M2 = 0.012  # spread along the beam that is noise and must not pass for slope
SURFACE_SIGMA_M = 0.03
TILT_FAR_RAD = 0.0015  # attitude error that a far point's height is thought to carry into the map
CORRELATED = 8.0
TUKEY = 4.685
UNKNOWN, GROUND, WALL = 0, 1, 2
WALL_FOOT_M = 0.7  # a wall point must be this far above the ground to count as one
WALL_GATE_M = 0.5
BESIDE_M = 1.2  # where the ground at a wall's foot is not known, it is looked for this far before the wall


@kernel
def insert_heights(
    sums: Array,
    state: NDArray[np.uint8],
    origin: Array,
    cell_m: float,
    points_map: Array,
    distance_m: Array,
    variance_z: float,
) -> None:
    """Add ground points (N, 3); far ones count less, since tilt errors grow with distance."""
    ny, nx = state.shape
    for i in range(points_map.shape[0]):
        x, y, z = points_map[i, 0], points_map[i, 1], points_map[i, 2]
        ix, iy = math.floor((x - origin[0]) / cell_m), math.floor((y - origin[1]) / cell_m)
        if ix < 0 or iy < 0 or ix >= nx or iy >= ny:
            continue
        w = 1.0 / (1.0 + (distance_m[i] * TILT_FAR_RAD / 0.06) ** 2)
        s = sums[iy, ix]
        s[W] += w
        s[X] += w * x
        s[Y] += w * y
        s[Z] += w * z
        s[XX] += w * x * x
        s[XY] += w * x * y
        s[YY] += w * y * y
        s[XZ] += w * x * z
        s[YZ] += w * y * z
        s[ZZ] += w * z * z
        s[VZ] += w * variance_z
        for jy in range(max(0, iy - WINDOW), min(ny, iy + WINDOW + 1)):
            for jx in range(max(0, ix - WINDOW), min(nx, ix + WINDOW + 1)):
                state[jy, jx] = DIRTY


@kernel
def fit_plane(sums: Array, state: NDArray[np.uint8], planes: Array, iy: int, ix: int) -> None:
    """Fit the window about a cell anew: a plane whose slopes are held near 0 where the points do not tell them."""
    ny, nx = state.shape
    t = np.zeros(SUMS)
    for jy in range(max(0, iy - WINDOW), min(ny, iy + WINDOW + 1)):
        for jx in range(max(0, ix - WINDOW), min(nx, ix + WINDOW + 1)):
            if sums[jy, jx, W] > 0.0:
                for k in range(SUMS):
                    t[k] += sums[jy, jx, k]
    state[iy, ix] = NO_PLANE
    w = t[W]
    if w < MIN_WEIGHT:
        return
    mx, my, mz = t[X] / w, t[Y] / w, t[Z] / w
    sxx, syy = max(t[XX] / w - mx * mx, 0.0), max(t[YY] / w - my * my, 0.0)
    sxy = t[XY] / w - mx * my
    sxz, syz, szz = t[XZ] / w - mx * mz, t[YZ] / w - my * mz, max(t[ZZ] / w - mz * mz, 0.0)
    noise = 0.1**2
    ridge = noise / (w * SLOPE_SIGMA**2) + LEAN_M2
    det = (sxx + ridge) * (syy + ridge) - sxy * sxy
    bx = ((syy + ridge) * sxz - sxy * syz) / det
    by = ((sxx + ridge) * syz - sxy * sxz) / det
    about = szz - 2 * (bx * sxz + by * syz) + bx * bx * sxx + 2 * bx * by * sxy + by * by * syy
    p = planes[iy, ix]
    p[A], p[BX], p[BY], p[CX], p[CY] = mz, bx, by, mx, my
    p[ABOUT] = max(about, 1e-4)
    p[SXX], p[SXY], p[SYY] = noise / w * (syy + ridge) / det, -noise / w * sxy / det, noise / w * (sxx + ridge) / det
    p[WEIGHT], p[PZ] = w, t[VZ] / w
    state[iy, ix] = VALID


@kernel
def _height_above(
    sums: Array, state: NDArray[np.uint8], planes: Array, origin: Array, cell_m: float, x: float, y: float, z: float
) -> float:
    """Of a point above the ground known there; NaN where none is known."""
    ny, nx = state.shape
    ix, iy = math.floor((x - origin[0]) / cell_m), math.floor((y - origin[1]) / cell_m)
    if ix < 0 or iy < 0 or ix >= nx or iy >= ny:
        return math.nan
    if state[iy, ix] == DIRTY:
        fit_plane(sums, state, planes, iy, ix)
    if state[iy, ix] != VALID:
        return math.nan
    p = planes[iy, ix]
    return z - (p[A] + p[BX] * (x - p[CX]) + p[BY] * (y - p[CY]))


@kernel
def classify(
    sums: Array,
    state: NDArray[np.uint8],
    planes: Array,
    origin: Array,
    cell_m: float,
    wall_sums: Array,
    wall_spread: Array,
    wall_state: NDArray[np.uint8],
    wall_lines: Array,
    wall_origin: Array,
    wall_cell_m: float,
    points: Array,
    pose: Array,
    z_m: float,
    gate_m: float,
    min_spread_m: float,
    kind: NDArray[np.int64],
    place: NDArray[np.int64],
) -> None:
    """Tell ground from wall for (N, 3) levelled points. kind: out; place: out, cell of the plane or line, -1 none.

    A point is a wall's when it lies on the line of a wall seen at many heights and well above the ground there; it is
    the ground's when no wall is near. What is neither is left out.
    """
    nx = state.shape[1]
    wy, wx = wall_state.shape
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for i in range(points.shape[0]):
        kind[i], place[i] = UNKNOWN, -1
        x = c * points[i, 0] - s * points[i, 1] + pose[0]
        y = s * points[i, 0] + c * points[i, 1] + pose[1]
        z = points[i, 2] + z_m
        height = _height_above(sums, state, planes, origin, cell_m, x, y, z)
        known = math.isfinite(height)
        jx = math.floor((x - wall_origin[0]) / wall_cell_m)
        jy = math.floor((y - wall_origin[1]) / wall_cell_m)
        near_wall = False
        if 0 <= jx < wx and 0 <= jy < wy:
            if wall_state[jy, jx] == DIRTY:
                kernels.fit_line(wall_sums, wall_spread, wall_state, wall_lines, jy, jx)
            if wall_state[jy, jx] == VALID:
                line = wall_lines[jy, jx]
                near_wall = line[kernels.SPREAD] >= min_spread_m
                across = line[kernels.NX] * (x - line[kernels.CX]) + line[kernels.NY] * (y - line[kernels.CY])
                tall = line[kernels.SPREAD] >= max(min_spread_m, 1.0)
                if tall and abs(across) < WALL_GATE_M:
                    toward = line[kernels.NX] * (pose[0] - x) + line[kernels.NY] * (pose[1] - y)
                    step = math.copysign(BESIDE_M, toward)
                    u, v = x + step * line[kernels.NX], y + step * line[kernels.NY]
                    beside = _height_above(sums, state, planes, origin, cell_m, u, v, z)
                    if height > WALL_FOOT_M or (not known and beside > WALL_FOOT_M + BESIDE_M):
                        kind[i], place[i] = WALL, jy * wx + jx
            elif wall_sums[jy, jx, kernels.W] > 0.0:
                near_wall = wall_spread[jy, jx, 1] - wall_spread[jy, jx, 0] >= min_spread_m
        if near_wall:
            continue
        if not known:
            kind[i] = GROUND
        elif abs(height) < gate_m:
            ix, iy = math.floor((x - origin[0]) / cell_m), math.floor((y - origin[1]) / cell_m)
            kind[i], place[i] = GROUND, iy * nx + ix


@kernel
def _solve_robustly(jac: Array, res: Array, var: Array, prior: Array, iterations: int) -> tuple[Array, Array, float]:
    """Tukey-weighted least squares of res + jac x with x about 0; returns x, the points' information and the scale."""
    n = len(res)
    x = np.zeros(3)
    h = np.zeros((3, 3))
    u = np.empty(n)
    scale = 1.0
    for _ in range(iterations):
        for i in range(n):
            u[i] = (res[i] + jac[i, 0] * x[0] + jac[i, 1] * x[1] + jac[i, 2] * x[2]) / math.sqrt(var[i])
        scale = min(max(1.4826 * np.median(np.abs(u)), 0.7), 4.0)
        h[:] = 0.0
        g = prior @ x
        for i in range(n):
            v = u[i] / (TUKEY * scale)
            if abs(v) >= 1.0:
                continue
            w = (1.0 - v * v) ** 2 / (var[i] * scale * scale)
            r = u[i] * math.sqrt(var[i])
            for k in range(3):
                g[k] += w * jac[i, k] * r
                for m in range(3):
                    h[k, m] += w * jac[i, k] * jac[i, m]
        x = x - kernels.solve3(h + prior, g)
    return x, h, scale


@kernel
def fit_height(
    planes: Array,
    wall_lines: Array,
    points: Array,
    pose: Array,
    z_m: float,
    kind: NDArray[np.int64],
    place: NDArray[np.int64],
    sigma_range_m: float,
    tilt_prior: Array,
    bend_variance: float,
    iterations: int,
) -> tuple[Array, Array, Array]:
    """Tilt from the points on walls, then z from those on the ground.

    Walls are plumb, the ground's map is only as level as it was built: so the ground does not tell tilt, and z is fitted
    with a slope of its own of that variance beside it.

    tilt_prior: (2, 2) information about roll, pitch. Returns: (3,) correction of z, roll, pitch; (3, 3) information: of
    z alone, and of the tilt by the walls; (4,) ground points, wall points, scale, mean pose variance of the planes used.
    """
    flat_planes, flat_lines = planes.reshape(-1, PLANE), wall_lines.reshape(-1, kernels.LINE)
    ground, walls = np.sum((kind == GROUND) & (place >= 0)), np.sum(kind == WALL)
    jac_g, res_g, var_g = np.zeros((ground, 3)), np.zeros(ground), np.zeros(ground)
    jac_w, res_w, var_w = np.zeros((walls, 3)), np.zeros(walls), np.zeros(walls)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    a, b, pose_variance = 0, 0, 0.0
    for i in range(points.shape[0]):
        if place[i] < 0:
            continue
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        x, y = c * px - s * py + pose[0], s * px + c * py + pose[1]
        far = max(math.sqrt(px * px + py * py + pz * pz), 1e-6)
        if kind[i] == GROUND:
            p = flat_planes[place[i]]
            dx, dy = x - p[CX], y - p[CY]
            bx, by = c * p[BX] + s * p[BY], -s * p[BX] + c * p[BY]  # slopes in the levelled frame
            res_g[a] = z_m + pz - (p[A] + p[BX] * dx + p[BY] * dy)
            jac_g[a, 0], jac_g[a, 1], jac_g[a, 2] = 1.0, py + by * pz, -px - bx * pz
            along = (pz - bx * px - by * py) / far
            plane = p[ABOUT] / p[WEIGHT] + dx * dx * p[SXX] + 2 * dx * dy * p[SXY] + dy * dy * p[SYY]
            var_g[a] = (sigma_range_m * along) ** 2 + SURFACE_SIGMA_M**2 + CORRELATED * plane
            pose_variance += p[PZ]
            a += 1
        else:
            q = flat_lines[place[i]]
            ax, ay = c * q[kernels.NX] + s * q[kernels.NY], -s * q[kernels.NX] + c * q[kernels.NY]
            res_w[b] = q[kernels.NX] * (x - q[kernels.CX]) + q[kernels.NY] * (y - q[kernels.CY])
            jac_w[b, 1], jac_w[b, 2] = -ay * pz, ax * pz
            along = (ax * px + ay * py) / far
            line = q[kernels.ACROSS] / q[kernels.WEIGHT]
            var_w[b] = (sigma_range_m * along) ** 2 + SURFACE_SIGMA_M**2 + CORRELATED * line
            b += 1
    out = np.zeros(4)
    out[0], out[1] = ground, walls
    prior = np.eye(3)
    prior[1:, 1:] = tilt_prior
    tilt, information, _ = _solve_robustly(jac_w, res_w, var_w, prior, iterations if walls > 0 else 0)
    for i in range(ground):
        res_g[i] += jac_g[i, 1] * tilt[1] + jac_g[i, 2] * tilt[2]
    left = information + prior
    det = left[1, 1] * left[2, 2] - left[1, 2] * left[2, 1]
    prior = np.zeros((3, 3))
    prior[0, 0] = 1e-3
    prior[1, 1] = 1.0 / (left[2, 2] / det + bend_variance)
    prior[2, 2] = 1.0 / (left[1, 1] / det + bend_variance)
    height, h, out[2] = _solve_robustly(jac_g, res_g, var_g, prior, iterations if ground > 5 else 0)
    if ground > 5:
        out[3] = pose_variance / ground
        a00, a01, a11 = h[1, 1] + prior[1, 1], h[1, 2], h[2, 2] + prior[2, 2]
        det = a00 * a11 - a01 * a01
        lost = (h[0, 1] * (a11 * h[0, 1] - a01 * h[0, 2]) + h[0, 2] * (a00 * h[0, 2] - a01 * h[0, 1])) / det
        information[0, 0] = max(h[0, 0] - lost, 0.0)
    tilt[0] = height[0]
    return tilt, information, out
