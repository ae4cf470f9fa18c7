"""The paper's own pipeline, as it is printed, beside ours: algorithm 1, eq. 1 to 3 (signs and indices: docs/paper.md).

It sees keyframe scans only, their horizontal layer only, and takes roll = pitch = 0 and z = h. Its map frame is pinned
to the pose given with its first scan, as ours is pinned where odometry began; nothing is aligned afterwards.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.config import CompanionConfig
from companion.geometry import matrix_from_quat, quat_from_rpy, rotation2
from companion.jit import kernel
from companion.messages import Array, LidarScan


@dataclass(frozen=True, slots=True)
class PaperRegistration:
    """R, t of q = R p + t from the current scan to the previous one; E of eq. 1; iterations used."""

    rotation: Array
    translation: Array
    error: float
    iterations: int


@kernel
def _nearest(points_ref: Array, points: Array, index: NDArray[np.int64]) -> None:
    """For each reference point the index of the closest new point, by exhaustive search."""
    for i in range(points_ref.shape[0]):
        best, at = math.inf, 0
        for j in range(points.shape[0]):
            dx, dy = points_ref[i, 0] - points[j, 0], points_ref[i, 1] - points[j, 1]
            d = dx * dx + dy * dy
            if d < best:
                best, at = d, j
        index[i] = at


def register_paper(
    points_previous: Array,
    points_current: Array,
    range_current_m: Array,
    *,
    threshold: float = 2.0,
    max_iterations: int = 50,
    min_range_m: float = 0.5,
    max_range_m: float = 50.0,
) -> PaperRegistration:
    """Algorithm 1: weighted point-to-point ICP between two horizontal layers, from identity.

    Args:
        points_previous (N, 2), points_current (M, 2): metres, each in its own scan's frame; finite.
        range_current_m: (M,) range of each current point: weight 1 at min_range_m, 0 at max_range_m, linear.

    Source: the paper, section 2.1, eq. 1 and algorithm 1.
    """
    rotation, translation = np.eye(2), np.zeros(2)
    if len(points_previous) == 0 or len(points_current) == 0:
        return PaperRegistration(rotation, translation, math.inf, 0)
    weight_all = np.clip((max_range_m - range_current_m) / (max_range_m - min_range_m), 0.0, 1.0)
    moved = points_current.copy()
    nearest = np.empty(len(points_previous), np.int64)
    error, iterations = math.inf, 0
    while error > threshold and iterations < max_iterations:
        iterations += 1
        _nearest(points_previous, moved, nearest)  # for every q in the previous scan, the closest p in the current one
        p, w = moved[nearest], weight_all[nearest]
        total = float(w.sum())
        if total <= 0.0:
            break
        mean_q, mean_p = w @ points_previous / total, w @ p / total
        k = (points_previous - mean_q).T @ ((p - mean_p) * w[:, None])  # cross-covariance
        u, _, vt = np.linalg.svd(k)
        r_new = u @ np.diag([1.0, math.copysign(1.0, np.linalg.det(u @ vt))]) @ vt
        t_new = mean_q - r_new @ mean_p
        rotation, translation = r_new @ rotation, r_new @ translation + t_new
        moved = moved @ r_new.T + t_new
        difference = points_previous - moved[nearest]
        error = float(w @ (difference**2).sum(axis=1))  # eq. 1, with R p + t
    return PaperRegistration(rotation, translation, error, iterations)


class PaperPipeline:
    """Feeds on keyframe scans; keeps poses (x, y, yaw in map), 3D map and c_c, the total of iterations."""

    def __init__(self, cfg: CompanionConfig) -> None:
        self._cfg = cfg
        roll, pitch, yaw = (math.radians(v) for v in cfg.lidar.mount_rpy_deg)
        self._r_body_lidar = matrix_from_quat(quat_from_rpy(roll, pitch, yaw))
        self._t_body_lidar = np.array(cfg.lidar.mount_position_m)
        self._previous: Array | None = None
        self._clouds: list[Array] = []
        self._rotation, self._translation, self._yaw = np.eye(2), np.zeros(2), 0.0
        self.t_ns: list[int] = []
        self.poses: list[tuple[float, float, float, float]] = []  # x, y, z = h, yaw of the body in map
        self.c_c = 0

    def on_keyframe_scan(
        self,
        scan: LidarScan,
        start_pose_map: tuple[float, float, float] = (0.0, 0.0, 0.0),
        height_m: float | None = None,
    ) -> PaperRegistration | None:
        """Register a keyframe's raw scan to the one before it and append it to the map.

        Args:
            start_pose_map: x, y, yaw to which the first scan pins the map; not looked at afterwards.
            height_m: h of this scan; None: the mission's height. The paper knows one constant height.

        Returns: None for the first scan.
        """
        cloud, layer, layer_range = self._points(scan)
        registration = None
        if self._previous is None:
            self._rotation, self._translation = rotation2(start_pose_map[2]), np.array(start_pose_map[:2], float)
            self._yaw = start_pose_map[2]
        else:
            registration = register_paper(
                self._previous,
                layer,
                layer_range,
                threshold=self._cfg.odometry.paper_threshold,
                max_iterations=self._cfg.odometry.paper_max_iterations,
                min_range_m=self._cfg.lidar.min_range_m,
                max_range_m=self._cfg.lidar.max_range_m,
            )
            self.c_c += registration.iterations
            # eq. 2 and 3: the chain R1 (R2 (... + t2)) + t1 appends on the right
            self._translation = self._rotation @ registration.translation + self._translation
            self._rotation = self._rotation @ registration.rotation
            self._yaw += math.atan2(registration.rotation[1, 0], registration.rotation[0, 0])
        self._previous = layer
        h = self._cfg.navigator.height_m if height_m is None else height_m
        self.t_ns.append(scan.t_ns)
        self.poses.append((float(self._translation[0]), float(self._translation[1]), h, self._yaw))
        placed = cloud.copy()
        placed[:, :2] = cloud[:, :2] @ self._rotation.T + self._translation
        placed[:, 2] += h
        self._clouds.append(placed)
        return registration

    @property
    def map_points(self) -> Array:
        """(N, 3), eq. 3: every keyframe's points in map."""
        return np.concatenate(self._clouds) if self._clouds else np.zeros((0, 3))

    def _points(self, scan: LidarScan) -> tuple[Array, Array, Array]:
        """All points (N, 3) and the horizontal layer (M, 2) with its ranges, in body, as if it flew level."""
        g = scan.geometry
        ranges = scan.range_m.astype(np.float64)
        good = np.isfinite(ranges) & (ranges >= self._cfg.lidar.min_range_m) & (ranges <= self._cfg.lidar.max_range_m)
        good &= scan.column_valid[None, :]
        safe = np.where(good, ranges, 0.0)
        points = (g.directions * safe[..., None] + g.offsets_m) @ self._r_body_lidar.T + self._t_body_lidar
        row = g.horizontal_row
        return points[good], points[row][good[row]][:, :2], ranges[row][good[row]]
