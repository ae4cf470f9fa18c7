"""The flight controller's attitude over the last seconds, to be asked for at any time within."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.geometry import rpy_from_quat
from companion.messages import Array, AttitudeSample
from companion.odometry.jit import kernel

HISTORY = 128  # samples; 2.5 s at 50 Hz
MAX_EXTRAPOLATION_S = 0.1  # beyond the newest sample the turn rate is carried on for this long


@kernel
def _interpolate(
    t_ns: NDArray[np.int64], sample_ns: NDArray[np.int64], values: Array, max_extrapolation_s: float
) -> Array:
    """Linear between the samples, the first and last ones before and after; yaw goes on at the last rate."""
    newest = len(sample_ns) - 1
    out = np.empty((len(t_ns), 4))
    for i in range(len(t_ns)):
        t = t_ns[i]
        if t >= sample_ns[newest]:
            out[i] = values[newest]
            beyond_s = min(float(t - sample_ns[newest]) * 1e-9, max_extrapolation_s)
            out[i, 2] += beyond_s * values[newest, 3]
            continue
        after = np.searchsorted(sample_ns, t, side="right")
        if after == 0:
            out[i] = values[0]
            continue
        past, span = float(t - sample_ns[after - 1]), float(sample_ns[after] - sample_ns[after - 1])
        for k in range(4):
            out[i, k] = (values[after, k] - values[after - 1, k]) / span * past + values[after - 1, k]
    return out


class AttitudeHistory(NamedTuple):
    """Immutable. t_ns: (N,). values: (N, 4) roll, pitch, yaw by integration of the gyro alone (unwrapped), yaw rate."""

    t_ns: NDArray[np.int64]
    values: Array
    q_ref_body_wxyz: Array
    rate_body_radps: Array

    def at(self, t_ns: NDArray[np.int64]) -> Array:
        """(M, 4) roll, pitch, gyro yaw, yaw rate at those times; carried on a little beyond the newest sample."""
        return _interpolate(t_ns, self.t_ns, self.values, MAX_EXTRAPOLATION_S)


class AttitudeBuffer:
    """Keeps samples in order; what is published is never changed, so another thread may read while one adds.

    Of the flight controller's yaw nothing is used: it is fused from our own estimates, and a prior made of it would
    hide drift. Its gyro gives the increments.
    """

    def __init__(self) -> None:
        self.history: AttitudeHistory | None = None
        self.dropped = 0

    def add(self, sample: AttitudeSample) -> bool:
        """False when the sample is not finite, not a rotation, or not newer than the last (counted)."""
        q, rate = np.asarray(sample.q_ref_body_wxyz, float), np.asarray(sample.rate_body_radps, float)
        if q.shape != (4,) or rate.shape != (3,) or not all(map(math.isfinite, (*q.tolist(), *rate.tolist()))):
            self.dropped += 1
            return False
        norm = float(q @ q)
        old = self.history
        if not 0.81 < norm < 1.21 or (old is not None and sample.t_ns <= old.t_ns[-1]):
            self.dropped += 1
            return False
        q = q / np.sqrt(norm)
        roll, pitch, _ = rpy_from_quat(q)
        cos_pitch = max(float(np.cos(pitch)), 0.1)
        yaw_rate = float((rate[1] * np.sin(roll) + rate[2] * np.cos(roll)) / cos_pitch)
        row = np.array([[roll, pitch, 0.0, yaw_rate]])
        t = np.array([sample.t_ns], np.int64)
        if old is None:
            self.history = AttitudeHistory(t, row, q, rate)
            return True
        dt_s = (sample.t_ns - int(old.t_ns[-1])) * 1e-9
        row[0, 2] = old.values[-1, 2] + 0.5 * (yaw_rate + old.values[-1, 3]) * dt_s
        keep = slice(-(HISTORY - 1), None)
        self.history = AttitudeHistory(
            np.concatenate((old.t_ns[keep], t)), np.concatenate((old.values[keep], row)), q, rate
        )
        return True
