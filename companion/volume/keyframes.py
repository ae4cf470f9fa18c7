"""How far the keyframes disagree on what all of them see, and what walls do not tell of them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from companion.messages import Array
from companion.volume.grid import Index
from companion.volume.polygon import resample

DRIFTS = 2.0  # independent errors in a lap, where nothing but their size is told
LEAST_KEYFRAMES = 6  # before their disagreement is judged
LAGS = 3  # of the autocorrelation, near and far: of two by so many keyframes the decay is read
LEAST_RHO, LARGEST_RATE = 0.1, 0.95
TELLING = 0.2  # of a hall's size, that its walls stand off from a circle about its middle by, so that they tell a turn


def disagreement(means_m: Array, noise2_m2: float) -> float:
    """Of single keyframes, less noise: 1 sigma in m.

    Args: means_m: (K,) what each found. noise2_m2: variance of a mean by the noise of its returns.
    """
    spread2 = (1.4826 * float(np.median(np.abs(means_m - np.median(means_m))))) ** 2
    return math.sqrt(max(spread2 - noise2_m2, 0.0))


def by_keyframe(values: Array, keyframe: Index, flown: Index, least: int) -> Array:
    """(K,) mean of the values of each keyframe in `flown` (sorted); NaN where fewer than `least` are of it."""
    at = np.searchsorted(flown, keyframe)
    count = np.bincount(at, minlength=len(flown))
    mean = np.bincount(at, values, minlength=len(flown)) / np.maximum(count, 1)
    return np.asarray(np.where(count >= least, mean, np.nan))


def drift_factor(series: Sequence[Array], parts: int) -> float:
    """By how much a jackknife over so many stretches of a flight tells too little, where errors drift from one into the next.

    How long they hang together is read from the autocorrelation of what single keyframes err by on each wall and on the
    floor: a r^lag, with a < 1 where noise comes on top. For errors of such a kind the variance of a mean and the mean
    variance that stretches show of it are known.

    Args: series: (K,) each, NaN where a keyframe did not see it.
    """
    length = max((len(s) for s in series), default=0)
    rows = np.array([_without_outliers(s) for s in series if np.isfinite(s).sum() >= LEAST_KEYFRAMES])
    if length < 3 * parts or not len(rows):
        return 1.0
    known = np.isfinite(rows)
    values = np.where(known, rows, 0.0)
    power = float(np.sum(values**2)) / float(known.sum())
    if power <= 0.0:
        return 1.0
    lags = range(1, 2 * LAGS + 1)
    together = [float(np.sum(known[:, k:] & known[:, :-k])) for k in lags]
    rho = (
        np.array([np.sum(values[:, k:] * values[:, :-k]) / max(n, 1.0) for k, n in zip(lags, together, strict=True)])
        / power
    )
    near, far = float(rho[:LAGS].mean()), float(rho[LAGS:].mean())
    if near < LEAST_RHO or far <= 0.0:
        return 1.0
    rate = min((far / near) ** (1.0 / LAGS), LARGEST_RATE)
    share = min(near * LAGS / float(np.sum(rate ** np.arange(1, LAGS + 1))), 1.0)

    def variance_of_mean(n: int) -> float:
        lag = np.arange(1, n)
        return (1.0 + 2.0 * share * float(np.sum((1.0 - lag / n) * rate**lag))) / n

    whole, part = variance_of_mean(length), variance_of_mean(length // parts)
    return math.sqrt(max(whole * (parts - 1) / max(part - whole, 1e-12), 1.0))


def _without_outliers(series: Array) -> Array:
    """About their mean; what lies beyond 3 sigma is brought there."""
    off = series - np.nanmedian(series)
    most = 3.0 * 1.4826 * float(np.nanmedian(np.abs(off)))
    off = np.clip(off, -most, most)
    return np.asarray(off - np.nanmean(off))


def untold_turn(polygon_m: Array) -> float:
    """How far a turn of the vehicle goes unnoticed on these walls: 1 in a round hall, 0 where they tell it."""
    at = resample(polygon_m, 0.5)
    along = np.roll(at, -1, axis=0) - np.roll(at, 1, axis=0)
    along /= np.maximum(np.hypot(*along.T), 1e-9)[:, None]
    arm = at - at.mean(axis=0)
    told = math.sqrt(float(np.mean((arm * along).sum(axis=1) ** 2)) / float(np.mean((arm**2).sum(axis=1))))
    return max(0.0, 1.0 - told / TELLING)
