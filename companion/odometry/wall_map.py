"""The map that scans are registered to: walls as lines in a grid, averaged over all that was seen of them.

Nothing is forgotten and all scans weigh alike, so the walls seen first keep anchoring the pose and drift dies out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.messages import Array
from companion.odometry import kernels
from companion.odometry.grid_growth import growth
from companion.odometry.solve_kernels import without_translation

# 1/rad2: information about yaw, x and y left free, below which it is doubted: a hall's walls give twenty times as much; so
# little comes from a few things in a round store that are no straight walls, and errs alike from scan to scan.
DOUBTED_YAW = 1.0 / math.radians(0.1) ** 2


@dataclass(frozen=True, slots=True)
class Registration:
    """What one registration gave. pose: x, y, yaw in map. information: (3, 3) of the points alone, inverse covariance;
    apparent_information: the same with what about yaw only stems from errors of the lines' normals.

    scale: robust spread of the residuals over what the noise lets expect. matched_ratio: share of the points with a
    wall to go to. map_variance: (3,) of the pose of the map itself where it was used.
    """

    pose: Array
    information: Array
    apparent_information: Array
    converged: bool
    iterations: int
    inliers: int
    matched_ratio: float
    scale: float
    map_variance: Array

    @property
    def per_yaw_m(self) -> Array:
        """(2,) by how much x and y change, in m, with each rad that yaw is off: in a round store, the way to its middle."""
        of_place, with_yaw = self.apparent_information[:2, :2], self.apparent_information[:2, 2]
        return np.asarray(np.linalg.solve(of_place + np.eye(2), -with_yaw), np.float64)


class WallMap:
    """Walls in the plane; lines are fitted to windows of 5 x 5 cells."""

    def __init__(self, cell_m: float = 0.3) -> None:
        self.cell_m = cell_m
        self.origin = np.zeros(2)
        self._allocate(0, 0)

    def _allocate(self, ny: int, nx: int) -> None:
        self.sums = np.zeros((ny, nx, kernels.SUMS))
        self.spread = np.zeros((ny, nx, 2))
        self.state = np.zeros((ny, nx), np.uint8)
        self.lines = np.zeros((ny, nx, kernels.LINE))

    @property
    def is_empty(self) -> bool:
        return self.state.size == 0

    def insert(self, points_map: Array, z_m: float, variances: Array) -> None:
        """Add (N, 2) points seen from height z_m, placed by a pose of those variances (x, y, yaw)."""
        if len(points_map) == 0:
            return
        self._cover(points_map)
        kernels.insert_points(
            self.sums, self.spread, self.state, self.origin, self.cell_m, points_map, z_m, np.asarray(variances)
        )

    def register(
        self,
        points: Array,
        guess: Array,
        prior_information: Array,
        *,
        z_m: float = 0.0,
        sigma_range_m: float,
        sigma_surface_m: float = 0.02,
        gate_m: float = 0.75,
        max_iterations: int = 10,
    ) -> Registration:
        """Find x, y, yaw at which (N, 2) points in the levelled body frame lie on the walls.

        prior_information: (3, 3) inverse covariance of the guess; holds the pose where the walls do not.
        z_m: height of the body: walls that were only seen from another height count less.
        """
        pose, information, out = kernels.register_to_lines(
            self.sums,
            self.spread,
            self.state,
            self.lines,
            self.origin,
            self.cell_m,
            points,
            np.asarray(guess, np.float64),
            z_m,
            np.asarray(prior_information, np.float64),
            sigma_range_m,
            sigma_surface_m,
            gate_m,
            max_iterations,
        )
        believed = information.copy()
        believed[2, 2] -= out[9]
        of_yaw = without_translation(believed)
        believed[2, 2] -= of_yaw * DOUBTED_YAW / (of_yaw + DOUBTED_YAW)
        return Registration(
            pose=pose,
            information=believed,
            apparent_information=information,
            converged=bool(out[1]),
            iterations=int(out[0]),
            inliers=int(out[3]),
            matched_ratio=float(out[8]),
            scale=float(out[4]),
            map_variance=out[5:8],
        )

    def lines_at(self, points_level: Array, pose: Array) -> Array:
        """(N, 8) what stands at each levelled point seen from a pose: see kernels.lines_at."""
        return kernels.lines_at(
            self.sums, self.spread, self.state, self.lines, self.origin, self.cell_m, points_level, pose
        )

    def _cover(self, points: Array) -> None:
        """Grow the grid so that the points lie within."""
        grown = growth(self.state.shape, self.origin, self.cell_m, points)
        if grown is None:
            return
        old = self.sums, self.spread
        self._allocate(*grown.shape)
        self.sums[grown.held], self.spread[grown.held] = old
        self.origin = grown.origin
