"""Where the body is in plan: each scan's layer registered to the walls, judged, fused, searched for where it was lost."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from companion.messages import Array
from companion.odometry import filter as kalman
from companion.odometry import weak
from companion.odometry.degeneracy import Judgement, judge, weak_direction
from companion.odometry.level import LOW_M
from companion.odometry.relocalise import relocalise
from companion.odometry.wall_map import Registration, WallMap

PRIOR_COVARIANCE = np.diag(np.array([0.06, 0.06, 0.02]) ** 2)  # m, m, rad: holds a registration where the walls do not
FLOOR_VARIANCE = np.array([0.004, 0.004, 0.0004]) ** 2  # what a registration errs by at best: roughness, time stamps
FAILED_AFTER = 3  # rejected scans in a row: quality -1 (FAULTS.md 8)
LEAST_NOISE_RATIO = 0.8  # of the noise of single returns: oblique ones err less across their wall
SUDDEN_LOSS = 0.15  # share of the layer's points that lose their wall at once
MIN_JUMP_M = 0.2
MOST_LOW_SCANS = 100  # a take-off is over by then: what stays low was not taking off


class Placing:
    """The walls and what registrations to them have told so far.

    sigma_range_m: noise that the residuals show. is_lost: along an axis, the place is not known well enough to map.
    rejected_in_row: registrations that were not believed, up to now; rejected: all of them, by why.
    """

    def __init__(self) -> None:
        self.walls = WallMap()
        self.sigma_range_m = 0.1
        self.is_lost = False
        self.rejected_in_row = 0
        self.rejected: dict[str, int] = {}
        self._return_sigma_m, self._is_standing = 0.0, True
        self._accepted = 0
        self._usual_share = 0.0  # of the layer's points that found a wall, lately
        self._is_weak = False  # along an axis not held by walls
        self._held_by_walls = np.zeros((2, 2))  # translation's information while weak, over some scans
        self._low_scans = 0  # since it no longer stands, until it has been higher than LOW_M

    def place(
        self,
        planar: kalman.Planar,
        layer: Array,
        z_m: float,
        before_ns: int,
        *,
        is_standing: bool,
        return_sigma_m: float,
    ) -> tuple[kalman.Planar, Registration, Judgement, bool]:
        """Register the layer from the predicted pose; fuse it if it can be believed; search if it failed for long.

        layer: (N, 2) levelled. before_ns: of the scan before. return_sigma_m: noise of single returns. Returns: the state, how
        it was registered and judged, and whether it jumped.
        """
        self._return_sigma_m, self._is_standing = return_sigma_m, is_standing
        guess = planar.x[kalman.POSE]
        covariance = planar.p[kalman.POSE_BLOCK]
        prior = np.asarray(np.linalg.inv(covariance + PRIOR_COVARIANCE), np.float64)
        registration = self.walls.register(layer, guess, prior, z_m=z_m, sigma_range_m=self.sigma_range_m)
        judgement = judge(registration, guess, covariance, len(layer))
        may_jump = judgement.is_accepted and not self.is_lost
        if may_jump and self._is_misplaced(registration, layer, guess, covariance, z_m):
            judgement = replace(judgement, refused_because="fits better elsewhere")
        if self.is_lost or (judgement.is_degenerate and judgement.is_accepted):
            axis = self._weak_axis(planar, registration, judgement)
            return self._place_weakly(planar, layer, z_m, prior, axis, before_ns)
        if judgement.is_accepted:
            self.rejected_in_row = 0
            self._accepted += 1
            self._track_noise(registration.scale)
            seen, apparent = registration.information, registration.apparent_information
            held = judgement.is_yaw_weak
            planar = kalman.update(planar, registration.pose, seen, apparent, prior, FLOOR_VARIANCE, holds_yaw=held)
            was_weak, self._is_weak = self._is_weak, False
            return planar, registration, judgement, was_weak and _is_jump(planar.x, guess)
        self.rejected_in_row += 1
        self.rejected[judgement.refused_because] = self.rejected.get(judgement.refused_because, 0) + 1
        if self.rejected_in_row >= FAILED_AFTER:
            found = relocalise(self.walls, layer, guess, covariance, z_m, self.sigma_range_m)
            anew = judge(found, found.pose, covariance, len(layer)) if found is not None else judgement
            if found is not None and not anew.is_degenerate:
                self.rejected_in_row = 0
                return kalman.restart(planar, found.pose), found, anew, True
        return planar, registration, judgement, False

    def _weak_axis(self, planar: kalman.Planar, registration: Registration, judgement: Judgement) -> Array:
        """(2,) in map; over some scans: were it to turn with each, what each leaves of it would add up."""
        if not judgement.is_degenerate:
            return weak.widest_axis(planar)
        memory = weak.AXIS_MEMORY if self._is_weak else 0.0
        self._held_by_walls = memory * self._held_by_walls + registration.information[:2, :2]
        return weak_direction(self._held_by_walls)[1]

    def _place_weakly(
        self, planar: kalman.Planar, layer: Array, z_m: float, prior: Array, axis: Array, before_ns: int
    ) -> tuple[kalman.Planar, Registration, Judgement, bool]:
        """Register across the weak axis only; search along it once the position there is lost and walls are missing."""
        guess = planar.x[kalman.POSE]
        covariance = planar.p[kalman.POSE_BLOCK]
        planar = weak.settle(planar, axis, (planar.t_ns - before_ns) * 1e-9)
        noise, prior_held = self.sigma_range_m, weak.held(prior, axis)
        registration = self.walls.register(layer, guess, prior_held, z_m=z_m, sigma_range_m=noise)
        judgement = judge(registration, guess, covariance, len(layer))
        sigma_m = weak.sigma_along(planar, axis)
        is_missing = registration.inliers < (1.0 - weak.MISSING_RATIO) * len(layer)
        if self.is_lost and (is_missing or not judgement.is_degenerate):
            found = weak.find_along(self.walls, layer, guess, axis, sigma_m, z_m, noise)
            if found is not None:
                self.rejected_in_row, self._is_weak, self.is_lost = 0, False, False
                judgement = judge(found, found.pose, covariance, len(layer))
                return weak.found_again(planar, found.pose), found, judgement, _is_jump(found.pose, guess)
        judgement = replace(judgement, is_degenerate=True, weak_axis=axis)
        if judgement.is_accepted:
            self.rejected_in_row = 0
            self._accepted += 1
            self._track_noise(registration.scale)
            seen, apparent = weak.without_axis(registration, axis)
            floor = FLOOR_VARIANCE + weak.axis_variance(sigma_m)
            planar = kalman.update(planar, registration.pose, seen, apparent, prior, floor)
        else:
            self.rejected_in_row += 1
            self.rejected[judgement.refused_because] = self.rejected.get(judgement.refused_because, 0) + 1
        self._is_weak, self.is_lost = True, weak.sigma_along(planar, axis) > weak.LOST_M
        return planar, registration, judgement, False

    def _is_misplaced(
        self, registration: Registration, layer: Array, guess: Array, covariance: Array, z_m: float
    ) -> bool:
        """Whether walls went missing all at once and are found again from a pose elsewhere.

        Walls along the way of motion fit as well after a jump along them: only those across it are missed. Until it has
        risen the foot of a pile passes for a wall, and a tilted layer meets it higher and farther off: no place to go to.
        """
        if not self._is_standing:
            self._low_scans = MOST_LOW_SCANS if z_m > LOW_M else self._low_scans + 1
        share = registration.inliers / max(len(layer), 1)
        lost = self._usual_share - share
        self._usual_share += 0.1 * (share - self._usual_share)
        if lost < SUDDEN_LOSS or self._is_standing or self._low_scans < MOST_LOW_SCANS:
            return False
        found = relocalise(self.walls, layer, guess, covariance, z_m, self.sigma_range_m)
        if found is None or found.inliers < registration.inliers + SUDDEN_LOSS * len(layer):
            return False
        self._usual_share = max(self._usual_share, found.inliers / len(layer))
        return _is_jump(found.pose, registration.pose)

    def _track_noise(self, scale: float) -> None:
        """Learn the range noise from the residuals: fast at first, then slowly; it is no less than that of returns. (In a
        climb residuals are small beside what walls may lean by, and tell of no noise.)"""
        rate = max(0.01, 0.3 / (1 + self._accepted / 5))
        least = max(0.01, LEAST_NOISE_RATIO * self._return_sigma_m)
        self.sigma_range_m = min(max(self.sigma_range_m * scale**rate, least), 0.5)


def _is_jump(pose: Array, before: Array) -> bool:
    return math.hypot(pose[0] - before[0], pose[1] - before[1]) > MIN_JUMP_M
