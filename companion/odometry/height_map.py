"""Height above the floor of the start, and the tilt that the attitude errs by, from the lower layers.

The lower layers are matched to a 2.5D map of the ground, built while flying; where they hit walls, those tell tilt,
since walls are vertical. Tilt and height are found together: a tilt of 0.3 deg would else pass for centimetres of
height.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.messages import Array
from companion.odometry import height_kernels as hk
from companion.odometry.grid_growth import growth
from companion.odometry.wall_map import WallMap

MAX_POINTS = 3072  # of a scan; more are thinned evenly
BEND_SIGMA_RAD = 0.0017  # slope that the ground's map may have gained while it was built


@dataclass(frozen=True, slots=True)
class HeightFit:
    """Errors of the guess: z, roll, pitch, and of what the walls lean by. information: (5, 5), of z by the ground, of tilt
    and lean by the walls. wall_variance: of the tilt by these walls, were their points independent; shared_ratio: how many
    times that their bumps add."""

    correction: Array
    information: Array
    ground_points: int
    wall_points: int
    scale: float
    map_variance: float
    wall_variance: float
    shared_ratio: float
    new_ground: Array  # (N, 4) levelled block means to be put into the map when the scan is accepted


@dataclass(frozen=True, slots=True)
class PlaneAbout:
    """Plane through the means of cells about a place: its height there, how far the cells are off it, how many."""

    z_m: float
    rms_m: float
    cells: int


class HeightMap:
    """Ground height in a grid of moments; window 3 x 3 cells."""

    def __init__(self, cell_m: float = 0.5) -> None:
        self.cell_m = cell_m
        self.origin = np.zeros(2)
        self._allocate(0, 0)

    def _allocate(self, ny: int, nx: int) -> None:
        self.sums = np.zeros((ny, nx, hk.SUMS))
        self.state = np.zeros((ny, nx), np.uint8)
        self.planes = np.zeros((ny, nx, hk.PLANE))

    def fit(
        self,
        points_level: Array,
        pose: Array,
        z_m: float,
        walls: WallMap,
        *,
        sigma_range_m: float,
        gate_m: float,
        seen_spread_m: float,
        lean: Array,
        tilt_information: Array,
        shift_information: Array,
    ) -> HeightFit:
        """Match (N, 3) levelled points of the lower layers at pose (x, y, yaw) and height z_m.

        gate_m: how far a point may be off the known ground. seen_spread_m: range of heights flown through so far.
        lean: (2,) rad about map x and y, of the walls. tilt_information, shift_information: (4, 4) of roll, pitch and
        lean, (2, 2) of x and y, as they were used.
        """
        points_level, standing, kind, place = self._told_apart(points_level, pose, z_m, walls, gate_m, seen_spread_m)
        correction, information, out = hk.fit_height(
            self.planes,
            standing,
            points_level,
            pose,
            z_m,
            kind,
            place,
            sigma_range_m,
            lean,
            tilt_information,
            shift_information,
            BEND_SIGMA_RAD**2,
            4,
        )
        return HeightFit(
            correction=correction,
            information=information,
            ground_points=int(out[0]),
            wall_points=int(out[1]),
            scale=float(out[2]),
            map_variance=float(out[3]),
            wall_variance=float(out[4]),
            shared_ratio=float(out[5]),
            new_ground=points_level[kind == hk.GROUND],
        )

    def shift_along(
        self,
        points_level: Array,
        pose: Array,
        z_m: float,
        walls: WallMap,
        axis: Array,
        *,
        tilt: Array,
        variances: Array,
        sigma_range_m: float,
        gate_m: float,
        seen_spread_m: float,
    ) -> tuple[float, float]:
        """How far the body is off along axis, (2,) in map, m, by the slopes of the ground; and the information about it, 1/m2.

        tilt: (2,) roll and pitch that the points are still off by. variances: (3,) of z, roll, pitch. The rest as of `fit`.
        """
        points, _, kind, place = self._told_apart(points_level, pose, z_m, walls, gate_m, seen_spread_m)
        return hk.shift_along(self.planes, points, pose, z_m, tilt, axis, kind, place, sigma_range_m, variances, 4)

    def _told_apart(
        self, points_level: Array, pose: Array, z_m: float, walls: WallMap, gate_m: float, seen_spread_m: float
    ) -> tuple[Array, Array, NDArray[np.int64], NDArray[np.int64]]:
        """The points that are used, the walls at them, what each is and on which plane: see height_kernels.classify."""
        if len(points_level) > MAX_POINTS:
            points_level = points_level[:: -(-len(points_level) // MAX_POINTS)]
        n = len(points_level)
        kind: NDArray[np.int64] = np.zeros(n, np.int64)
        place: NDArray[np.int64] = np.zeros(n, np.int64)
        min_spread = min(0.6, 0.5 * seen_spread_m)
        standing = walls.lines_at(points_level, pose)
        hk.classify(
            self.sums,
            self.state,
            self.planes,
            self.origin,
            self.cell_m,
            standing,
            points_level,
            pose,
            z_m,
            gate_m,
            min_spread,
            kind,
            place,
        )
        return points_level, standing, kind, place

    def height_at(self, x_m: float, y_m: float) -> tuple[float, float] | None:
        """Ground height and its variance at a place, or None where it is not known."""
        ny, nx = self.state.shape
        ix, iy = (
            int(np.floor((x_m - self.origin[0]) / self.cell_m)),
            int(np.floor((y_m - self.origin[1]) / self.cell_m)),
        )
        if not (0 <= ix < nx and 0 <= iy < ny):
            return None
        if self.state[iy, ix] == hk.DIRTY:
            hk.fit_plane(self.sums, self.state, self.planes, iy, ix)
        if self.state[iy, ix] != hk.VALID:
            return None
        p = self.planes[iy, ix]
        dx, dy = x_m - p[hk.CX], y_m - p[hk.CY]
        z = p[hk.A] + p[hk.BX] * dx + p[hk.BY] * dy
        slope = dx * dx * p[hk.SXX] + 2 * dx * dy * p[hk.SXY] + dy * dy * p[hk.SYY]
        return float(z), float(p[hk.ABOUT] / p[hk.WEIGHT] + slope)

    def plane_about(self, x_m: float, y_m: float, radius_m: float) -> PlaneAbout | None:
        """Weighted least squares through the cells within radius_m; None where they do not surround the place."""
        iy, ix = np.nonzero(self.sums[..., hk.W] >= hk.MIN_WEIGHT)
        cells = self.sums[iy, ix]
        weight = cells[:, hk.W]
        x, y, z = cells[:, hk.X] / weight - x_m, cells[:, hk.Y] / weight - y_m, cells[:, hk.Z] / weight
        near = np.hypot(x, y) <= radius_m
        x, y, z, weight = x[near], y[near], z[near], weight[near]
        quadrants = np.unique((x > 0.0).astype(np.int64) + 2 * (y > 0.0))
        if len(quadrants) < 4:
            return None
        root = np.sqrt(weight)
        design = np.column_stack([np.ones_like(x), x, y])
        plane = np.linalg.lstsq(design * root[:, None], z * root, rcond=None)[0]
        off = z - design @ plane
        rms = float(np.sqrt(np.sum(weight * off**2) / np.sum(weight)))
        return PlaneAbout(z_m=float(plane[0]), rms_m=rms, cells=len(x))

    def insert(self, sight: Array, origin: Array, sensor: Array, sigma_range_m: float, variance_z: float) -> None:
        """Add ground points: sight (N, 4) from the body to them and of how many returns each is the mean, origin (3,) the
        body's place, sensor (3,) from there to where the beams come from; axes of `map`. sigma_range_m: of one return."""
        if len(sight) == 0:
            return
        self._cover(sight[:, :2] + origin[:2])
        hk.insert_heights(
            self.sums, self.state, self.origin, self.cell_m, sight, origin, sensor, sigma_range_m**2, variance_z
        )

    def _cover(self, points: Array) -> None:
        grown = growth(self.state.shape, self.origin, self.cell_m, points)
        if grown is None:
            return
        old = self.sums
        self._allocate(*grown.shape)
        self.sums[grown.held] = old
        self.origin = grown.origin
