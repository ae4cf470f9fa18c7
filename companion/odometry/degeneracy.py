"""Whether a registration can be believed, and in which directions the walls hold it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.messages import Array
from companion.odometry.wall_map import Registration

MIN_EIGENVALUE_RATIO = 0.02  # of the translation's information; a hall has about 0.2, a corridor 0.004 (measured)
MIN_INLIERS = 40
MIN_INLIER_RATIO = 0.3  # of the layer's points; a door that opens on a new hall leaves that many
MAX_SCALE = 2.8
MAX_NIS = 30.0  # squared Mahalanobis distance of 3 degrees of freedom: one in 10^6 by chance
ALWAYS_ALLOWED = np.array([0.05, 0.05, 0.008])  # m, m, rad


@dataclass(frozen=True, slots=True)
class Judgement:
    """Why a registration was refused ("" when it was accepted), and where it is weak.

    weak_ratio: smaller eigenvalue of the translation's information over their sum, 0.5 at best; weak_axis: (2,) its
    direction in map.
    """

    refused_because: str
    is_degenerate: bool
    is_yaw_weak: bool
    weak_ratio: float
    weak_axis: Array

    @property
    def is_accepted(self) -> bool:
        return self.refused_because == ""


def judge(registration: Registration, guess: Array, guess_covariance: Array, points: int) -> Judgement:
    """guess: (3,) predicted x, y, yaw with covariance (3, 3); points: size of the layer."""
    ratio, axis = weak_direction(registration.information)
    yaw_weak = is_yaw_weak(registration.information)
    because = _refusal(registration, guess, guess_covariance, points)
    return Judgement(because, ratio < MIN_EIGENVALUE_RATIO, yaw_weak, ratio, axis)


def weak_direction(information: Array) -> tuple[float, Array]:
    """Smaller eigenvalue over the sum, and its direction, of the translation's information."""
    values, vectors = np.linalg.eigh(information[:2, :2])
    total = float(values.sum())
    if total <= 0.0:
        return 0.0, np.array([1.0, 0.0])
    return max(float(values[0]), 0.0) / total, np.asarray(vectors[:, 0])


def is_yaw_weak(information: Array) -> bool:
    """True when the walls alone leave yaw to more than 1 deg (round silo: turning changes nothing)."""
    translation = information[:2, :2] + 1e-6 * np.eye(2)
    left = information[2, 2] - information[2, :2] @ np.linalg.solve(translation, information[:2, 2])
    return bool(left < 1.0 / np.radians(1.0) ** 2)


def _refusal(registration: Registration, guess: Array, guess_covariance: Array, points: int) -> str:
    if registration.inliers < min(MIN_INLIERS, max(points, 12)) or registration.inliers < MIN_INLIER_RATIO * points:
        return "too few inliers"
    if registration.scale > MAX_SCALE:
        return "residuals too large"
    if not np.isfinite(registration.pose).all():
        return "not finite"
    jump = registration.pose - guess
    if (np.abs(jump) <= ALWAYS_ALLOWED).all():
        return ""
    noise = np.linalg.inv(registration.information + np.diag([1.0, 1.0, 10.0])) + np.diag(ALWAYS_ALLOWED**2) / 9.0
    nis = float(jump @ np.linalg.solve(guess_covariance + noise, jump))
    return "" if nis <= MAX_NIS else "jump against the prediction"
