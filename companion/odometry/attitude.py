"""The flight controller's attitude over the last seconds, to be asked for at any time within."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.geometry import rpy_from_parts
from companion.jit import kernel
from companion.messages import Array, AttitudeSample

HISTORY = 128  # samples; 2.5 s at 50 Hz
STORE = 2048  # samples that lie side by side, so that the newest can be shown without copying them
MAX_EXTRAPOLATION_S = 0.1  # beyond the newest sample the turn rate is carried on for this long


@kernel
def interpolate_at(t_ns: int, sample_ns: NDArray[np.int64], samples: Array) -> tuple[float, float, float, float]:
    """Linear between the samples, the first and last ones before and after; yaw goes on at the last rate.

    sample_ns: (N,) rising. samples, and what it gives: roll, pitch, yaw, yaw rate.
    """
    newest = len(sample_ns) - 1
    if t_ns >= sample_ns[newest]:
        beyond_s = min(float(t_ns - sample_ns[newest]) * 1e-9, MAX_EXTRAPOLATION_S)
        last = samples[newest]
        return last[0], last[1], last[2] + beyond_s * last[3], last[3]
    after = newest
    while after > 0 and sample_ns[after - 1] > t_ns:  # times asked for are mostly recent
        after -= 1
    if after == 0:
        first = samples[0]
        return first[0], first[1], first[2], first[3]
    a, b = samples[after - 1], samples[after]
    past, span = float(t_ns - sample_ns[after - 1]), float(sample_ns[after] - sample_ns[after - 1])
    return (
        (b[0] - a[0]) / span * past + a[0],
        (b[1] - a[1]) / span * past + a[1],
        (b[2] - a[2]) / span * past + a[2],
        (b[3] - a[3]) / span * past + a[3],
    )


@kernel
def _interpolate(t_ns: NDArray[np.int64], sample_ns: NDArray[np.int64], samples: Array) -> Array:
    """(M, 4) `interpolate_at` each of (M,) times."""
    out = np.empty((len(t_ns), 4))
    for i in range(len(t_ns)):
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = interpolate_at(t_ns[i], sample_ns, samples)
    return out


class AttitudeHistory(NamedTuple):
    """Immutable. t_ns: (N,). values: (N, 4) roll, pitch, yaw by integration of the gyro alone (unwrapped), yaw rate."""

    t_ns: NDArray[np.int64]
    values: Array
    q_ref_body_wxyz: Array
    rate_body_radps: Array

    def at(self, t_ns: NDArray[np.int64]) -> Array:
        """(M, 4) roll, pitch, gyro yaw, yaw rate at those times; carried on a little beyond the newest sample."""
        return _interpolate(t_ns, self.t_ns, self.values)


class AttitudeBuffer:
    """Keeps samples in order; what is published is never changed, so another thread may read while one adds.

    Of the flight controller's yaw nothing is used: it is fused from our own estimates, and a prior made of it would
    hide drift. Its gyro gives the increments.
    """

    def __init__(self) -> None:
        self.history: AttitudeHistory | None = None
        self._t_ns, self._samples, self._end = np.empty(STORE, np.int64), np.empty((STORE, 4)), 0
        self.newest_ns, self._newest = 0, (0.0, 0.0, 0.0, 0.0)
        self.dropped = 0

    def add(self, sample: AttitudeSample) -> bool:
        """False when the sample is not finite, not a rotation, or not newer than the last (counted)."""
        q, rate = np.asarray(sample.q_ref_body_wxyz, float), np.asarray(sample.rate_body_radps, float)
        if q.shape != (4,) or rate.shape != (3,):
            self.dropped += 1
            return False
        w, x, y, z = q.tolist()
        rate_x, rate_y, rate_z = rate.tolist()
        norm = w * w + x * x + y * y + z * z
        old = self.history
        is_sound = 0.81 < norm < 1.21 and math.isfinite(rate_x + rate_y + rate_z)
        if not is_sound or (old is not None and sample.t_ns <= self.newest_ns):
            self.dropped += 1
            return False
        root = math.sqrt(norm)
        w, x, y, z = w / root, x / root, y / root, z / root
        roll, pitch, _ = rpy_from_parts(w, x, y, z)
        yaw_rate = (rate_y * math.sin(roll) + rate_z * math.cos(roll)) / max(math.cos(pitch), 0.1)
        row = roll, pitch, 0.0, yaw_rate
        if old is not None:
            _, _, yaw, rate_before = self._newest
            dt_s = (sample.t_ns - self.newest_ns) * 1e-9
            row = roll, pitch, yaw + 0.5 * (yaw_rate + rate_before) * dt_s, yaw_rate
        self.newest_ns, self._newest = sample.t_ns, row
        self._append(sample.t_ns, row, np.array([w, x, y, z]), rate)
        return True

    def _append(self, t_ns: int, row: tuple[float, float, float, float], q: Array, rate: Array) -> None:
        """Write behind what is published; views of it stay as they are. A full store is left to those who read it."""
        if self._end == len(self._t_ns):
            keep = HISTORY - 1
            t_old, old = self._t_ns[-keep:], self._samples[-keep:]
            self._t_ns, self._samples = np.empty(STORE, np.int64), np.empty((STORE, 4))
            self._t_ns[:keep], self._samples[:keep] = t_old, old
            self._end = keep
        self._t_ns[self._end], self._samples[self._end] = t_ns, row
        self._end += 1
        kept = slice(max(0, self._end - HISTORY), self._end)
        self.history = AttitudeHistory(self._t_ns[kept], self._samples[kept], q, rate)
