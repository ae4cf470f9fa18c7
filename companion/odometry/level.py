"""A scan freed of the vehicle's tilt and of its motion during the turn."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.config import LidarConfig
from companion.geometry import matrix_from_quat, quat_from_rpy
from companion.messages import Array, LevelledScan, LidarGeometry, LidarScan
from companion.odometry import level_kernels as lk
from companion.odometry.attitude import AttitudeHistory
from companion.odometry.height_kernels import BLOCK_RAD

LOW_M = 1.5  # of height: until it has risen, nothing tells walls from the foot of a pile
LOW_SPACING_M = 0.2
NO_PILE_ABOVE_M = 6.0
BELOW_RAD = math.radians(
    11.0
)  # the layer that is asked whether a surface leans: reaches the floor at five times the height
NOISE_RATE = 0.05  # of a scan in what is known of the noise of returns
MIN_BENDS = 50  # of which the noise of returns is told


class AllReturns(NamedTuple):
    """Every return, also the too near and the too far ones: points_level (N, 3), range_m, row, column (N,)."""

    points_level: Array
    range_m: Array
    row: NDArray[np.int64]
    column: NDArray[np.int64]


class Leveller:
    """Holds the sensor's mount, and an estimate of how far the attitude is off (roll, pitch; both in body)."""

    def __init__(self, cfg: LidarConfig) -> None:
        self.min_range_m, self.max_range_m = cfg.min_range_m, cfg.max_range_m
        roll, pitch, yaw = (math.radians(v) for v in cfg.mount_rpy_deg)
        self.r_body_lidar = matrix_from_quat(quat_from_rpy(roll, pitch, yaw))
        self.t_body_lidar = np.array(cfg.mount_position_m, dtype=np.float64)

    def level(
        self,
        scan: LidarScan,
        history: AttitudeHistory,
        velocity_level_mps: Array,
        tilt_offset_rad: tuple[float, float] = (0.0, 0.0),
    ) -> tuple[LevelledScan, AllReturns]:
        """The scan in a z-up frame at the body at the scan's last column, with the body's heading then.

        Args:
            velocity_level_mps: (3,) own velocity in that frame: where the body was at each column.
            tilt_offset_rad: added to roll and pitch.
        """
        roll_offset, pitch_offset = tilt_offset_rad
        motion = lk.column_motion(
            scan.t_column_ns, scan.t_ns, history.t_ns, history.values, velocity_level_mps, roll_offset, pitch_offset
        )
        g = scan.geometry
        every = AllReturns(
            *lk.level_columns(
                scan.range_m, scan.column_valid, g.directions, g.offsets_m, self.r_body_lidar, self.t_body_lidar, motion
            )
        )
        points, ranges, row, column = lk.within_range(*every, self.min_range_m, self.max_range_m)
        r_end = matrix_from_quat(quat_from_rpy(float(motion[-1, 0]), float(motion[-1, 1]), 0.0))
        levelled = LevelledScan(
            t_ns=scan.t_ns,
            points_level=points,
            range_m=ranges,
            row=row,
            column=column,
            origin_level_m=r_end @ self.t_body_lidar,
        )
        return levelled, every


def wall_layer(
    levelled: LevelledScan, geometry: LidarGeometry, above_m: float, z_m: float, noise_m: float, *, is_climbing: bool
) -> Array:
    """(N, 2) x and y of the horizontal layer's returns that may be walls, in the levelled frame.

    Not those that lie no higher than above_m: floor. Below NO_PILE_ABOVE_M (z_m: height above where it stood) not those of a
    surface that leans back, by what the layers below see of it: a pile, whose line moves away as the vehicle climbs. Two are
    asked, and have to agree: a wall behind a pile is not one slope with it. Below LOW_M the second sees but the floor.

    Off the ground (is_climbing) and below LOW_M, where the first cannot tell yet either, one return counts for each
    LOW_SPACING_M of width: the foot of a pile close by fills half of the turn, and outvotes the walls.
    """
    spacing_m = LOW_SPACING_M if is_climbing and z_m < LOW_M else 0.0
    row = geometry.horizontal_row
    below, lowest = (_row_below(geometry.elevation_rad, row, n * BELOW_RAD) for n in (1, 2))
    is_asked = z_m < NO_PILE_ABOVE_M and math.isfinite(above_m)  # a floor that is not known yet would pass for a slope
    rows = (row, below, lowest) if is_asked else (row, -1, -1)
    return lk.upright_layer(
        levelled.points_level,
        levelled.row,
        levelled.column,
        rows,
        geometry.directions.shape[1],
        above_m,
        noise_m,
        spacing_m,
        z_m > LOW_M,
    )


def _row_below(elevation_rad: Array, row: int, angle_rad: float) -> int:
    """The layer whose elevation is nearest to so much under that row's; -1 where none is near it."""
    under = elevation_rad[row] - elevation_rad
    found = int(np.argmin(np.abs(under - angle_rad)))
    return found if abs(under[found] - angle_rad) < 0.5 * BELOW_RAD else -1


def range_noise_m(range_m: NDArray[np.float32]) -> float:
    """Standard deviation of one return, from neighbours in a layer, (columns,), 0: no return. NaN: too few of them.

    Second differences leave out what a surface does that is straight over three columns; their median leaves out edges.
    """
    bend, count = lk.median_bend(range_m)
    return bend / (0.6745 * math.sqrt(6.0)) if count >= MIN_BENDS else math.nan


class ReturnNoise:
    """Standard deviation of single returns, kept from scan to scan."""

    def __init__(self) -> None:
        self.sigma_m = 0.1
        self._is_known = False

    def see(self, range_m: NDArray[np.float32]) -> None:
        """Take in the ranges (columns,) of the horizontal layer."""
        now = range_noise_m(range_m)
        if math.isfinite(now):
            self.sigma_m += (NOISE_RATE if self._is_known else 1.0) * (now - self.sigma_m)
            self._is_known = True


def block_means(levelled: LevelledScan, above_row: int, columns: int, min_range_m: float) -> Array:
    """Means over blocks of neighbouring returns in each layer below `above_row`: (N, 4) place in the levelled frame, and
    how many returns each is the mean of.

    A lone return errs along its beam: its place and its height err together, and planes fitted to such points lean
    along the beams. Averaging takes most of that away. Where a layer's returns lie about min_range_m, taking those that
    read longer would lower the ground by millimetres: so a block counts by the median of its whole sector.
    """
    size = max(1, round(columns * BLOCK_RAD / (2 * math.pi)))
    return lk.block_means(
        levelled.points_level, levelled.range_m, levelled.row, levelled.column, above_row, size, min_range_m, columns
    )
