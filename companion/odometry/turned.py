"""How far the LiDAR sits turned against the flight controller about the body's upright axis.

Scans alone cannot tell: a map that is turned as a whole fits as well. But tilts do. Where the two are turned against each
other, a nose that goes down shows in the walls as a roll too: of 2 deg of tilt by 0.07 deg. One scan tells tilt to 0.1 deg,
a flight has thousands. `Tilt` estimates without it, and this beside it, so that what flies stays as it is (the bias of a
separate-bias estimator: Friedland, IEEE Transactions on Automatic Control 14 (1969), 359-367).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from companion.messages import Array

SIGMA_RAD = math.radians(10.0)  # of what is known before
TOLD_RAD = math.radians(1.25)  # less is of no account
TOLD_SIGMAS = 3.5
BLOCK_SCANS = 200  # in a row, whose errors may be one and the same: the attitude lags where the vehicle speeds up
LEAST_BLOCKS = 4  # that have to tell of it
# Climbing faster, walls are seen at new heights and the attitude's error is still being found: it errs by degrees.
CLIMB_MPS = 0.3
KNOWN_RAD = math.radians(0.5)  # 1 sigma, above which nothing is told


class TurnedBy(NamedTuple):
    """Turn of the LiDAR's x axis about body z, counter-clockwise, beyond what its mount says; 1 sigma of it. Radians."""

    angle_rad: float = 0.0
    sigma_rad: float = SIGMA_RAD

    @property
    def is_sure(self) -> bool:
        """Whether it is so much, and so well known, that people must hear of it."""
        return self.sigma_rad < KNOWN_RAD and abs(self.angle_rad) > max(TOLD_RAD, TOLD_SIGMAS * self.sigma_rad)

    def in_words(self) -> str:
        """For people: what it means, and how to mend it."""
        angle, sigma = math.degrees(self.angle_rad), math.degrees(self.sigma_rad)
        return (
            f"LiDAR and flight controller are turned against each other by {angle:+.1f} deg (+- {2 * sigma:.1f}) about "
            "the vertical: the map is turned by as much about the start, which no volume minds; correct the yaw of "
            f"lidar.mount_rpy_deg by {angle:+.1f}"
        )


NOT_KNOWN = TurnedBy()


class Turned:
    """Estimates it from what `Tilt` finds, scan by scan."""

    def __init__(self) -> None:
        self._drawn = np.zeros(4)  # of roll, pitch and lean as estimated without it: for each radian of it
        self._blocks: list[list[float]] = []  # of scans: information, and pull
        self._scans = 0

    @property
    def by(self) -> TurnedBy:
        """Its sigma is what the blocks disagree by, where that is more than they tell."""
        information = SIGMA_RAD**-2 + sum(block[0] for block in self._blocks)
        angle = sum(block[1] for block in self._blocks) / information
        apart = [own * (pull / own - angle) ** 2 for own, pull in self._blocks if own > SIGMA_RAD**-2]
        if len(apart) < LEAST_BLOCKS:
            return TurnedBy(angle, SIGMA_RAD)
        return TurnedBy(angle, math.sqrt(max(1.0, sum(apart) / (len(apart) - 1)) / information))

    def carry(self, keep: Array) -> None:
        """On to the next scan: keep (4,) of the tilt's estimate stays."""
        self._drawn = self._drawn * keep

    def take(
        self, roll_rad: float, pitch_rad: float, climb_mps: float, correction: Array, information: Array, prior: Array
    ) -> None:
        """What the walls of a scan told.

        Args:
            roll_rad, pitch_rad: the attitude at the scan. climb_mps: how fast it climbs.
            correction: (4,) of roll, pitch, lean, as found with the prior. information: (4, 4) of the walls.
            prior: (4, 4) information before.
        """
        shown = self._drawn + np.array([pitch_rad, -roll_rad, 0.0, 0.0])
        told = information @ shown
        taken = np.linalg.solve(prior + information, told)
        if self._scans % BLOCK_SCANS == 0:
            self._blocks.append([0.0, 0.0])
        self._scans += 1
        if abs(climb_mps) < CLIMB_MPS:
            self._blocks[-1][0] += float(told @ (shown - taken))
            self._blocks[-1][1] += float(shown @ (prior @ correction))
        self._drawn = self._drawn - taken
