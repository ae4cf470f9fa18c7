"""The foot of a column, measured by its returns, which lie about its outline as far off as their noise throws them.

In polar coordinates about its middle a thing covers half the integral of r^2 over the turn, and noise of whatever direction
adds its variance to the mean of r^2: so the area is known to a few hundredths, where the cells that returns fill tell it to
a sixth. Where noise blurs its corners, a square counts for 5 % more than it covers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.messages import Array

SECTORS = 24
LEAST_IN_SECTOR = 5  # returns: it was seen from there
PASSES = 4  # to find its middle
AROUND = 0.95  # of the returns in its cells lie within the reach that noise then adds to
LONGEST = 2.5  # its largest radius over its least: what is longer is not told by so few sectors
AREA_RATIO = 0.03  # 1 sigma of its area by its shape
NOISE_RATIO = 0.15  # of the noise's variance, by which that is not known


@dataclass(frozen=True, slots=True, kw_only=True)
class Column:
    """outline_m: (SECTORS, 2), counter-clockwise, of that area. sigma_m2: 1 sigma of the area."""

    outline_m: Array
    area_m2: float
    sigma_m2: float


def measure_column(own: Array, around: Array, noise_m: float) -> Column | None:
    """The foot of what stands upright there; None where it was not seen from all around, or is long.

    Args: own: (N, 2) returns in its cells. around: (M, 2) of all upright things. noise_m: 1 sigma of a range.
    """
    if len(own) < SECTORS * LEAST_IN_SECTOR:
        return None
    middle = np.median(own, axis=0)
    reach_m = float(np.quantile(np.linalg.norm(own - middle, axis=1), AROUND)) + 3.0 * noise_m
    angle = (np.arange(SECTORS) + 0.5) * (2.0 * np.pi / SECTORS) - np.pi
    toward = np.column_stack([np.cos(angle), np.sin(angle)])
    radius2 = np.zeros(SECTORS)
    for _ in range(PASSES):
        off = around - middle
        off = off[np.hypot(*off.T) < reach_m]
        sector = np.floor((np.arctan2(off[:, 1], off[:, 0]) / (2.0 * np.pi) + 0.5) * SECTORS).astype(np.int64) % SECTORS
        count = np.bincount(sector, minlength=SECTORS)
        if count.min() < LEAST_IN_SECTOR:
            return None
        radius2 = np.bincount(sector, np.sum(off**2, axis=1), minlength=SECTORS) / count - noise_m**2
        if radius2.min() <= 0.0:
            return None
        middle = middle + np.mean(np.sqrt(radius2)[:, None] * toward, axis=0)
    if radius2.max() > LONGEST**2 * radius2.min():
        return None
    area = float(np.pi * radius2.mean())
    corners = np.sqrt(radius2)[:, None] * toward
    after = np.roll(corners, -1, axis=0)
    drawn = 0.5 * float(np.sum(corners[:, 0] * after[:, 1] - corners[:, 1] * after[:, 0]))
    return Column(
        outline_m=middle + corners * np.sqrt(area / drawn),
        area_m2=area,
        sigma_m2=float(np.hypot(AREA_RATIO * area, NOISE_RATIO * np.pi * noise_m**2)),
    )
