"""The inner loops over one horizontal scan: smoothing, the nearest thing in a lane or a window, the wall's line.

ranges, smooth: (360,) m by bearing in whole degrees, counter-clockwise from forward. points: (360, 2) levelled body frame.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from companion.jit import kernel
from companion.messages import Array

SECTORS = 360
BEARING_RAD = np.radians(np.arange(SECTORS))
DIRECTION = np.column_stack([np.cos(BEARING_RAD), np.sin(BEARING_RAD)])
TOO_NEAR_M = 0.2  # to be anything but the vehicle
SMOOTH_SECTORS = 5  # to each side
SMOOTH_GATE_M = 0.5  # about 4 sigma of the range noise (0.12 m): a wall is averaged, an edge is kept
FIT_RADIUS_M = 4.0
FIT_GATES_M = (1.0, 0.7, 0.5, 0.4, 0.4)  # of Tukey's weight, one an iteration: pilasters drop out, the wall stays
FIT_MIN_POINTS = 12
FIT_MIN_LENGTH_M = 1.5
FIT_MAX_OFFSET_M = 0.7  # a line may lie this far behind the nearest return: pilasters, not piles
USED_WEIGHT = 0.2
BESIDE_RATIO = math.tan(math.radians(60))


@kernel
def smoothed(ranges: Array) -> tuple[Array, Array]:
    """smooth and points: see ScanView. Bad values (NaN, negative, too near) count as nothing seen."""
    smooth, points = np.full(SECTORS, np.inf), np.full((SECTORS, 2), np.nan)
    for n in range(SECTORS):
        own = ranges[n]
        if not TOO_NEAR_M < own < np.inf:
            continue
        points[n, 0] = own * DIRECTION[n, 0]
        points[n, 1] = own * DIRECTION[n, 1]
        # The inverse range of a straight wall is a sinusoid of bearing: its mean over a few degrees has no bias.
        count, inverse = 0, 0.0
        for k in range(n - SMOOTH_SECTORS, n + SMOOTH_SECTORS + 1):
            other = ranges[k % SECTORS]
            if other > TOO_NEAR_M and abs(other - own) < SMOOTH_GATE_M:
                count += 1
                inverse += 1.0 / other
        if count >= 2:
            smooth[n] = count / inverse
    return smooth, points


@kernel
def nearest_between(smooth: Array, low_rad: float, high_rad: float) -> int:
    """The sector of the nearest surface from low counter-clockwise to high; -1: none."""
    best = -1
    for n in range(SECTORS):
        if (BEARING_RAD[n] - low_rad) % (2 * math.pi) > high_rad - low_rad:
            continue
        if smooth[n] < np.inf and (best < 0 or smooth[n] < smooth[best]):
            best = n
    return best


@kernel
def nearest_in_lane(
    smooth: Array, bearing_rad: float, left_m: float, right_m: float, beside_m: float
) -> tuple[float, int]:
    """How far along the lane its nearest surface lies, and its sector; (inf, -1): the lane is free. See ScanView."""
    c, s = math.cos(bearing_rad), math.sin(bearing_rad)
    nearest, best = np.inf, -1
    for n in range(SECTORS):
        if not smooth[n] < np.inf:
            continue
        x, y = smooth[n] * DIRECTION[n, 0], smooth[n] * DIRECTION[n, 1]
        along, across = x * c + y * s, -x * s + y * c
        if not (0.0 < along < nearest and -right_m < across < left_m):
            continue
        if abs(across) < beside_m or abs(across) < BESIDE_RATIO * along:
            nearest, best = along, n
    return nearest, best


@kernel
def fit_wall(points: Array, distance_m: float, bearing_rad: float) -> tuple[bool, float, float, float, float]:
    """Total least squares with Tukey's weights through the returns about the nearest place.

    Returns: whether there is a line; its distance, its normal's bearing, and its ends clockwise and counter-clockwise.
    """
    nx, ny = math.cos(bearing_rad), math.sin(bearing_rad)
    cx, cy, d = distance_m * nx, distance_m * ny, distance_m
    none = (False, 0.0, 0.0, 0.0, 0.0)
    near: NDArray[np.int64] = np.empty(SECTORS, np.int64)
    m = 0
    for n in range(SECTORS):  # NaN is not near
        if (points[n, 0] - cx) ** 2 + (points[n, 1] - cy) ** 2 < FIT_RADIUS_M**2:
            near[m] = n
            m += 1
    if m < FIT_MIN_POINTS:
        return none
    weight = np.empty(m)
    for gate in FIT_GATES_M:
        total, cx, cy = 0.0, 0.0, 0.0
        for i in range(m):
            x, y = points[near[i], 0], points[near[i], 1]
            off = (x * nx + y * ny - d) / gate
            weight[i] = (1.0 - off**2) ** 2 if abs(off) < 1.0 else 0.0
            total += weight[i]
            cx += weight[i] * x
            cy += weight[i] * y
        if total < 0.4 * FIT_MIN_POINTS:
            return none
        cx, cy = cx / total, cy / total
        sxx, sxy, syy = 0.0, 0.0, 0.0
        for i in range(m):
            x, y = points[near[i], 0] - cx, points[near[i], 1] - cy
            sxx += weight[i] * x * x
            sxy += weight[i] * x * y
            syy += weight[i] * y * y
        along = 0.5 * math.atan2(2.0 * sxy, sxx - syy)
        nx, ny = -math.sin(along), math.cos(along)
        d = nx * cx + ny * cy
        if d < 0:
            nx, ny, d = -nx, -ny, -d
    # Long enough, well held, and its nearest place to us lies on it rather than beyond its end.
    used, low, high = 0, np.inf, -np.inf
    for i in range(m):
        if weight[i] > USED_WEIGHT:
            along = -(points[near[i], 0] - cx) * ny + (points[near[i], 1] - cy) * nx
            low, high = min(low, along), max(high, along)
            used += 1
    here = cx * ny - cy * nx
    if used < FIT_MIN_POINTS or high - low < FIT_MIN_LENGTH_M or not low - 0.3 <= here <= high + 0.3:
        return none
    angle = math.atan2(ny, nx)
    if abs(d - distance_m) > FIT_MAX_OFFSET_M or math.cos(angle - bearing_rad) < 0.8:
        return none
    return True, d, angle, here - low, high - here
