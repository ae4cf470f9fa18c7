"""What neighbouring points err by together, by how far a fit moves without them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from companion.jit import kernel
from companion.messages import Array
from companion.odometry.solve_kernels import TUKEY

SECTORS = 24  # of the turn: what points of one err by together is what a wall's bumps do


@kernel
def shared_by_sector(
    jac: Array, res: Array, var: Array, scale: float, sector: NDArray[np.int64], prior: Array
) -> tuple[float, float]:
    """Variance of roll and pitch as points of independent errors tell them, and how many times that is what the points of
    a sector err by together: bumps of a wall, which more points do not average out.

    jac: (n, 4) by roll, pitch and shift; res: what is left. By how far the fit moves without each sector (the jackknife
    of clusters: Cameron and Miller, Journal of Human Resources 2015, CR3), less what independent errors move it."""
    score, alone, of_sector = np.zeros((SECTORS, 4)), np.zeros((SECTORS, 4, 4)), np.zeros((SECTORS, 4, 4))
    h = prior.copy()
    for i in range(jac.shape[0]):
        v = res[i] / (TUKEY * scale * math.sqrt(var[i]))
        if abs(v) >= 1.0:
            continue
        w = (1.0 - v * v) ** 2 / (var[i] * scale * scale)
        g = sector[i]
        for k in range(4):
            score[g, k] += w * jac[i, k] * res[i]
            for j in range(4):
                h[k, j] += w * jac[i, k] * jac[i, j]
                of_sector[g, k, j] += w * jac[i, k] * jac[i, j]
                alone[g, k, j] += (w * res[i]) ** 2 * jac[i, k] * jac[i, j]
    excess = 0.0
    for g in range(SECTORS):
        if np.any(of_sector[g] != 0.0):
            without_it = np.linalg.inv(h - of_sector[g])
            moved = without_it @ score[g]
            spread = without_it @ alone[g] @ without_it
            excess += moved[0] ** 2 + moved[1] ** 2 - spread[0, 0] - spread[1, 1]
    tilt = np.linalg.inv(h)
    return 0.5 * (tilt[0, 0] + tilt[1, 1]), excess / (tilt[0, 0] + tilt[1, 1])
