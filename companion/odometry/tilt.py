"""What the flight controller's attitude errs by, told by walls that are plumb but for their bumps."""

from __future__ import annotations

import math

import numpy as np

from companion.messages import Array
from companion.odometry.height_map import HeightFit
from companion.odometry.turned import Turned, TurnedBy

WALK = 0.0015  # rad per sqrt(s): how fast the attitude's error wanders
SIGMA_RAD = 0.01  # how large it is thought to be
FLOOR_RAD = 0.0002
MOST_TILT_RAD = math.radians(8.0)  # that is corrected
LEANS_EVENT = "lidar_leans"
LEANS_IN_WORDS = (
    f"the LiDAR leans against the flight controller's attitude by {math.degrees(MOST_TILT_RAD):g} deg or more, "
    "which is more than is corrected: heights are wrong; check lidar.mount_rpy_deg and fly again"
)
ELSEWHERE_M = 10.0  # way after which other bumps are in sight
SHARED_MEMORY = 0.98  # of what is known of the bumps, from scan to scan
SHARED_POINTS = 500  # on walls, that have to speak of bumps before they are believed in
# variance of the tilt over what sectors tell: bumps longer than a sector is wide, and what the fit hides
LONG_BUMPS = 4.0


def mount_warnings(turned_by: TurnedBy, *, leans: bool) -> tuple[str, ...]:
    """What must stand beside a volume of a LiDAR that does not sit as its mount says. leans: by more than is corrected."""
    said = [turned_by.in_words()] if turned_by.is_sure else []
    return (*said, LEANS_IN_WORDS) if leans else tuple(said)


class Tilt:
    """Roll and pitch to be added to the attitude, body; and the turn about map x and y that the walls in sight lean by.

    How far bumps make walls lean is one error for all scans from about one place: to hover there does not average it out,
    and it is estimated beside the tilt. Its variance is learned from how the residuals of neighbours go together.
    """

    def __init__(self) -> None:
        self.offset = np.zeros(2)
        self.lean = np.zeros(2)
        self.p = np.diag([SIGMA_RAD**2, SIGMA_RAD**2, FLOOR_RAD**2, FLOOR_RAD**2])
        self.turned = Turned()
        self._information: Array | None = None  # of p as it is now, once it was asked for
        self._place = np.zeros(3)
        self._way_m, self._way_variance = 0.0, 0.0  # over ground; sum of the tilt's variance over it
        # how many times the variance of independent points the bumps add, by points
        self._shared, self._points = 0.0, 0.0
        self._at_last = 0.0  # variance of the tilt by the walls last seen, were their points independent
        self._alone = 0.0  # the same of the walls that the lean is believed of

    @property
    def information(self) -> Array:
        """(4, 4) inverse of p."""
        if self._information is None:
            self._information = np.asarray(np.linalg.inv(self.p), np.float64)
        return self._information

    def carry(self, dt_s: float, place: Array) -> None:
        """On to the next scan, from place (3,), map: the attitude's error wanders and is drawn back to 0, other bumps come
        into sight."""
        kept = 1.0 - min(1.0, dt_s * (WALK / SIGMA_RAD) ** 2 / 2)
        step = place - self._place
        same = math.exp(-float(np.linalg.norm(step)) / ELSEWHERE_M)
        self._place = place
        way_m = math.hypot(step[0], step[1])
        self._way_m += way_m
        self._way_variance += way_m * 0.5 * (self.p[0, 0] + self.p[1, 1])
        before = self._lean_variance()
        self._alone = max(self._alone * same**2 + (1.0 - same**2) * self._at_last, self._at_last)
        new = max(self._lean_variance() - before * same**2, 0.0)
        self.offset, self.lean = self.offset * kept, self.lean * same
        keep = np.array([kept, kept, same, same])
        self.turned.carry(keep)
        self.p = self.p * np.outer(keep, keep) + np.diag([WALK**2 * dt_s, WALK**2 * dt_s, new, new])
        self._information = None

    def drift_variance(self) -> float:
        """Of z, m2: the ground's map goes on as the tilt has it, so far off the start it is off by a sum of tilts, each the
        same over ELSEWHERE_M."""
        reach_m = math.hypot(self._place[0], self._place[1])
        return self._way_variance / max(self._way_m, 1.0) * reach_m * min(reach_m, ELSEWHERE_M)

    def take(self, fit: HeightFit, roll_rad: float, pitch_rad: float, climb_mps: float = 0.0) -> None:
        """What the walls of a scan told, the attitude at it, and how fast it climbed."""
        self.turned.take(roll_rad, pitch_rad, climb_mps, fit.correction[1:], fit.information[1:, 1:], self.information)
        self.offset = np.clip(self.offset + fit.correction[1:3], -MOST_TILT_RAD, MOST_TILT_RAD)
        self.lean = self.lean + fit.correction[3:]
        self.p = np.asarray(np.linalg.inv(self.information + fit.information[1:, 1:]), np.float64)
        self._information = None
        self.p[:2, :2] += np.eye(2) * FLOOR_RAD**2
        if fit.wall_points > 0:
            before = self._lean_variance()
            self._shared = SHARED_MEMORY * self._shared + fit.wall_points * fit.shared_ratio
            self._points = SHARED_MEMORY * self._points + fit.wall_points
            self._at_last = fit.wall_variance
            self._expect_lean(before)

    def _lean_variance(self) -> float:
        shared = max(self._shared / (self._points + SHARED_POINTS), 0.0)
        return LONG_BUMPS * shared * self._alone + FLOOR_RAD**2

    def _expect_lean(self, before: float) -> None:
        """Bumps turn out larger than was thought, and nobody knows where they lean to; or smaller."""
        now = self._lean_variance()
        if now > before:
            self.p[2:, 2:] += np.eye(2) * (now - before)
        else:
            less = math.sqrt(now / before)
            self.turned.carry(np.array([1.0, 1.0, less, less]))
            self.lean = self.lean * less
            self.p *= np.outer([1.0, 1.0, less, less], [1.0, 1.0, less, less])
