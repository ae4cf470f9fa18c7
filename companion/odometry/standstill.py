"""Standing still before take-off: hundreds of scans of one place make the first keyframe, instead of one noisy scan."""

from __future__ import annotations

from collections import deque

import numpy as np

from companion.messages import Array
from companion.odometry.attitude import AttitudeHistory

RECENT = 5  # scans over which a shift is averaged
NOTICED_LATE = 10  # scans: motion is noticed by then
MAX_RATE_RADPS = 0.2
MAX_TILT_CHANGE_RAD = 0.06
MAX_RANGEFINDER_CHANGE_M = 0.08
ON_GROUND_M = 0.5  # a rangefinder that reads less than this, and always the same, stands on its legs
SHIFT_SIGMAS = 4.0
MIN_SHIFT = np.array([0.03, 0.03, 0.012, 0.04])  # x, y, yaw, z below which nothing is called a move


class Standstill:
    """Stands as long as nothing tells of motion: gyro, tilt, rangefinder, the registrations themselves."""

    def __init__(self) -> None:
        self.is_standing = True
        self._shifts: deque[Array] = deque(maxlen=RECENT)
        self._tilt: Array | None = None
        self._rangefinder: list[float] = []
        self._since: tuple[int, float] | None = None  # time and gyro yaw when it began
        self.stood_s = 0.0
        self.gyro_offset_radps = 0.0
        self._yaws: deque[tuple[int, float]] = deque(maxlen=NOTICED_LATE)  # time and gyro yaw of the last scans

    @property
    def turned_rad(self) -> float:
        """By the gyro, since it surely stood."""
        if not self._yaws:
            return 0.0
        (since_ns, since), (t_ns, yaw) = self._yaws[0], self._yaws[-1]
        return yaw - since - self.gyro_offset_radps * (t_ns - since_ns) * 1e-9

    @property
    def rangefinder_m(self) -> float | None:
        """Median reading while standing."""
        return float(np.median(self._rangefinder)) if self._rangefinder else None

    @property
    def is_on_ground(self) -> bool:
        """By rangefinder alone: what stands where walls cannot tell of motion."""
        rest = self.rangefinder_m
        return self.is_standing and rest is not None and rest < ON_GROUND_M

    def on_rangefinder(self, distance_m: float) -> None:
        if not self.is_standing:
            return
        rest = self.rangefinder_m
        if rest is not None and len(self._rangefinder) >= 5 and abs(distance_m - rest) > MAX_RANGEFINDER_CHANGE_M:
            self.is_standing = False
        elif len(self._rangefinder) < 200:
            self._rangefinder.append(distance_m)

    def on_scan(self, history: AttitudeHistory, shift: Array, sigma: Array) -> bool:
        """Whether it still stands. shift: (4,) x, y, yaw, z as registered, from where it stood; sigma: (4,) of each."""
        tilt = history.values[-1, :2]
        if self._tilt is None:
            self._tilt = tilt
        self._shifts.append(shift)
        self._yaws.append((int(history.t_ns[-1]), float(history.values[-1, 2])))
        mean = np.mean(self._shifts, axis=0)
        limit = np.maximum(MIN_SHIFT, SHIFT_SIGMAS * sigma / np.sqrt(len(self._shifts)))
        moved = (
            bool((np.abs(mean) > limit).any())
            or bool((np.abs(history.rate_body_radps) > MAX_RATE_RADPS).any())
            or bool((np.abs(tilt - self._tilt) > MAX_TILT_CHANGE_RAD).any())
        )
        if moved:
            self.is_standing = False
        else:
            self._learn_gyro_offset(history)
        return self.is_standing

    def _learn_gyro_offset(self, history: AttitudeHistory) -> None:
        """What the gyro turned while nothing did; matters where walls do not tell yaw (a round silo)."""
        t_ns, yaw = int(history.t_ns[-1]), float(history.values[-1, 2])
        if self._since is None:
            self._since = t_ns, yaw
        self.stood_s = (t_ns - self._since[0]) * 1e-9
        if self.stood_s >= 2.0:
            self.gyro_offset_radps = (yaw - self._since[1]) / self.stood_s
