"""Scans and poses -> PointMap: points by keyframe, without dust, within bounded memory (eq. 3 of the paper)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from companion.config import CompanionConfig
from companion.geometry import matrix_from_quat, yaw_from_quat
from companion.mapping.outliers import is_solid
from companion.messages import Array, LevelledScan, OdometryEstimate, PointMap

Scalar = TypeVar("Scalar", bound=np.generic)
MAX_POINTS = 3_000_000  # about 60 MB; a lap of the cement store at 0.43 m/s is 1.9 million
MAX_JUMP_SIGMA_M = 1.0  # a pose less certain than this paints nothing


@dataclass(slots=True)
class _Keyframe:
    """Its own pose, and what was seen while it was current: points relative to it, so that a correction moves all."""

    position_map_m: Array
    q_map_body_wxyz: Array
    points: list[NDArray[np.float32]]
    range_m: list[NDArray[np.float32]]
    path: list[Array]
    seen_from: list[NDArray[np.int32]]  # places in path

    @property
    def size(self) -> int:
        return sum(len(p) for p in self.points)


class Mapper:
    """Collects the map. `add` never raises for a poor scan or a poor pose: it counts what it left out."""

    def __init__(self, cfg: CompanionConfig, *, max_points: int = MAX_POINTS) -> None:
        self._min_range_m = cfg.lidar.min_range_m
        self._max_range_m = min(cfg.mapping.max_range_m, cfg.lidar.max_range_m)
        self._keyframes: dict[int, _Keyframe] = {}
        self._max_points = max_points
        self._one_of = 1
        self._size = 0
        self._variances: list[tuple[float, float]] = []
        self.scans_added = 0
        self.scans_refused = 0
        self.points_dropped_as_dust = 0
        self.points_thinned = 0

    @property
    def size(self) -> int:
        """How many points the map holds."""
        return self._size

    def add(self, levelled: LevelledScan, estimate: OdometryEstimate) -> bool:
        """Put one scan into the map; False where its pose is not fit to paint with, or nothing solid is in it."""
        if not _is_fit(estimate):
            self.scans_refused += 1
            return False
        finite = np.isfinite(levelled.points_level).all(axis=1) & np.isfinite(levelled.range_m)
        in_range = finite & (levelled.range_m >= self._min_range_m) & (levelled.range_m <= self._max_range_m)
        solid = is_solid(levelled, finite)
        self.points_dropped_as_dust += int((in_range & ~solid).sum())
        keep = np.flatnonzero(in_range & solid)[self.scans_added % self._one_of :: self._one_of]
        if len(keep) == 0:
            self.scans_refused += 1
            return False
        keyframe = self._keyframe(estimate)
        yaw = yaw_from_quat(estimate.q_map_body_wxyz)
        points_map = levelled.points_level[keep] @ _about_z(yaw).T + estimate.position_map_m
        to_keyframe = matrix_from_quat(keyframe.q_map_body_wxyz)  # rows of points times R is R transposed times columns
        keyframe.points.append(((points_map - keyframe.position_map_m) @ to_keyframe).astype(np.float32))
        keyframe.range_m.append(levelled.range_m[keep].astype(np.float32))
        keyframe.seen_from.append(np.full(len(keep), len(keyframe.path), np.int32))
        keyframe.path.append((estimate.position_map_m - keyframe.position_map_m) @ to_keyframe)
        self._variances.append(
            (
                0.5 * float(estimate.pose_covariance[0, 0] + estimate.pose_covariance[1, 1]),
                float(estimate.pose_covariance[2, 2]),
            )
        )
        self._size += len(keep)
        self.scans_added += 1
        if self._size > self._max_points:
            self._thin()
        return True

    def correct(self, keyframe_id: int, position_map_m: Array, q_map_body_wxyz: Array) -> None:
        """Move a keyframe, and all that was seen from it, to a better pose (loop closure). Unknown ids are ignored."""
        keyframe = self._keyframes.get(keyframe_id)
        if keyframe is not None:
            keyframe.position_map_m = np.array(position_map_m, dtype=np.float64)
            keyframe.q_map_body_wxyz = np.array(q_map_body_wxyz, dtype=np.float64)

    def point_map(self) -> PointMap:
        """The map as it now stands, with the typical 1 sigma of the poses that placed it."""
        points, ids, ranges, path = [np.zeros((0, 3))], [np.zeros(0, dtype=np.int64)], [np.zeros(0)], [np.zeros((0, 3))]
        seen_from, scans = [np.zeros(0, dtype=np.int64)], 0
        for keyframe_id, keyframe in sorted(self._keyframes.items()):
            rotation = matrix_from_quat(keyframe.q_map_body_wxyz)
            for chunk in keyframe.points:
                points.append(chunk.astype(np.float64) @ rotation.T + keyframe.position_map_m)
                ids.append(np.full(len(chunk), keyframe_id, dtype=np.int64))
            ranges += [r.astype(np.float64) for r in keyframe.range_m]
            seen_from += [scans + s.astype(np.int64) for s in keyframe.seen_from]
            scans += len(keyframe.path)
            path.append(np.array(keyframe.path) @ rotation.T + keyframe.position_map_m)
        variances = np.array(self._variances) if self._variances else np.zeros((1, 2))
        sigma = np.sqrt(np.median(variances, axis=0))
        return PointMap(
            points_map=np.concatenate(points),
            keyframe_id=np.concatenate(ids),
            range_m=np.concatenate(ranges),
            path_map=np.concatenate(path),
            position_sigma_m=float(sigma[0]),
            height_sigma_m=float(sigma[1]),
            scan_index=np.concatenate(seen_from),
        )

    def _keyframe(self, estimate: OdometryEstimate) -> _Keyframe:
        keyframe = self._keyframes.get(estimate.keyframe_id)
        if keyframe is None:
            keyframe = _Keyframe(estimate.position_map_m.copy(), estimate.q_map_body_wxyz.copy(), [], [], [], [])
            self._keyframes[estimate.keyframe_id] = keyframe
        return keyframe

    def _thin(self) -> None:
        """Keep one of two returns of each scan, from now on too: chosen by their order alone, so that nothing that is seen
        weighs more than before (of voxels that hold one return each, most would be on the rim of the noise)."""
        before = self._size
        for keyframe in self._keyframes.values():
            keyframe.points = _halved(keyframe.points)
            keyframe.range_m = _halved(keyframe.range_m)
            keyframe.seen_from = _halved(keyframe.seen_from)
        self._size = sum(k.size for k in self._keyframes.values())
        self._one_of *= 2
        self.points_thinned += before - self._size


def _halved(scans: list[NDArray[Scalar]]) -> list[NDArray[Scalar]]:
    """One of two rows of each, the other one in every second; copied, so that the whole is let go of."""
    return [rows[k % 2 :: 2].copy() for k, rows in enumerate(scans)]


def _is_fit(estimate: OdometryEstimate) -> bool:
    """Whether the pose may paint: the map before a bad registration is never painted over by it."""
    finite = np.isfinite(estimate.position_map_m).all() and np.isfinite(estimate.q_map_body_wxyz).all()
    variance = float(estimate.pose_covariance[0, 0] + estimate.pose_covariance[1, 1])
    return bool(finite and estimate.converged and estimate.quality >= 0 and variance < 2 * MAX_JUMP_SIGMA_M**2)


def _about_z(yaw_rad: float) -> Array:
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
