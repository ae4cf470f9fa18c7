"""Whether a registration can be believed, and in which directions the walls hold it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.messages import Array
from companion.odometry.solve_kernels import without_translation
from companion.odometry.wall_map import Registration

# Of the translation's information; a hall has about 0.2, a corridor 0.004 (measured). With 0.01 a hall of 120 m with pilasters,
# its ends out of range, was flown along by chance, and into its wall.
MIN_EIGENVALUE_RATIO = 0.02
WEAK_YAW_INFORMATION = 1.0 / math.radians(2.0) ** 2  # 1/rad2
MIN_INLIERS = 40
MIN_INLIER_RATIO = 0.3  # of the layer's points; a door that opens on a new hall leaves that many
MAX_SCALE = 2.8
MAX_NIS = 30.0  # squared Mahalanobis distance of 3 degrees of freedom: one in 10^6 by chance
ALWAYS_ALLOWED = np.array([0.05, 0.05, 0.008])  # m, m, rad
_ALLOWED = tuple(ALWAYS_ALLOWED.tolist())


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
    a, b, c = float(information[0, 0]), float(information[0, 1]), float(information[1, 1])
    total = a + c
    if total <= 0.0:
        return 0.0, np.array([1.0, 0.0])
    angle = 0.5 * math.atan2(2.0 * b, a - c)  # of the greater one
    smaller = 0.5 * total - math.hypot(0.5 * (a - c), b)
    return max(smaller, 0.0) / total, np.array([-math.sin(angle), math.cos(angle)])


def is_yaw_weak(information: Array) -> bool:
    """True when the walls alone leave yaw to more than 2 deg (round silo: turning changes nothing)."""
    return bool(without_translation(information) < WEAK_YAW_INFORMATION)


def _refusal(registration: Registration, guess: Array, guess_covariance: Array, points: int) -> str:
    if registration.inliers < min(MIN_INLIERS, max(points, 12)) or registration.inliers < MIN_INLIER_RATIO * points:
        return "too few inliers"
    if registration.scale > MAX_SCALE:
        return "residuals too large"
    if not all(map(math.isfinite, registration.pose.tolist())):
        return "not finite"
    jump = registration.pose - guess
    if all(abs(off) <= allowed for off, allowed in zip(jump.tolist(), _ALLOWED, strict=True)):
        return ""
    noise = np.linalg.inv(registration.information + np.diag([1.0, 1.0, 10.0])) + np.diag(ALWAYS_ALLOWED**2) / 9.0
    nis = float(jump @ np.linalg.solve(guess_covariance + noise, jump))
    return "" if nis <= MAX_NIS else "jump against the prediction"
