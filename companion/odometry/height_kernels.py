"""Inner loops of the height estimate: planes in a grid of moments, and the fit of z and tilt to them and to walls."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from companion.jit import kernel
from companion.messages import Array
from companion.odometry.jackknife import SECTORS, shared_by_sector
from companion.odometry.solve_kernels import solve_robustly, without

WINDOW = 1
W, X, Y, Z, XX, XY, YY, XZ, YZ, ZZ, VZ = range(11)
SUMS = 11
# a plane: z at (cx, cy), slopes, centre (2), variance about it, slope covariance xx xy yy, weight, pose variance
A, BX, BY, CX, CY, ABOUT, SXX, SXY, SYY, WEIGHT, PZ = range(11)
PLANE = 11
DIRTY, VALID, NO_PLANE = 0, 1, 2
MIN_WEIGHT = 4.0
HEAP_SLOPE = 0.15  # of a plane, from which on it may be a heap's: round
MIN_OWN_WEIGHT = 4.0  # of a cell there whose plane goes through its own points' mean
MIN_OWN_RATIO = 0.06  # of the window's; a ninth where points lie evenly. Few lie where noise along the beams threw them
SLOPE_SIGMA = 0.5  # of slopes where nothing is known of them; material lies at up to 0.8
SLOPE_M = 0.1  # by how much a slope's points are unsure of z, for each metre that it rises in one: where the body is
LEAN_M2 = 0.012  # spread along the beam that is noise and must not pass for slope
SURFACE_SIGMA_M = 0.03
TILT_FAR_RAD = 0.0015  # attitude error that a far point's height is thought to carry into the map
CORRELATED = 8.0
UNKNOWN, GROUND, WALL = 0, 1, 2
WALL_FOOT_M = 0.7  # a wall point must be this far above the ground to count as one
WALL_GATE_M = 0.5
WALL_SPREAD_M = 1.0  # of heights at which a wall must have been seen to count as plumb
MIN_SHIFT_POINTS = 50
LEAST_SLOPE = 0.25  # along the axis: the floor's noise looks like less, and would tell of places that nobody knows
LOOSE_RAD = 0.02  # holds a tilt that hardly any wall tells
BLOCK_RAD = math.radians(2.9)  # neighbours of a layer that are averaged into one point: 4 of 512 columns
LEAST_COS2 = 0.05  # of the angle at which a beam meets a wall
BESIDE_M = 1.2  # where the ground at a wall's foot is not known, it is looked for this far before the wall


@kernel
def insert_heights(
    sums: Array,
    state: NDArray[np.uint8],
    corner: Array,
    cell_m: float,
    sight: Array,
    origin: Array,
    sensor: Array,
    variance_range: float,
    variance_z: float,
) -> None:
    """Add ground points, sight (N, 4: place, returns) from origin (3,); far ones count less, as tilt errors grow with
    distance. sensor: (3,) where the beams come from, from origin too. variance_range: of one return.

    A point errs along its beam, so its place and its height err together, and a plane through such points leans along the
    beams. What the range's variance puts into the moments is known, and is taken out of them again.
    """
    ny, nx = state.shape
    for i in range(sight.shape[0]):
        dx, dy, dz = sight[i, 0], sight[i, 1], sight[i, 2]
        x, y, z = origin[0] + dx, origin[1] + dy, origin[2] + dz
        ix, iy = math.floor((x - corner[0]) / cell_m), math.floor((y - corner[1]) / cell_m)
        if ix < 0 or iy < 0 or ix >= nx or iy >= ny:
            continue
        far2 = dx * dx + dy * dy
        bx, by, bz = dx - sensor[0], dy - sensor[1], dz - sensor[2]
        noise = variance_range / (sight[i, 3] * max(bx * bx + by * by + bz * bz, 1e-6))
        w = 1.0 / (1.0 + far2 * (TILT_FAR_RAD / 0.06) ** 2)
        s = sums[iy, ix]
        s[W] += w
        s[X] += w * x
        s[Y] += w * y
        s[Z] += w * z
        s[XX] += w * (x * x - noise * bx * bx)
        s[XY] += w * (x * y - noise * bx * by)
        s[YY] += w * (y * y - noise * by * by)
        s[XZ] += w * (x * z - noise * bx * bz)
        s[YZ] += w * (y * z - noise * by * bz)
        s[ZZ] += w * z * z
        s[VZ] += w * variance_z
        for jy in range(max(0, iy - WINDOW), min(ny, iy + WINDOW + 1)):
            for jx in range(max(0, ix - WINDOW), min(nx, ix + WINDOW + 1)):
                state[jy, jx] = DIRTY


@kernel
def fit_plane(sums: Array, state: NDArray[np.uint8], planes: Array, iy: int, ix: int) -> None:
    """Fit the window about a cell anew: a plane whose slopes are held near 0 where the points do not tell them.

    On a slope it goes through the mean of the cell's own points where these are enough: heaps are round, and the mean of the
    window lies centimetres under its middle; the body would be held lower wherever a heap is in sight.
    """
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
    most = math.sqrt(sxx * syy)  # noise taken out of few points may leave moments that no points have
    sxy = min(max(t[XY] / w - mx * my, -most), most)
    sxz, syz, szz = t[XZ] / w - mx * mz, t[YZ] / w - my * mz, max(t[ZZ] / w - mz * mz, 0.0)
    noise = 0.1**2
    ridge = noise / (w * SLOPE_SIGMA**2) + LEAN_M2
    det = (sxx + ridge) * (syy + ridge) - sxy * sxy
    bx = ((syy + ridge) * sxz - sxy * syz) / det
    by = ((sxx + ridge) * syz - sxy * sxz) / det
    about = szz - 2 * (bx * sxz + by * syz) + bx * bx * sxx + 2 * bx * by * sxy + by * by * syy
    own, weight = sums[iy, ix], w
    if bx * bx + by * by > HEAP_SLOPE**2 and own[W] >= max(MIN_OWN_WEIGHT, MIN_OWN_RATIO * w):
        weight = own[W]
        mx, my, mz = own[X] / weight, own[Y] / weight, own[Z] / weight
    p = planes[iy, ix]
    p[A], p[BX], p[BY], p[CX], p[CY] = mz, bx, by, mx, my
    p[ABOUT] = max(about, 1e-4)
    p[SXX], p[SXY], p[SYY] = noise / w * (syy + ridge) / det, -noise / w * sxy / det, noise / w * (sxx + ridge) / det
    p[WEIGHT], p[PZ] = weight, t[VZ] / w
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
    return z - float(p[A] + p[BX] * (x - p[CX]) + p[BY] * (y - p[CY]))


@kernel
def classify(
    sums: Array,
    state: NDArray[np.uint8],
    planes: Array,
    origin: Array,
    cell_m: float,
    standing: Array,
    points: Array,
    pose: Array,
    z_m: float,
    gate_m: float,
    min_spread_m: float,
    kind: NDArray[np.int64],
    place: NDArray[np.int64],
) -> None:
    """Tell ground from wall for (N, 3) levelled points. kind: out; place: out, cell of the ground's plane, -1 none.

    A point is a wall's when it lies on the line of a wall seen at many heights and well above the ground there; it is
    the ground's when no wall is near. What is neither is left out. standing: (N, 8), kernels.lines_at.
    """
    nx = state.shape[1]
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for i in range(points.shape[0]):
        kind[i], place[i] = UNKNOWN, -1
        x = c * points[i, 0] - s * points[i, 1] + pose[0]
        y = s * points[i, 0] + c * points[i, 1] + pose[1]
        z = points[i, 2] + z_m
        height = _height_above(sums, state, planes, origin, cell_m, x, y, z)
        known = math.isfinite(height)
        wall = standing[i]
        if wall[0] == 2.0 and wall[1] >= max(min_spread_m, WALL_SPREAD_M):
            across = wall[2] * (x - wall[4]) + wall[3] * (y - wall[5])
            if abs(across) < WALL_GATE_M:
                step = math.copysign(BESIDE_M, wall[2] * (pose[0] - x) + wall[3] * (pose[1] - y))
                u, v = x + step * wall[2], y + step * wall[3]
                beside = _height_above(sums, state, planes, origin, cell_m, u, v, z)
                if height > WALL_FOOT_M or (not known and beside > WALL_FOOT_M + BESIDE_M):
                    kind[i] = WALL
        if wall[0] > 0.0 and wall[1] >= min_spread_m:
            continue
        if not known:
            kind[i] = GROUND
        elif abs(height) < gate_m:
            ix, iy = math.floor((x - origin[0]) / cell_m), math.floor((y - origin[1]) / cell_m)
            kind[i], place[i] = GROUND, iy * nx + ix


@kernel
def _wall_rows(
    standing: Array, points: Array, pose: Array, kind: NDArray[np.int64], sigma_range_m: float, lean: Array
) -> tuple[Array, Array, Array, NDArray[np.int64]]:
    """Residuals of the points on walls by roll, pitch, what the walls lean by (turn about map x, y) and a shift (map x, y) of
    the body; their variance, and in which of SECTORS of the turn they lie."""
    n = np.sum(kind == WALL)
    jac, res, var, sector = np.zeros((n, 6)), np.zeros(n), np.zeros(n), np.zeros(n, np.int64)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    k = 0
    for i in range(points.shape[0]):
        if kind[i] != WALL:
            continue
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        x, y = c * px - s * py + pose[0], s * px + c * py + pose[1]
        wall = standing[i]
        ax, ay = c * wall[2] + s * wall[3], -s * wall[2] + c * wall[3]
        jac[k, 0], jac[k, 1], jac[k, 4], jac[k, 5] = -ay * pz, ax * pz, wall[2], wall[3]
        jac[k, 2], jac[k, 3] = -wall[3] * pz, wall[2] * pz
        far2 = px * px + py * py
        head_on = ax * px + ay * py
        along = head_on / max(math.sqrt(far2 + pz * pz), 1e-6)
        wide2 = (far2 * BLOCK_RAD) ** 2 / max(head_on * head_on, LEAST_COS2 * far2, 1e-6)
        res[k] = wall[2] * (x - wall[4]) + wall[3] * (y - wall[5]) + jac[k, 2] * lean[0] + jac[k, 3] * lean[1]
        res[k] -= wall[7] * wide2 / 24.0  # the mean of a block of a bent wall lies within the bend
        var[k] = (sigma_range_m * along) ** 2 + SURFACE_SIGMA_M**2 + CORRELATED * wall[6]
        sector[k] = math.floor((math.atan2(py, px) / (2.0 * math.pi) + 0.5) * SECTORS) % SECTORS
        k += 1
    return jac, res, var, sector


@kernel
def _ground_rows(
    planes: Array,
    points: Array,
    pose: Array,
    z_m: float,
    tilt: Array,
    kind: NDArray[np.int64],
    place: NDArray[np.int64],
    sigma_range_m: float,
) -> tuple[Array, Array, Array, float]:
    """Residuals of the points on the ground by z, roll and pitch; mean pose variance of the planes used."""
    flat = planes.reshape(-1, PLANE)
    n = np.sum((kind == GROUND) & (place >= 0))
    jac, res, var = np.zeros((n, 3)), np.zeros(n), np.zeros(n)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    k, pose_variance = 0, 0.0
    for i in range(points.shape[0]):
        if kind[i] != GROUND or place[i] < 0:
            continue
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        x, y = c * px - s * py + pose[0], s * px + c * py + pose[1]
        p = flat[place[i]]
        dx, dy = x - p[CX], y - p[CY]
        bx, by = c * p[BX] + s * p[BY], -s * p[BX] + c * p[BY]  # slopes in the levelled frame
        jac[k, 0], jac[k, 1], jac[k, 2] = 1.0, py + by * pz, -px - bx * pz
        res[k] = z_m + pz - (p[A] + p[BX] * dx + p[BY] * dy) + jac[k, 1] * tilt[0] + jac[k, 2] * tilt[1]
        along = (pz - bx * px - by * py) / max(math.sqrt(px * px + py * py + pz * pz), 1e-6)
        plane = p[ABOUT] / p[WEIGHT] + dx * dx * p[SXX] + 2 * dx * dy * p[SXY] + dy * dy * p[SYY]
        unsure = SURFACE_SIGMA_M**2 + SLOPE_M**2 * (bx * bx + by * by)
        var[k] = (sigma_range_m * along) ** 2 + unsure + CORRELATED * plane
        pose_variance += p[PZ]
        k += 1
    return jac, res, var, pose_variance / max(k, 1)


@kernel
def fit_height(
    planes: Array,
    standing: Array,
    points: Array,
    pose: Array,
    z_m: float,
    kind: NDArray[np.int64],
    place: NDArray[np.int64],
    sigma_range_m: float,
    lean: Array,
    tilt_prior: Array,
    shift_prior: Array,
    bend_variance: float,
    iterations: int,
) -> tuple[Array, Array, Array]:
    """Tilt from the points on walls, then z from those on the ground.

    Walls are plumb but for what their bumps make them lean by; the ground's map is only as level as it was built: so the
    ground does not tell tilt, and z is fitted with a slope of its own of that variance beside it. The body's place is a
    little off too, which must not pass for tilt: it is fitted beside it.

    lean: (2,) of the walls in sight, turn about map x and y, as believed. tilt_prior, shift_prior: (4, 4) information about
    roll, pitch and lean, (2, 2) about x, y. Returns: (5,) correction of z, roll, pitch, lean; (5, 5) information: of z
    alone, and of tilt and lean by the walls; (6,) ground points, wall points, scale, mean pose variance of the planes
    used, variance of the tilt by walls of independent errors, and how many times that their bumps add.
    """
    out = np.zeros(6)
    correction, information = np.zeros(5), np.zeros((5, 5))
    jac, res, var, sector = _wall_rows(standing, points, pose, kind, sigma_range_m, lean)
    out[1] = len(res)
    prior = np.zeros((6, 6))
    prior[:4, :4] = tilt_prior
    prior[4:, 4:] = shift_prior
    if len(res) > 0:
        tilt, h, scale = solve_robustly(jac, res, var, prior, iterations)
        correction[1:] = tilt[:4]
        h[4:, 4:] += shift_prior
        information[1:, 1:] = without(h, 4)
        of_body = np.concatenate((jac[:, :2], jac[:, 4:]), axis=1)
        weak = prior[2:, 2:].copy()
        weak[:2, :] = 0.0
        weak[0, 0] = weak[1, 1] = 1.0 / LOOSE_RAD**2
        out[4], out[5] = shared_by_sector(of_body, res + jac @ tilt, var, scale, sector, weak)
    left = np.linalg.inv(information[1:, 1:] + tilt_prior)
    jac, res, var, out[3] = _ground_rows(planes, points, pose, z_m, correction[1:3], kind, place, sigma_range_m)
    out[0] = len(res)
    if len(res) > 5:
        slope_prior = np.zeros((3, 3))
        slope_prior[0, 0] = 1e-3
        slope_prior[1, 1] = 1.0 / (left[0, 0] + bend_variance)
        slope_prior[2, 2] = 1.0 / (left[1, 1] + bend_variance)
        height, h, out[2] = solve_robustly(jac, res, var, slope_prior, iterations)
        correction[0] = height[0]
        information[0, 0] = without(h + slope_prior, 1)[0, 0]
    return correction, information, out


@kernel
def shift_along(
    planes: Array,
    points: Array,
    pose: Array,
    z_m: float,
    tilt: Array,
    axis: Array,
    kind: NDArray[np.int64],
    place: NDArray[np.int64],
    sigma_range_m: float,
    variances: Array,
    iterations: int,
) -> tuple[float, float]:
    """How far along a level axis (2,) of `map` the body is off, by the flanks of the ground that is known; and the information
    about that, with z, roll and pitch, of those variances (3,), left free beside it. 0 where too few points tell."""
    flat = planes.reshape(-1, PLANE)
    rows, res, var, _ = _ground_rows(planes, points, pose, z_m, tilt, kind, place, sigma_range_m)
    if len(res) < MIN_SHIFT_POINTS:
        return 0.0, 0.0
    jac = np.zeros((len(res), 4))
    jac[:, 1:] = rows
    k, sloping = 0, 0
    for i in range(points.shape[0]):
        if kind[i] == GROUND and place[i] >= 0:
            p = flat[place[i]]
            slope = p[BX] * axis[0] + p[BY] * axis[1]
            if abs(slope) > LEAST_SLOPE:
                jac[k, 0] = -slope
                sloping += 1
            k += 1
    if sloping < MIN_SHIFT_POINTS:
        return 0.0, 0.0
    prior = np.zeros((4, 4))
    prior[0, 0] = 1e-6
    for j in range(3):
        prior[1 + j, 1 + j] = 1.0 / variances[j]
    moved, h, _ = solve_robustly(jac, res, var, prior, iterations)
    return float(moved[0]), max(float(without(h + prior, 1)[0, 0]), 0.0)
