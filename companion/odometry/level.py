"""A scan freed of the vehicle's tilt and of its motion during the turn."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.config import LidarConfig
from companion.geometry import matrix_from_quat, quat_from_rpy
from companion.messages import Array, LevelledScan, LidarScan
from companion.odometry.attitude import AttitudeHistory
from companion.odometry.jit import kernel


class AllReturns(NamedTuple):
    """Every return, also the too near and the too far ones: points_level (N, 3), range_m, row, column (N,)."""

    points_level: Array
    range_m: Array
    row: NDArray[np.int64]
    column: NDArray[np.int64]


@kernel
def _level_columns(
    range_m: NDArray[np.float32],
    column_valid: NDArray[np.bool_],
    directions: Array,
    offsets: Array,
    r_body_lidar: Array,
    t_body_lidar: Array,
    motion: Array,
) -> tuple[Array, Array, NDArray[np.int64], NDArray[np.int64]]:
    """motion: (columns, 6) roll, pitch, yaw relative to the end, and place relative to the end, level frame."""
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
        motion = column_motion(scan, history, velocity_level_mps, tilt_offset_rad)
        g = scan.geometry
        points, ranges, row, column = _level_columns(
            scan.range_m, scan.column_valid, g.directions, g.offsets_m, self.r_body_lidar, self.t_body_lidar, motion
        )
        every = AllReturns(points, ranges, row, column)
        good = (ranges >= self.min_range_m) & (ranges <= self.max_range_m)
        if not good.all():
            points, ranges, row, column = points[good], ranges[good], row[good], column[good]
        r_end = matrix_from_quat(quat_from_rpy(motion[-1, 0], motion[-1, 1], 0.0))
        levelled = LevelledScan(
            t_ns=scan.t_ns,
            points_level=points,
            range_m=ranges,
            row=row,
            column=column,
            origin_level_m=r_end @ self.t_body_lidar,
        )
        return levelled, every


def column_motion(
    scan: LidarScan, history: AttitudeHistory, velocity_level_mps: Array, tilt_offset_rad: tuple[float, float]
) -> Array:
    """(columns, 6): roll, pitch, yaw and place of the body at each column, relative to its place at the scan's end."""
    t = scan.t_column_ns
    end = history.at(np.array([scan.t_ns], np.int64))[0]
    attitude = history.at(t)
    motion = np.empty((len(t), 6))
    motion[:, 0] = attitude[:, 0] + tilt_offset_rad[0]
    motion[:, 1] = attitude[:, 1] + tilt_offset_rad[1]
    motion[:, 2] = attitude[:, 2] - end[2]
    dt_s = np.clip((t - scan.t_ns) * 1e-9, -1.0, 1.0)
    motion[:, 3:] = dt_s[:, None] * velocity_level_mps[None, :]
    return motion


def range_noise_m(range_m: NDArray[np.float32]) -> float:
    """Standard deviation of one return, from neighbours in a layer, (columns,), 0: no return. NaN: too few of them.

    Second differences leave out what a surface does that is straight over three columns; their median leaves out edges.
    """
    before, middle, after = range_m[:-2], range_m[1:-1], range_m[2:]
    whole = (before > 0.0) & (middle > 0.0) & (after > 0.0)
    bends = np.abs(before[whole] - 2.0 * middle[whole] + after[whole])
    return float(np.median(bends)) / (0.6745 * math.sqrt(6.0)) if len(bends) >= MIN_BENDS else math.nan


MIN_BENDS = 50
BLOCK_RAD = math.radians(2.9)  # neighbours of a layer that are averaged: 4 of 512 columns
BLOCK_SPAN_M = 0.6  # of range, about the block's median, beyond which a return is not the same surface
SECTORS = 8  # of a turn: what is too near is told by a layer's median over one, not by the noise of a block


def block_means(levelled: LevelledScan, above_row: int, columns: int, min_range_m: float) -> Array:
    """Means over blocks of neighbouring returns in each layer below `above_row`: (N, 4) place in the levelled frame, and
    how many returns each is the mean of.

    A lone return errs along its beam: its place and its height err together, and planes fitted to such points lean
    along the beams. Averaging takes most of that away. Where a layer's returns lie about min_range_m, taking those that
    read longer would lower the ground by millimetres: so a block counts by the median of its whole sector.
    """
    size = max(1, round(columns * BLOCK_RAD / (2 * math.pi)))
    is_far_enough = _sector_medians(levelled.range_m, levelled.row, levelled.column, columns) >= min_range_m
    return _block_means(
        levelled.points_level, levelled.range_m, levelled.row, levelled.column, above_row, size, is_far_enough, columns
    )


@kernel
def _sector_medians(range_m: Array, row: NDArray[np.int64], column: NDArray[np.int64], columns: int) -> Array:
    """(rows, SECTORS) median range of each layer's returns in each sector of the turn; 0 where there are none."""
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
def _block_means(
    points: Array,
    range_m: Array,
    row: NDArray[np.int64],
    column: NDArray[np.int64],
    above_row: int,
    size: int,
    is_far_enough: NDArray[np.bool_],
    columns: int,
) -> Array:
    """is_far_enough: (rows, SECTORS)."""
    out = np.empty((len(range_m), 4))
    rows = 0
    for i in range(len(range_m)):
        rows = max(rows, row[i] + 1)
    members = np.empty((rows, size), np.int64)
    count = np.zeros(rows, np.int64)
    block = np.full(rows, -1, np.int64)
    n = 0
    for i in range(len(range_m) + 1):  # points come column by column; one more turn closes the last blocks
        for k in range(rows):
            done = i == len(range_m) or (k == row[i] and column[i] // size != block[k])
            if not done or count[k] == 0:
                continue
            near = members[k, : count[k]]
            middle = np.median(range_m[near])
            used = 0
            out[n] = 0.0
            for j in near:
                if abs(range_m[j] - middle) <= BLOCK_SPAN_M:
                    for axis in range(3):
                        out[n, axis] += points[j, axis]
                    used += 1
            sector = min(block[k] * size * SECTORS // columns, SECTORS - 1)
            if 2 * used >= size and is_far_enough[k, sector]:
                out[n] /= used
                out[n, 3] = used
                n += 1
            count[k] = 0
        if i < len(range_m) and row[i] > above_row:
            k = row[i]
            block[k] = column[i] // size
            members[k, count[k]] = i
            count[k] += 1
    return out[:n].copy()
