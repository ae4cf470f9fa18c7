"""What the navigator keeps an eye on while it flies: vision, scan rate, battery."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from enum import Enum

import numpy as np

from companion.config import GuardConfig, LidarConfig
from companion.messages import OdometryEstimate, WallRanges

RATE_SCANS = (10, 100)  # a second, and FAULTS row 3's hundred scans
RATE_SHARE = 0.9
SLOW_RATIO = 0.5
UNCERTAIN = "the position is uncertain"
NOT_FUSED = "the flight controller does not use the vision"
JUMP_M = 1.0  # a restart of odometry that moves the pose by more makes the flown path worthless
MIN_ENERGY_S = 30.0  # flown before the drain of the battery is believed


@dataclass(frozen=True, slots=True)
class Vision:
    """good: fly on it. speed_ratio: how much of the mission's speed is wise. lasting_degenerate_s: for how long
    geometry has not held one direction. has_jumped: the pose was reset far away. lost_s: for how long nothing usable
    came (0 while it is only uncertain)."""

    is_good: bool
    why: str
    speed_ratio: float
    lasting_degenerate_s: float
    has_jumped: bool
    lost_s: float = 0.0


class VisionWatch:
    def __init__(self, guard: GuardConfig, lidar: LidarConfig) -> None:
        self._guard = guard
        self._period_ns = 1e9 / lidar.rate_hz
        self._scans: deque[int] = deque(maxlen=RATE_SCANS[-1] + 1)
        self._degenerate_since: int | None = None
        self._usable_ns: int | None = None
        self._last: OdometryEstimate | None = None

    def step(
        self, t_ns: int, estimate: OdometryEstimate | None, walls: WallRanges | None, *, is_fused: bool = True
    ) -> Vision:
        """is_fused: whether the flight controller flies on it; what we see is of no use if it does not."""
        if walls is not None and (not self._scans or walls.t_ns > self._scans[-1]):
            self._scans.append(walls.t_ns)
        why = self._poor(t_ns, estimate, walls) or ("" if is_fused else NOT_FUSED)
        jumped = estimate is not None and self._jumped(estimate)
        self._last = estimate if estimate is not None else self._last
        degenerate = estimate is not None and estimate.is_degenerate
        if not degenerate:
            self._degenerate_since = None
        elif self._degenerate_since is None:
            self._degenerate_since = t_ns
        lasting = (t_ns - self._degenerate_since) / 1e9 if self._degenerate_since is not None else 0.0
        if self._usable_ns is None or why in ("", UNCERTAIN):
            self._usable_ns = t_ns
        lost = (t_ns - self._usable_ns) / 1e9
        slow = degenerate or self.is_lidar_slow
        return Vision(not why, why, SLOW_RATIO if slow else 1.0, lasting, jumped, lost)

    @property
    def is_lidar_slow(self) -> bool:
        """Fewer than 90 % of the scans that should have come, over the last ten or the last hundred."""
        for n in RATE_SCANS:
            if len(self._scans) > n:
                span = self._scans[-1] - self._scans[-1 - n]
                if n * self._period_ns < RATE_SHARE * span:
                    return True
        return False

    def _poor(self, t_ns: int, estimate: OdometryEstimate | None, walls: WallRanges | None) -> str:
        limit = self._guard.max_scan_age_s * 1e9
        if estimate is None:
            return "no estimate"
        if walls is None:
            return "no scan"
        if t_ns - estimate.t_ns > limit:
            return "the estimate is old"
        if t_ns - walls.t_ns > limit:
            return "the scan is old"
        if not all(map(math.isfinite, (*estimate.position_map_m.tolist(), *estimate.q_map_body_wxyz.tolist()))):
            return "the estimate is not finite"
        if estimate.quality < 0:
            return "registration failed"
        largest, covariance = self._guard.max_position_sigma_m**2, estimate.pose_covariance
        if not all(0.0 <= covariance[axis, axis] <= largest for axis in range(3)):
            return UNCERTAIN
        return ""

    def _jumped(self, estimate: OdometryEstimate) -> bool:
        last = self._last
        if last is None or last.reset_counter == estimate.reset_counter:
            return False
        moved = float(np.linalg.norm(estimate.position_map_m - last.position_map_m))
        return not moved <= JUMP_M


class Battery(Enum):
    FINE = "fine"
    LOW = "low"  # what is left after the way home would be less than the reserve
    CRITICAL = "critical"


class BatteryWatch:
    """Drain is measured in flight; the way home counts with it."""

    RESERVE_RATIO = 0.30
    CRITICAL_RATIO = 0.12

    def __init__(self) -> None:
        self._since_ns: int | None = None
        self._full_ratio = 1.0

    def step(self, t_ns: int, ratio: float | None, home_s: float) -> Battery:
        """home_s: seconds to fly home along the flown path and land."""
        if ratio is None or not math.isfinite(ratio) or ratio < 0:
            return Battery.FINE  # no battery monitor: readiness has told so
        if self._since_ns is None:
            self._since_ns, self._full_ratio = t_ns, ratio
        flown_s = (t_ns - self._since_ns) / 1e9
        drain = max(0.0, self._full_ratio - ratio) / flown_s if flown_s > MIN_ENERGY_S else 0.0
        if ratio < self.CRITICAL_RATIO:
            return Battery.CRITICAL
        return Battery.LOW if ratio - drain * home_s < self.RESERVE_RATIO else Battery.FINE
