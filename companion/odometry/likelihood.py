"""Where in a map a scan fits best, searched over a whole window of poses instead of downhill from a guess.

Olson, Real-Time Correlative Scan Matching, ICRA 2009; bounded as in Hess et al., Real-Time Loop Closure in 2D LIDAR SLAM,
ICRA 2016, with one coarse level: blocks of poses are looked into in the order of what they can reach at best.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from companion.geometry import rotation2, wrap_angle
from companion.jit import kernel
from companion.messages import Array

CELL_M = 0.1
SIGMA_M = 0.1  # a point this far from the map's counts exp(-1/2)
REACH = 2  # cells about a point that it lights
BLOCK = 8  # cells of a coarse step
MARGIN_CELLS = 32
FAR_M = 20.0  # a step of the turn moves a point this far away by a cell
FAR_WEIGHT = 0.15  # what the corner of the window costs against its middle: of equal fits, the nearer one


@dataclass(frozen=True, slots=True)
class Fit:
    """pose: x, y, yaw in the map's frame. score: 0 to 1, mean likelihood of the points."""

    pose: Array
    score: float


class LikelihoodGrid:
    """Cells lit by points, (N, 2) in one frame; grows with them."""

    def __init__(self, points: Array) -> None:
        low = np.floor(points.min(axis=0) / CELL_M).astype(np.int64) - MARGIN_CELLS
        high = np.ceil(points.max(axis=0) / CELL_M).astype(np.int64) + MARGIN_CELLS
        self._low = low
        self._cells = np.zeros((int(high[1] - low[1]), int(high[0] - low[0])), np.float32)
        _light(self._cells, points / CELL_M - low)
        self._bound = _ahead(self._cells)

    def search(self, points: Array, guess: Array, *, window_m: float, window_rad: float) -> Fit:
        """The best pose of (N, 2) points of a scan within a window about the guess (N > 0)."""
        far = float(np.quantile(np.hypot(points[:, 0], points[:, 1]), 0.9))
        step = CELL_M / min(max(far, 1.0), FAR_M)
        half_turns = math.ceil(window_rad / step)
        turns: Array = step * np.arange(-half_turns, half_turns + 1, dtype=np.float64)
        placed = np.stack([points @ rotation2(float(guess[2] + t)).T for t in turns])
        cells = np.floor((placed + guess[:2]) / CELL_M).astype(np.int64) - self._low
        half = max(math.ceil(window_m / CELL_M / BLOCK), 1) * BLOCK
        off_turn: Array = (turns / max(window_rad, step)) ** 2
        score, turn, dx, dy = _search(self._cells, self._bound, cells, off_turn, half)
        pose = guess + np.array([dx * CELL_M, dy * CELL_M, turns[turn]])
        pose[2] = wrap_angle(float(pose[2]))
        return Fit(pose, score)


def thinned(points: Array, cell_m: float = CELL_M) -> Array:
    """One point for each cell, so that what is near does not outvote what is far."""
    _, first = np.unique(np.floor(points / cell_m).astype(np.int64), axis=0, return_index=True)
    kept: Array = points[np.sort(first)]
    return kept


def _ahead(cells: NDArray[np.float32]) -> NDArray[np.float32]:
    """The most of each cell and the BLOCK - 1 after it, both ways: what a block of poses can reach."""
    wide: NDArray[np.float32] = cells
    for axis in (0, 1):
        wide = maximum_filter1d(wide, BLOCK, axis=axis, origin=-(BLOCK // 2), mode="constant")
    return wide


@kernel
def _light(cells: NDArray[np.float32], points: Array) -> None:
    ny, nx = cells.shape
    for i in range(points.shape[0]):
        ix, iy = math.floor(points[i, 0]), math.floor(points[i, 1])
        for jy in range(max(0, iy - REACH), min(ny, iy + REACH + 1)):
            for jx in range(max(0, ix - REACH), min(nx, ix + REACH + 1)):
                d2 = ((jx + 0.5 - points[i, 0]) ** 2 + (jy + 0.5 - points[i, 1]) ** 2) * CELL_M**2
                cells[jy, jx] = max(cells[jy, jx], np.float32(math.exp(-0.5 * d2 / SIGMA_M**2)))


@kernel
def _mean_at(grid: NDArray[np.float32], cells: NDArray[np.int64], dx: int, dy: int) -> float:
    ny, nx = grid.shape
    total = 0.0
    for i in range(cells.shape[0]):
        x, y = cells[i, 0] + dx, cells[i, 1] + dy
        if 0 <= x < nx and 0 <= y < ny:
            total += grid[y, x]
    return float(total / cells.shape[0])


@kernel
def _mean_bound(grid: NDArray[np.float32], cells: NDArray[np.int64], dx: int, dy: int) -> float:
    """As _mean_at for the bound, whose blocks may begin before the grid does."""
    ny, nx = grid.shape
    total = 0.0
    for i in range(cells.shape[0]):
        x, y = cells[i, 0] + dx, cells[i, 1] + dy
        if -BLOCK < x < nx and -BLOCK < y < ny:
            total += grid[max(y, 0), max(x, 0)]
    return float(total / cells.shape[0])


@kernel
def _search(
    grid: NDArray[np.float32], bound: NDArray[np.float32], cells: NDArray[np.int64], off_turn: Array, half: int
) -> tuple[float, int, int, int]:
    """cells: (turns, N, 2) of the points at the guess. Returns score, index of the turn, dx and dy in cells."""
    blocks = 2 * half // BLOCK
    turns = cells.shape[0]
    reach = np.empty(turns * blocks * blocks)
    for t in range(turns):
        for by in range(blocks):
            for bx in range(blocks):
                at = (t * blocks + by) * blocks + bx
                reach[at] = _mean_bound(bound, cells[t], bx * BLOCK - half, by * BLOCK - half)
    best, score, best_turn, best_dx, best_dy = -1.0, 0.0, turns // 2, 0, 0
    for at in np.argsort(-reach, kind="mergesort"):
        if reach[at] <= best:
            break
        t, by, bx = at // (blocks * blocks), at // blocks % blocks, at % blocks
        for dy in range(by * BLOCK - half, (by + 1) * BLOCK - half):
            for dx in range(bx * BLOCK - half, (bx + 1) * BLOCK - half):
                fit = _mean_at(grid, cells[t], dx, dy)
                worth = fit * (1.0 - FAR_WEIGHT * ((dx * dx + dy * dy) / (2.0 * half * half) + off_turn[t]) / 2.0)
                if worth > best:
                    best, score, best_turn, best_dx, best_dy = worth, fit, t, dx, dy
    return score, best_turn, best_dx, best_dy
