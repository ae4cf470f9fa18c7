"""The inner loops over one scan's returns: deskew and levelling, blocks of neighbours, the layer that walls are seen in.

Returns come column by column, within a column from the top row down, as the sensor fires them.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from companion.jit import kernel
from companion.messages import Array
from companion.odometry.attitude import interpolate_at

LEAN_COLUMNS = 4  # to each side, whose median tells whether a surface leans
LEAST_LEANING = 3
LEAN_SIGMAS = 3.0
STEEPEST = 0.7  # metres back for each up: 55 deg, steeper than stored bulk lies
STRAIGHT = 0.35  # share by which the two differ on one slope
LEAST_DROP_M = 0.1
SAME_M = 1.0  # of range between columns of one surface
SECTORS = 8  # of a turn: what is too near is told by a layer's median over one, not by the noise of a block
BLOCK_SPAN_M = 0.6  # of range, about the block's median, beyond which a return is not the same surface


@kernel
def column_motion(
    t_column_ns: NDArray[np.int64],
    t_end_ns: int,
    sample_ns: NDArray[np.int64],
    samples: Array,
    velocity_level_mps: Array,
    roll_offset_rad: float,
    pitch_offset_rad: float,
) -> Array:
    """(columns, 6): roll, pitch, yaw and place of the body at each column, relative to yaw and place at t_end_ns.

    sample_ns, samples: (N,), (N, 4) as of AttitudeHistory. velocity_level_mps: (3,) in the level frame of the end.
    """
    _, _, yaw_end, _ = interpolate_at(t_end_ns, sample_ns, samples)
    motion = np.empty((len(t_column_ns), 6))
    for c in range(len(t_column_ns)):
        roll, pitch, yaw, _ = interpolate_at(t_column_ns[c], sample_ns, samples)
        motion[c, 0] = roll + roll_offset_rad
        motion[c, 1] = pitch + pitch_offset_rad
        motion[c, 2] = yaw - yaw_end
        dt_s = min(max(float(t_column_ns[c] - t_end_ns) * 1e-9, -1.0), 1.0)
        for k in range(3):
            motion[c, 3 + k] = dt_s * velocity_level_mps[k]
    return motion


@kernel
def level_columns(
    range_m: NDArray[np.float32],
    column_valid: NDArray[np.bool_],
    directions: Array,
    offsets: Array,
    r_body_lidar: Array,
    t_body_lidar: Array,
    motion: Array,
) -> tuple[Array, Array, NDArray[np.int64], NDArray[np.int64]]:
    """Every return as a point of the level frame: points (N, 3), range (N,), row (N,), column (N,).

    motion: (columns, 6) roll, pitch, yaw relative to the end, and place relative to the end, level frame.
    """
    rows, columns = range_m.shape
    points = np.empty((rows * columns, 3))
    ranges = np.empty(rows * columns)
    row = np.empty(rows * columns, np.int64)
    column = np.empty(rows * columns, np.int64)
    n = 0
    for c in range(columns):
        if not column_valid[c]:
            continue
        cr, sr = math.cos(motion[c, 0]), math.sin(motion[c, 0])
        cp, sp = math.cos(motion[c, 1]), math.sin(motion[c, 1])
        cy, sy = math.cos(motion[c, 2]), math.sin(motion[c, 2])
        for i in range(rows):
            d = float(range_m[i, c])
            if not (d > 0.0 and d < 1e4):  # also drops NaN
                continue
            lx = directions[i, c, 0] * d + offsets[i, c, 0]
            ly = directions[i, c, 1] * d + offsets[i, c, 1]
            lz = directions[i, c, 2] * d + offsets[i, c, 2]
            bx = r_body_lidar[0, 0] * lx + r_body_lidar[0, 1] * ly + r_body_lidar[0, 2] * lz + t_body_lidar[0]
            by = r_body_lidar[1, 0] * lx + r_body_lidar[1, 1] * ly + r_body_lidar[1, 2] * lz + t_body_lidar[1]
            bz = r_body_lidar[2, 0] * lx + r_body_lidar[2, 1] * ly + r_body_lidar[2, 2] * lz + t_body_lidar[2]
            y1, z1 = cr * by - sr * bz, sr * by + cr * bz  # roll
            x2, z2 = cp * bx + sp * z1, -sp * bx + cp * z1  # pitch
            points[n, 0] = cy * x2 - sy * y1 + motion[c, 3]
            points[n, 1] = sy * x2 + cy * y1 + motion[c, 4]
            points[n, 2] = z2 + motion[c, 5]
            ranges[n] = d
            row[n] = i
            column[n] = c
            n += 1
    return points[:n].copy(), ranges[:n].copy(), row[:n].copy(), column[:n].copy()


@kernel
def within_range(
    points: Array,
    range_m: Array,
    row: NDArray[np.int64],
    column: NDArray[np.int64],
    min_range_m: float,
    max_range_m: float,
) -> tuple[Array, Array, NDArray[np.int64], NDArray[np.int64]]:
    """The returns from min_range_m to max_range_m; the very same arrays where that is all of them."""
    good = 0
    for i in range(len(range_m)):
        good += min_range_m <= range_m[i] <= max_range_m
    if good == len(range_m):
        return points, range_m, row, column
    near = np.empty((good, 3))
    ranges, rows, columns = np.empty(good), np.empty(good, np.int64), np.empty(good, np.int64)
    n = 0
    for i in range(len(range_m)):
        if min_range_m <= range_m[i] <= max_range_m:
            for k in range(3):
                near[n, k] = points[i, k]
            ranges[n], rows[n], columns[n] = range_m[i], row[i], column[i]
            n += 1
    return near, ranges, rows, columns


@kernel
def upright_layer(
    points: Array,
    row: NDArray[np.int64],
    column: NDArray[np.int64],
    rows: tuple[int, int, int],
    columns: int,
    above_m: float,
    noise_m: float,
    spacing_m: float,
    needs_both: bool,
) -> Array:
    """(M, 2) x and y of the points of the first of the rows that may be walls: see level.wall_layer. The others: the layers
    below that are asked, -1: none. needs_both: else the first of these is enough."""
    width = 2.0 * math.pi / columns
    flat, height = np.full((3, columns), np.nan), np.full((3, columns), np.nan)
    for i in range(len(row)):
        for k in range(3):
            if row[i] == rows[k] and points[i, 2] > above_m:
                flat[k, column[i]] = math.hypot(points[i, 0], points[i, 1])
                height[k, column[i]] = points[i, 2]
    out = np.empty((len(row), 2))
    near, low = np.empty(2 * LEAN_COLUMNS + 1), np.empty(2 * LEAN_COLUMNS + 1)
    n, passed, last = 0, np.inf, -1
    for i in range(len(row)):
        if row[i] != rows[0] or points[i, 2] <= above_m:
            continue
        if rows[1] >= 0 and _leans(flat, height, column[i], noise_m, needs_both, near, low):
            continue
        if spacing_m > 0.0:
            step = float(column[i] - last)
            passed += step * width * math.hypot(points[i, 0], points[i, 1])
            last = column[i]
            if passed < spacing_m:
                continue
            passed = 0.0
        out[n, 0] = points[i, 0]
        out[n, 1] = points[i, 1]
        n += 1
    return out[:n].copy()


@kernel
def _leans(flat: Array, height: Array, column: int, noise_m: float, needs_both: bool, near: Array, low: Array) -> bool:
    """Whether a surface leans back by more than noise lets it look. flat, height: (3, columns) of the layer and of the two
    that are asked, distance from the axis and height; near, low: scratch."""
    back, noise = _lean(flat, height, 0, column, noise_m, near, low)
    if not back > STEEPEST + noise:
        return False
    if not needs_both:
        return True
    on, more = _lean(flat, height, 1, column, noise_m, near, low)
    return abs(on - back) < STRAIGHT * back + noise + more


@kernel
def _lean(
    flat: Array, height: Array, k: int, column: int, noise_m: float, near: Array, low: Array
) -> tuple[float, float]:
    """By how many metres a surface goes back for each that it rises, between rows k and k + 1, and what noise makes of that;
    NaN where they do not tell."""
    n, columns = 0, flat.shape[1]
    for at in range(-LEAN_COLUMNS, LEAN_COLUMNS + 1):
        c = (column + at) % columns
        if abs(flat[0, c] - flat[0, column]) < SAME_M and not math.isnan(flat[k, c] - flat[k + 1, c]):
            near[n], low[n] = flat[k, c] - flat[k + 1, c], height[k, c] - height[k + 1, c]
            n += 1
    if n < LEAST_LEANING:
        return np.nan, np.nan
    drop = middle_of(low, n)
    if drop < LEAST_DROP_M:
        return np.nan, np.nan
    return middle_of(near, n) / drop, LEAN_SIGMAS * 1.25 * math.sqrt(2.0 / n) * noise_m / drop


@kernel
def middle_of(values: Array, n: int) -> float:
    """Median of the first n values, which it sorts in place: for a handful of them. n > 0."""
    for i in range(1, n):
        value, j = values[i], i
        while j > 0 and values[j - 1] > value:
            values[j] = values[j - 1]
            j -= 1
        values[j] = value
    return float(values[n // 2]) if n % 2 else float((values[n // 2 - 1] + values[n // 2]) / 2.0)


@kernel
def block_means(
    points: Array,
    range_m: Array,
    row: NDArray[np.int64],
    column: NDArray[np.int64],
    above_row: int,
    size: int,
    min_range_m: float,
    columns: int,
) -> Array:
    """(M, 4) means of the returns of `size` neighbouring columns in each row below above_row, and how many returns each is
    the mean of; see level.block_means."""
    middles = _sector_medians(range_m, row, column, columns)
    out = np.empty((len(range_m) + 1, 4))
    rows = 0
    for i in range(len(range_m)):
        rows = max(rows, row[i] + 1)
    members = np.empty((rows, size), np.int64)
    count = np.zeros(rows, np.int64)
    block = np.full(rows, -1, np.int64)
    ranges = np.empty(size)
    n = 0
    for i in range(len(range_m)):
        k = row[i]
        if k <= above_row:
            continue
        if column[i] // size != block[k]:
            if count[k] > 0 and middles[k, block[k] * size * SECTORS // columns] >= min_range_m:
                n += _mean_of_block(points, range_m, members[k], count[k], size, ranges, out[n])
            count[k] = 0
            block[k] = column[i] // size
        members[k, count[k]] = i
        count[k] += 1
    for k in range(rows):  # the last blocks
        if count[k] > 0 and middles[k, block[k] * size * SECTORS // columns] >= min_range_m:
            n += _mean_of_block(points, range_m, members[k], count[k], size, ranges, out[n])
    return out[:n].copy()


@kernel
def _mean_of_block(
    points: Array,
    range_m: Array,
    members: NDArray[np.int64],
    count: int,
    size: int,
    ranges: Array,
    out: Array,
) -> int:
    """1, and in `out` (4,) mean and returns, where enough of the block lie on one surface, else 0. ranges: (size,) scratch."""
    for j in range(count):
        ranges[j] = range_m[members[j]]
    middle = middle_of(ranges, count)
    out[:] = 0.0
    used = 0
    for j in range(count):
        if abs(range_m[members[j]] - middle) <= BLOCK_SPAN_M:
            for k in range(3):
                out[k] += points[members[j], k]
            used += 1
    if 2 * used < size:
        return 0
    for k in range(3):
        out[k] /= used
    out[3] = used
    return 1


@kernel
def _sector_medians(range_m: Array, row: NDArray[np.int64], column: NDArray[np.int64], columns: int) -> Array:
    """(rows, SECTORS) median range of each row's returns in each sector of the turn; 0 where there are none."""
    rows = 0
    for i in range(len(range_m)):
        rows = max(rows, row[i] + 1)
    held = np.empty((rows, SECTORS, columns // SECTORS + 1))
    count = np.zeros((rows, SECTORS), np.int64)
    for i in range(len(range_m)):
        k, sector = row[i], column[i] * SECTORS // columns
        held[k, sector, count[k, sector]] = range_m[i]
        count[k, sector] += 1
    out = np.zeros((rows, SECTORS))
    for k in range(rows):
        for sector in range(SECTORS):
            if count[k, sector] > 0:
                out[k, sector] = np.median(held[k, sector, : count[k, sector]])
    return out


@kernel
def median_bend(range_m: NDArray[np.float32]) -> tuple[float, int]:
    """Median size of the second differences of a row's ranges (columns,), 0: no return; and of how many."""
    bends = np.empty(len(range_m))
    n = 0
    for i in range(1, len(range_m) - 1):
        before, middle, after = float(range_m[i - 1]), float(range_m[i]), float(range_m[i + 1])
        if before > 0.0 and middle > 0.0 and after > 0.0:
            bends[n] = abs(before - 2.0 * middle + after)
            n += 1
    return (float(np.median(bends[:n])), n) if n > 0 else (0.0, 0)
