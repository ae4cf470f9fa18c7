"""Finding the pose again in the map after registration was lost: a small search from many guesses."""

from __future__ import annotations

import numpy as np

from companion.messages import Array
from companion.odometry.wall_map import Registration, WallMap

OFFSETS_M = (0.0, -0.6, 0.6, -1.2, 1.2)
YAWS_RAD = (0.0, -0.12, 0.12, -0.25, 0.25)
THINNED_POINTS = 128  # for the search; the best is refined with all
MIN_INLIER_RATIO = 0.6
MAX_SCALE = 2.0


def relocalise(
    walls: WallMap, layer: Array, guess: Array, covariance: Array, z_m: float, sigma_range_m: float
) -> Registration | None:
    """The best of the registrations from guesses about the prediction, or None when none fits well enough.

    covariance: (3, 3) of the guess; the search is widened to twice its sigma.
    """
    sigma = np.sqrt(np.diag(covariance))
    wide = max(1.0, 2.0 * float(max(sigma[0], sigma[1])) / OFFSETS_M[-1])
    free = np.diag([1.0, 1.0, 10.0])
    thin = np.ascontiguousarray(layer[:: max(1, len(layer) // THINNED_POINTS)])
    best: Registration | None = None
    for dyaw in YAWS_RAD:
        for dx in OFFSETS_M:
            for dy in OFFSETS_M:
                trial = guess + np.array([wide * dx, wide * dy, dyaw])
                found = walls.register(thin, trial, free, z_m=z_m, sigma_range_m=sigma_range_m, max_iterations=8)
                if best is None or (found.inliers / found.scale) > (best.inliers / best.scale):
                    best = found
    if best is None or not np.isfinite(best.pose).all():
        return None
    final = walls.register(layer, best.pose, free, z_m=z_m, sigma_range_m=sigma_range_m, max_iterations=20)
    good = final.inliers >= MIN_INLIER_RATIO * len(layer) and final.scale <= MAX_SCALE and final.converged
    return final if good and len(layer) > 20 else None
