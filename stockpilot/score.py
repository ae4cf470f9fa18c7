"""Scores against truth. The only place where what was flown meets what was there; nothing that flies reads it.

The map frame is pinned to the true pose where odometry began; nothing is aligned afterwards.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.geometry import rotation2, wrap_angle
from companion.messages import Array


@dataclass(frozen=True, slots=True, kw_only=True)
class TruthLog:
    """What the vehicle really did, in the world frame.

    t_ns: (N,) int64, ascending, companion clock. position_world_m: (N, 3). yaw_rad: (N,), unwrapped.
    is_following: (N,) bool, the navigator was following the wall on a straight stretch.
    """

    t_ns: NDArray[np.int64]
    position_world_m: Array
    yaw_rad: Array
    is_following: NDArray[np.bool_]

    def pose_at(self, t_ns: NDArray[np.int64]) -> tuple[Array, Array]:
        """Positions (M, 3) and yaws (M,) at those times, linear between samples."""
        t = (self.t_ns - self.t_ns[0]).astype(np.float64)
        wanted = (np.asarray(t_ns, dtype=np.int64) - self.t_ns[0]).astype(np.float64)
        position = np.column_stack([np.interp(wanted, t, self.position_world_m[:, n]) for n in range(3)])
        return position, np.interp(wanted, t, self.yaw_rad)


@dataclass(frozen=True, slots=True, kw_only=True)
class MapPin:
    """Where the map frame lies in the world: position (3,) and yaw of its origin."""

    position_world_m: Array
    yaw_rad: float

    def to_world(self, points_map: Array) -> Array:
        """(N, 3) points of the map frame in the world frame."""
        out = np.array(points_map, dtype=np.float64, copy=True)
        out[:, :2] = points_map[:, :2] @ rotation2(self.yaw_rad).T
        return out + self.position_world_m

    def to_map(self, points_world: Array) -> Array:
        """(N, 3) points of the world frame in the map frame."""
        out = np.asarray(points_world, dtype=np.float64) - self.position_world_m
        out[:, :2] = out[:, :2] @ rotation2(self.yaw_rad)
        return out


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseScore:
    """Errors of a chain of poses: RMS of position in 3D, horizontally, vertically (m), RMS of yaw (deg)."""

    e_p_m: float
    e_p_xy_m: float
    e_z_m: float
    e_yaw_deg: float


def pin_map(truth: TruthLog, t_began_ns: int) -> MapPin:
    position, yaw = truth.pose_at(np.array([t_began_ns]))
    return MapPin(position_world_m=position[0], yaw_rad=float(yaw[0]))


def score_poses(
    truth: TruthLog, pin: MapPin, t_ns: NDArray[np.int64], position_map_m: Array, yaw_map_rad: Array
) -> PoseScore:
    """RMS errors of poses (N, 3), (N,) in the pinned map frame against truth at the same times."""
    if len(t_ns) == 0:
        return PoseScore(e_p_m=math.nan, e_p_xy_m=math.nan, e_z_m=math.nan, e_yaw_deg=math.nan)
    position, yaw = truth.pose_at(t_ns)
    error = pin.to_world(position_map_m) - position
    yaw_error = np.array([wrap_angle(float(a)) for a in yaw_map_rad + pin.yaw_rad - yaw])
    return PoseScore(
        e_p_m=float(np.sqrt(np.mean(np.sum(error**2, axis=1)))),
        e_p_xy_m=float(np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1)))),
        e_z_m=float(np.sqrt(np.mean(error[:, 2] ** 2))),
        e_yaw_deg=float(np.degrees(np.sqrt(np.mean(yaw_error**2)))),
    )


def cast_plan(origin_xy: Array, bearing_rad: Array, outline: list[Array]) -> tuple[Array, Array]:
    """Distances and normals where rays meet the plan's outlines.

    Args: origin_xy: (2,). bearing_rad: (M,) world bearings. outline: closed rings, (K, 2) each.
    Returns: (M,) distances, inf where nothing is met; (M, 2) unit normals of the edges met (0 where none).
    """
    a = np.concatenate(outline)
    b = np.concatenate([np.roll(ring, -1, axis=0) for ring in outline])
    d = np.column_stack([np.cos(bearing_rad), np.sin(bearing_rad)])
    edge = b - a
    to_a = a - origin_xy
    denominator = d[:, None, 0] * edge[None, :, 1] - d[:, None, 1] * edge[None, :, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (to_a[None, :, 0] * edge[None, :, 1] - to_a[None, :, 1] * edge[None, :, 0]) / denominator
        share = (to_a[None, :, 0] * d[:, None, 1] - to_a[None, :, 1] * d[:, None, 0]) / denominator
    met = (np.abs(denominator) > 1e-12) & (along > 0) & (share >= 0) & (share <= 1)
    along = np.where(met, along, np.inf)
    nearest = np.argmin(along, axis=1)
    distance = along[np.arange(len(d)), nearest]
    normal = np.column_stack([edge[nearest, 1], -edge[nearest, 0]])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.where(np.isfinite(distance)[:, None], normal / np.where(length > 0, length, 1), 0.0)
    return distance, normal


def wall_distance_rms_m(truth: TruthLog, outline: list[Array], wall_distance_m: float) -> float | None:
    """RMS of d_r - D on straight stretches, from true poses and the true walls; None if nothing was followed."""
    chosen = np.flatnonzero(truth.is_following)[::5]
    errors = []
    for n in chosen:
        distance, normal = cast_plan(truth.position_world_m[n, :2], np.array([truth.yaw_rad[n] - math.pi / 2]), outline)
        if np.isfinite(distance[0]):
            bearing = truth.yaw_rad[n] - math.pi / 2
            incidence = abs(normal[0] @ np.array([math.cos(bearing), math.sin(bearing)]))
            errors.append(distance[0] * incidence - wall_distance_m)
    return float(np.sqrt(np.mean(np.square(errors)))) if errors else None


def cramer_rao_bound_m(
    truth: TruthLog,
    t_ns: NDArray[np.int64],
    outline: list[Array],
    *,
    noise_m: float,
    max_range_m: float,
    columns: int = 512,
) -> float | None:
    """RMS over poses of the smallest position error that one horizontal scan against a perfect map allows, m.

    Source: Censi, "On achievable accuracy for range-finder localization", ICRA 2007: I = 1/s^2 sum of g g^T with
    g = (n / cos(incidence), (p x n) / cos(incidence)) for a range measured along the beam.
    """
    if noise_m <= 0 or len(t_ns) == 0:
        return None
    position, yaw = truth.pose_at(t_ns)
    turn = np.linspace(0, 2 * np.pi, columns, endpoint=False)
    variances = []
    for p, psi in zip(position, yaw, strict=True):
        bearing = turn + psi
        distance, normal = cast_plan(p[:2], bearing, outline)
        d = np.column_stack([np.cos(bearing), np.sin(bearing)])
        cosine = np.sum(normal * d, axis=1)
        used = (distance < max_range_m) & (np.abs(cosine) > 0.05)
        g = normal[used] / cosine[used, None]
        hit = d[used] * distance[used, None]
        rows = np.column_stack([g, hit[:, 0] * g[:, 1] - hit[:, 1] * g[:, 0]])
        information = rows.T @ rows / noise_m**2
        if np.linalg.eigvalsh(information)[0] > 1e-9:
            covariance = np.linalg.inv(information)
            variances.append(covariance[0, 0] + covariance[1, 1])
    return float(np.sqrt(np.mean(variances))) if variances else None
