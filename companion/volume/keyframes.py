"""How far the keyframes disagree on what all of them see, and what that leaves of their errors over a lap."""

from __future__ import annotations

import math

import numpy as np

from companion.messages import Array
from companion.volume.polygon import resample

DRIFTS = 2.0  # independent errors in a lap, where they drift: a whole side shares one
LEAST_KEYFRAMES = 6  # before their disagreement is judged
TELLING = 0.2  # of a hall's size, that its walls stand off from a circle about its middle by, so that they tell a turn


def disagreement(means_m: Array, noise2_m2: float) -> tuple[float, float]:
    """Of single keyframes, less noise; and of all of them together: 1 sigma each, in m.

    What neighbours differ by, each of them errs by on its own, and it averages out; what all differ by beyond that is
    drift (the ratio of von Neumann, Annals of Mathematical Statistics 1941).

    Args: means_m: (K,) what each found, in the order flown. noise2_m2: variance of a mean by the noise of its returns.
    """
    spread2 = (1.4826 * float(np.median(np.abs(means_m - np.median(means_m))))) ** 2
    each2 = 0.5 * (1.4826 * float(np.median(np.abs(np.diff(means_m))))) ** 2
    single2, each2 = max(spread2 - noise2_m2, 0.0), max(each2 - noise2_m2, 0.0)
    return math.sqrt(single2), math.sqrt(each2 / len(means_m) + max(single2 - each2, 0.0) / DRIFTS)


def untold_turn(polygon_m: Array) -> float:
    """How far a turn of the vehicle goes unnoticed on these walls: 1 in a round hall, 0 where they tell it."""
    at = resample(polygon_m, 0.5)
    along = np.roll(at, -1, axis=0) - np.roll(at, 1, axis=0)
    along /= np.maximum(np.hypot(*along.T), 1e-9)[:, None]
    arm = at - at.mean(axis=0)
    told = math.sqrt(float(np.mean((arm * along).sum(axis=1) ** 2)) / float(np.mean((arm**2).sum(axis=1))))
    return max(0.0, 1.0 - told / TELLING)
