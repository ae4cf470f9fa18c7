"""Distance from a point to the nearest of what stands in the store, compiled: it is asked for many times a second."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from simbridge.kernels import triangle

Array = NDArray[np.float64]
PILE_M = 0.02  # material thinner than this counts as floor


def _wall(ring: Array, x: float, y: float) -> float:
    """Distance to a closed ring (N, 2), its last corner being its first; 0 outside it."""
    nearest = math.inf
    is_inside = False
    for i in range(ring.shape[0] - 1):
        ax, ay = ring[i, 0], ring[i, 1]
        ex, ey = ring[i + 1, 0] - ax, ring[i + 1, 1] - ay
        along = ((x - ax) * ex + (y - ay) * ey) / (ex * ex + ey * ey)
        along = min(max(along, 0.0), 1.0)
        nearest = min(nearest, math.hypot(x - ax - along * ex, y - ay - along * ey))
        if (ay > y) != (ay + ey > y) and x < ax + ex * (y - ay) / ey:
            is_inside = not is_inside
    return nearest if is_inside else 0.0


def _obstacle(table: Array, x: float, y: float, z: float) -> float:
    """Distance to the nearest of the obstacles, 0 inside one, infinite without any; rows: see `footprint.table`."""
    nearest = math.inf
    for i in range(table.shape[0]):
        cx, cy, hx, hy, hz, cos, sin, foot, is_round = table[i]
        dx, dy = x - cx, y - cy
        above = max(abs(z - foot - hz) - hz, 0.0)
        if is_round > 0.0:
            beside = max(math.sqrt(dx * dx + dy * dy) - hx, 0.0)
        else:
            along = max(abs(cos * dx + sin * dy) - hx, 0.0)
            across = max(abs(-sin * dx + cos * dy) - hy, 0.0)
            beside = math.sqrt(along * along + across * across)
        nearest = min(nearest, math.sqrt(beside * beside + above * above))
    return nearest


def _pile(
    heights: Array, floor: Array, is_pile: NDArray[np.bool_], grid: Array, x: float, y: float, z: float, reach_m: float
) -> float:
    """Distance to the nearest corner of the piles' triangles if it is within reach_m, else reach_m; 0 inside a pile.

    heights, floor, is_pile: (ny, nx) at the corners of a grid; grid: x and y of its first corner, size of its cells.
    """
    x0, y0, cell = grid[0], grid[1], grid[2]
    top = triangle(heights, x0, y0, cell, x, y)[0]
    if top >= z and top > triangle(floor, x0, y0, cell, x, y)[0] + PILE_M:
        return 0.0
    ny, nx = heights.shape
    nearest2 = reach_m * reach_m
    for iy in range(max(math.ceil((y - reach_m - y0) / cell), 0), min(int((y + reach_m - y0) / cell) + 1, ny)):
        dy = y0 + iy * cell - y
        for ix in range(max(math.ceil((x - reach_m - x0) / cell), 0), min(int((x + reach_m - x0) / cell) + 1, nx)):
            if is_pile[iy, ix]:
                dx, dz = x0 + ix * cell - x, heights[iy, ix] - z
                nearest2 = min(nearest2, dx * dx + dy * dy + dz * dz)
    return math.sqrt(nearest2)


wall = njit(cache=True)(_wall)
obstacle = njit(cache=True)(_obstacle)
pile = njit(cache=True)(_pile)


def warm_up() -> None:
    """Compile (or load from the cache) every kernel for the types that `World.clearance` gives."""
    wall(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, 0.0]]), 0.1, 0.1)
    obstacle(np.zeros((1, 9)), 0.0, 0.0, 0.0)
    pile(np.zeros((2, 2)), np.zeros((2, 2)), np.zeros((2, 2), dtype=np.bool_), np.ones(3), 0.0, 0.0, 1.0, 1.0)
