"""The wall map's inner loops: lines in a grid of moments, and registration of points to them.

Cells hold sums over the points that fell into them; the line of a cell is fitted to the window of (2 WINDOW + 1)^2
cells around it, so that a wall on a cell's border is not cut in two. A window of fixed borders fits without bias,
however oblique the beams: along a long wall the noise moves as many points into the window as out of it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from companion.jit import kernel
from companion.messages import Array
from companion.odometry.solve_kernels import TUKEY, solve3, without_translation

WINDOW = 2
# sums of a cell: weight, x, y, xx, xy, yy, pose variance in x, y, yaw
W, X, Y, XX, XY, YY, VX, VY, VYAW = range(9)
SUMS = 9
# a line: normal (2), point on it (2), variance across, weight, variance along, pose variance x, y, yaw, lowest and highest
# z it was seen at, spread of z over which the same cells were seen, curvature (1/m, positive: bent toward the normal)
NX, NY, CX, CY, ACROSS, WEIGHT, ALONG, PX, PY, PYAW, LOW, HIGH, SPREAD, CURVE = range(14)
LINE = 14
DIRTY, VALID, NO_LINE = 0, 1, 2

MIN_WEIGHT = 5.0
MAX_SLENDER = 0.35  # variance across / along above which a window holds no line
ANGULAR_SIGMA_RAD = 0.0015  # of a beam's direction: time stamps, attitude, the sensor's own
NORMAL_SIGMA_RAD = 0.02  # what the normal of a window errs by however many points it holds: curves, steps
NEIGHBOURS = 4  # on each side of a point
CORRELATED = 8.0  # points of one scan that share a line, and so its error
LEAST_BANDS = 4  # of a window's five, to tell whether it is bent
MOST_CURVE = 0.15  # 1/m: what bends more is a corner, or a column
BENT = 0.05  # variance across over along, beyond the noise, above which a window holds no straight wall (a column: 0.1)
# A surface seen from one height only may lean: material lies at 35 deg and its outline shrinks as the vehicle climbs.
LEVEL_M = 0.05  # change of height that matters to none
SHARED_LEAN = 8.0  # points that lean together


@kernel
def insert_points(
    sums: Array,
    spread: Array,
    state: NDArray[np.uint8],
    origin: Array,
    cell_m: float,
    points_map: Array,
    z_m: float,
    variances: Array,
) -> None:
    """Add points (N, 2) seen from height z_m with a pose of those variances (x, y, yaw); all must lie in the grid.

    spread: (ny, nx, 2) lowest and highest z at which each cell was seen.
    """
    ny, nx = state.shape
    for i in range(points_map.shape[0]):
        ix = math.floor((points_map[i, 0] - origin[0]) / cell_m)
        iy = math.floor((points_map[i, 1] - origin[1]) / cell_m)
        if ix < 0 or iy < 0 or ix >= nx or iy >= ny:
            continue
        s = sums[iy, ix]
        x, y = points_map[i, 0], points_map[i, 1]
        if s[W] == 0.0:
            spread[iy, ix, 0] = z_m
            spread[iy, ix, 1] = z_m
        s[W] += 1.0
        s[X] += x
        s[Y] += y
        s[XX] += x * x
        s[XY] += x * y
        s[YY] += y * y
        s[VX] += variances[0]
        s[VY] += variances[1]
        s[VYAW] += variances[2]
        spread[iy, ix, 0] = min(spread[iy, ix, 0], z_m)
        spread[iy, ix, 1] = max(spread[iy, ix, 1], z_m)
        for jy in range(max(0, iy - WINDOW), min(ny, iy + WINDOW + 1)):
            for jx in range(max(0, ix - WINDOW), min(nx, ix + WINDOW + 1)):
                state[jy, jx] = DIRTY


@kernel
def fit_line(sums: Array, spread: Array, state: NDArray[np.uint8], lines: Array, iy: int, ix: int) -> None:
    """Fit the window about a cell anew and remember it; the state says whether it is a line."""
    ny, nx = state.shape
    total = np.zeros(SUMS)
    low, high = 0.0, 0.0
    for jy in range(max(0, iy - WINDOW), min(ny, iy + WINDOW + 1)):
        for jx in range(max(0, ix - WINDOW), min(nx, ix + WINDOW + 1)):
            w = sums[jy, jx, W]
            if w > 0.0:
                for k in range(SUMS):
                    total[k] += sums[jy, jx, k]
                low += w * spread[jy, jx, 0]
                high += w * spread[jy, jx, 1]
    state[iy, ix] = NO_LINE
    w = total[W]
    if w < MIN_WEIGHT:
        return
    mx, my = total[X] / w, total[Y] / w
    cxx = max(total[XX] / w - mx * mx, 0.0)
    cyy = max(total[YY] / w - my * my, 0.0)
    cxy = total[XY] / w - mx * my
    half = 0.5 * (cxx + cyy)
    root = math.sqrt(0.25 * (cxx - cyy) ** 2 + cxy * cxy)
    along, across = half + root, max(half - root, 0.0)
    if along <= 0.0 or across > MAX_SLENDER * along:
        return
    angle = 0.5 * math.atan2(2.0 * cxy, cxx - cyy)  # of the line
    line = lines[iy, ix]
    line[NX], line[NY] = -math.sin(angle), math.cos(angle)
    line[CX], line[CY] = mx, my
    line[ACROSS], line[WEIGHT], line[ALONG] = across, w, along
    line[PX], line[PY], line[PYAW] = total[VX] / w, total[VY] / w, total[VYAW] / w
    line[LOW], line[HIGH], line[SPREAD] = low / w, high / w, (high - low) / w
    line[CURVE] = _curvature(sums, line, iy, ix)
    state[iy, ix] = VALID


@kernel
def _curvature(sums: Array, line: Array, iy: int, ix: int) -> float:
    """Of what stands in the window, by the means of the bands of cells that lie one after the other along its line.

    A line through the points of a round wall of 16 m radius lies 6 mm inside of it at the window's middle, on all sides of
    the vehicle: no shift takes that up, and it passes for tilt.
    """
    ny, nx = sums.shape[:2]
    is_along_x = abs(line[NY]) >= abs(line[NX])
    system, right, bands = np.zeros((3, 3)), np.zeros(3), 0
    for b in range(-WINDOW, WINDOW + 1):
        w, x, y = 0.0, 0.0, 0.0
        for k in range(-WINDOW, WINDOW + 1):
            jy, jx = (iy + k, ix + b) if is_along_x else (iy + b, ix + k)
            if 0 <= jy < ny and 0 <= jx < nx:
                w += sums[jy, jx, W]
                x += sums[jy, jx, X]
                y += sums[jy, jx, Y]
        if w <= 0.0:
            continue
        bands += 1
        dx, dy = x / w - line[CX], y / w - line[CY]
        a, off = -line[NY] * dx + line[NX] * dy, line[NX] * dx + line[NY] * dy
        shape = (1.0, a, 0.5 * a * a)
        for i in range(3):
            right[i] += w * shape[i] * off
            for j in range(3):
                system[i, j] += w * shape[i] * shape[j]
    if bands < LEAST_BANDS:
        return 0.0
    curve = float(solve3(system, right)[2])
    variance = float(line[ACROSS] * solve3(system, np.array([0.0, 0.0, 1.0]))[2])
    if abs(curve) > MOST_CURVE:
        return 0.0
    return curve**3 / max(curve**2 + variance, 1e-12)  # the less, the less of it is known: most walls are straight


@kernel
def bend_m(line: Array, off: float) -> float:
    """How far what a line stands for lies toward its normal, off along it from its point: the line is the mean of it."""
    return 0.5 * float(line[CURVE]) * (off * off - float(line[ALONG]))


@kernel
def associate(
    sums: Array,
    spread: Array,
    state: NDArray[np.uint8],
    lines: Array,
    origin: Array,
    cell_m: float,
    points: Array,
    pose: Array,
    gate_m: float,
    found: NDArray[np.int64],
) -> int:
    """The cell (flat index, -1: none) whose line each point belongs to; returns how many have one."""
    ny, nx = state.shape
    c, s = math.cos(pose[2]), math.sin(pose[2])
    n = 0
    for i in range(points.shape[0]):
        found[i] = -1
        x = c * points[i, 0] - s * points[i, 1] + pose[0]
        y = s * points[i, 0] + c * points[i, 1] + pose[1]
        ix = math.floor((x - origin[0]) / cell_m)
        iy = math.floor((y - origin[1]) / cell_m)
        if ix < 0 or iy < 0 or ix >= nx or iy >= ny:
            continue
        if state[iy, ix] == DIRTY:
            fit_line(sums, spread, state, lines, iy, ix)
        if state[iy, ix] != VALID:
            continue
        line = lines[iy, ix]
        if abs(line[NX] * (x - line[CX]) + line[NY] * (y - line[CY])) > gate_m:
            continue
        found[i] = iy * nx + ix
        n += 1
    return n


@kernel
def lean_variance(line: Array, z_m: float, cell_m: float) -> float:
    """What a line may be off at height z for want of proof that it is a wall: nothing between the heights it was seen at.

    Cells of cell_m that were seen over a spread s of heights lean at most cell_m / s.
    """
    above = max(z_m - float(line[HIGH]), float(line[LOW]) - z_m) - LEVEL_M
    if above <= 0.0:
        return 0.0
    lean = min(1.0, (cell_m / max(float(line[SPREAD]), 1e-3)) ** 2)
    return SHARED_LEAN * (above * lean) ** 2


@kernel
def residuals(
    lines: Array,
    points: Array,
    found: NDArray[np.int64],
    pose: Array,
    z_m: float,
    cell_m: float,
    sigma_range_m: float,
    sigma_surface_m: float,
    rows: Array,
) -> int:
    """Per matched point, packed in order: index, residual in m, its sigma, its derivative by yaw, distance to the line.

    rows: (N, 5) out.
    """
    flat = lines.reshape(-1, LINE)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    n = 0
    for i in range(points.shape[0]):
        if found[i] < 0:
            continue
        line = flat[found[i]]
        px, py = c * points[i, 0] - s * points[i, 1], s * points[i, 0] + c * points[i, 1]
        dx, dy = px + pose[0] - line[CX], py + pose[1] - line[CY]
        far = math.sqrt(px * px + py * py)
        cos2 = min(1.0, ((line[NX] * px + line[NY] * py) / max(far, 1e-6)) ** 2)
        off = -line[NY] * dx + line[NX] * dy
        variance = (
            cos2 * sigma_range_m**2
            + (1.0 - cos2) * (ANGULAR_SIGMA_RAD * far) ** 2
            + sigma_surface_m**2
            + lean_variance(line, z_m, cell_m)
            + CORRELATED * line[ACROSS] / line[WEIGHT] * (1.0 + off * off / line[ALONG])
            + CORRELATED * max(line[ACROSS] - sigma_range_m**2 - line[PX] - line[PY] - BENT * line[ALONG], 0.0)
        )
        rows[n, 0] = i
        rows[n, 1] = line[NX] * dx + line[NY] * dy - bend_m(line, off)
        rows[n, 2] = math.sqrt(variance)
        rows[n, 3] = -line[NX] * py + line[NY] * px
        rows[n, 4] = line[NX] * px + line[NY] * py
        n += 1
    return n


@kernel
def neighbour_means(rows: Array, n: int, means: Array) -> None:
    """Mean residual, in sigma, over each point and its neighbours in the turn: what they err by together.

    Noise averages out; a surface that is not where the map has it (the outline of a pile, seen from higher up) stays.
    """
    total, count = 0.0, 0
    for i in range(-NEIGHBOURS, n):
        ahead, behind = i + NEIGHBOURS, i - NEIGHBOURS - 1
        if ahead < n:
            total += rows[ahead, 1] / rows[ahead, 2]
            count += 1
        if behind >= 0:
            total -= rows[behind, 1] / rows[behind, 2]
            count -= 1
        if i >= 0:
            means[i] = total / count


@kernel
def robust_scale(values: Array, least: float, most: float) -> float:
    return min(max(1.4826 * float(np.median(np.abs(values))), least), most)


@kernel
def normal_equations(
    lines: Array,
    found: NDArray[np.int64],
    rows: Array,
    n: int,
    means: Array,
    scale: float,
    mean_scale: float,
    system: Array,
    statistics: Array,
) -> float:
    """Sum the system, each point Tukey-weighted by its own residual and by what its neighbours err by together.

    system: (3, 4) out, H and g. statistics: (5,) out: sum of weights, inliers, weighted pose variance x, y, yaw.
    Returns: the part of H about yaw that stems from errors of the normals alone: in a round silo, all of it.
    """
    unsure = 0.0
    flat = lines.reshape(-1, LINE)
    system[:] = 0.0
    statistics[:] = 0.0
    for k in range(n):
        own = rows[k, 1] / rows[k, 2] / (TUKEY * scale)
        shared = means[k] / (TUKEY * mean_scale)
        if abs(own) >= 1.0 or abs(shared) >= 1.0:
            continue
        line = flat[found[int(rows[k, 0])]]
        w = ((1.0 - own * own) * (1.0 - shared * shared)) ** 2 / (rows[k, 2] * scale) ** 2
        r, jyaw = rows[k, 1], rows[k, 3]
        system[0, 0] += w * line[NX] * line[NX]
        system[0, 1] += w * line[NX] * line[NY]
        system[0, 2] += w * line[NX] * jyaw
        system[1, 1] += w * line[NY] * line[NY]
        system[1, 2] += w * line[NY] * jyaw
        head_on = rows[k, 4]
        turned = line[ACROSS] / (line[WEIGHT] * line[ALONG]) + NORMAL_SIGMA_RAD**2
        unsure += w * head_on * head_on * turned
        system[2, 2] += w * jyaw * jyaw
        system[0, 3] += w * line[NX] * r
        system[1, 3] += w * line[NY] * r
        system[2, 3] += w * jyaw * r
        statistics[0] += w
        statistics[1] += 1.0
        statistics[2] += w * line[PX]
        statistics[3] += w * line[PY]
        statistics[4] += w * line[PYAW]
    system[1, 0] = system[0, 1]
    system[2, 0] = system[0, 2]
    system[2, 1] = system[1, 2]
    return unsure


@kernel
def register_to_lines(
    sums: Array,
    spread: Array,
    state: NDArray[np.uint8],
    lines: Array,
    origin: Array,
    cell_m: float,
    points: Array,
    guess: Array,
    z_m: float,
    prior_information: Array,
    sigma_range_m: float,
    sigma_surface_m: float,
    gate_m: float,
    max_iterations: int,
) -> tuple[Array, Array, Array]:
    """Gauss-Newton on Tukey-weighted point-to-line residuals and a prior about the guess.

    Returns: pose (3,); H (3, 3) of the points alone; (10,) iterations, converged, points matched, inliers, scale of the
    residuals in their expected sigma, mean pose variance x, y, yaw of the lines used, share of the points matched, and
    the part of H about yaw that only stems from errors of the normals.
    """
    n = points.shape[0]
    found = np.empty(n, np.int64)
    rows = np.empty((n, 5))
    means = np.empty(n)
    system = np.zeros((3, 4))
    statistics = np.zeros(5)
    pose = guess.copy()
    out = np.zeros(10)
    scale, mean_scale, unsure = 1.0, 1.0, 0.0
    for iteration in range(max_iterations):
        associate(sums, spread, state, lines, origin, cell_m, points, pose, gate_m, found)
        m = residuals(lines, points, found, pose, z_m, cell_m, sigma_range_m, sigma_surface_m, rows)
        out[0] = iteration + 1.0
        out[2] = m
        if m < 6:
            break
        neighbour_means(rows, m, means)
        if iteration < 3:
            scale = robust_scale(rows[:m, 1] / rows[:m, 2], 0.7, 4.0)
            mean_scale = robust_scale(means[:m], scale / math.sqrt(2.0 * NEIGHBOURS + 1.0), 4.0)
        unsure = normal_equations(lines, found, rows, m, means, scale, mean_scale, system, statistics)
        g = system[:, 3] + prior_information @ (pose - guess)
        step = solve3(system[:, :3] + prior_information, g)
        pose = pose - step
        if abs(step[0]) < 2e-4 and abs(step[1]) < 2e-4 and abs(step[2]) < 2e-5:
            out[1] = 1.0
            break
    out[3] = statistics[1]
    out[9] = min(unsure, without_translation(system))
    out[4] = scale
    if statistics[0] > 0.0:
        for k in range(3):
            out[5 + k] = statistics[2 + k] / statistics[0]
    out[8] = out[2] / max(n, 1)
    return pose, system[:, :3].copy(), out


@kernel
def lines_at(
    sums: Array,
    spread: Array,
    state: NDArray[np.uint8],
    lines: Array,
    origin: Array,
    cell_m: float,
    points: Array,
    pose: Array,
) -> Array:
    """What stands at each of (N, 3) levelled points: (N, 8) how it is known, height spread, line, variance of the line, curvature.

    How it is known: 0 nothing seen there, 1 something without a line, 2 a line: normal (2), point on it (2), and curvature:
    of a wall that is bent, its tangent there.
    """
    ny, nx = state.shape
    c, s = math.cos(pose[2]), math.sin(pose[2])
    out = np.zeros((points.shape[0], 8))
    for i in range(points.shape[0]):
        x = c * points[i, 0] - s * points[i, 1] + pose[0]
        y = s * points[i, 0] + c * points[i, 1] + pose[1]
        ix, iy = math.floor((x - origin[0]) / cell_m), math.floor((y - origin[1]) / cell_m)
        if ix < 0 or iy < 0 or ix >= nx or iy >= ny:
            continue
        if state[iy, ix] == DIRTY:
            fit_line(sums, spread, state, lines, iy, ix)
        if state[iy, ix] == VALID:
            line = lines[iy, ix]
            out[i, 0], out[i, 1] = 2.0, line[SPREAD]
            off = -line[NY] * (x - line[CX]) + line[NX] * (y - line[CY])
            turn, bend = float(line[CURVE]) * off, bend_m(line, off)
            norm = math.sqrt(1.0 + turn * turn)
            out[i, 2], out[i, 3] = (line[NX] + turn * line[NY]) / norm, (line[NY] - turn * line[NX]) / norm
            out[i, 4] = line[CX] - line[NY] * off + line[NX] * bend
            out[i, 5] = line[CY] + line[NX] * off + line[NY] * bend
            out[i, 6], out[i, 7] = line[ACROSS] / line[WEIGHT], line[CURVE]
        elif sums[iy, ix, W] > 0.0:
            out[i, 0], out[i, 1] = 1.0, spread[iy, ix, 1] - spread[iy, ix, 0]
    return out
