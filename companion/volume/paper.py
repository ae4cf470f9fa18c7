"""The paper's own volume (section 2.3), beside ours on the same map.

What the text says: a uniform grid over the inspected space R, the heights of the whole map M interpolated on it
linearly (MATLAB's `griddata`: Delaunay's triangles, as in linear.py), and the double integral of that surface (eq. 6).
It leaves two things open, chosen here so:

- R. Section 4 says that the estimate always exceeds the truth "because of the walls and the ground that need to be
  excluded from M", and an error of 3 % cannot be had with the walls inside R (they alone add more than half of the
  pile). So R is the rectangle about the map (the paper's hall is one), drawn in by a hand-set band that keeps the
  walls out while poses are good; where drift doubles the walls they come into R, and the volume grows, as the paper
  reports.
- The zero of z. The paper's z counts from the ground, ours from where odometry began: `ground_z_m` moves it. Of the
  ground nothing else is taken away: its returns stay in M, with their noise.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from companion.messages import Array
from companion.volume.linear import linear_on_grid

PAPER_CELL_M = 0.25
WALL_BAND_M = (
    1.0  # noise of 0.12 m throws the outermost of a million returns 0.6 m out, and the wall's own band is 0.36
)
MAX_POINTS = 200_000  # the surface triangulates every point: more of the same scans change little but the time


def paper_volume(
    points_map: Array,
    *,
    ground_z_m: float | None = None,
    cell_m: float = PAPER_CELL_M,
    wall_band_m: float = WALL_BAND_M,
) -> float:
    """Volume of the map by linear interpolation and double integration (eq. 6), m3; NaN where there is no surface.

    Args:
        points_map: (N, 3) float64, the paper's M: every point of every scan, walls and ground with it.
        ground_z_m: height of the ground in the same frame; None: the fullest low layer of the map.
        wall_band_m: how far R is drawn in from the outermost points.
    """
    points = points_map[np.isfinite(points_map).all(axis=1)]
    if len(points) < 4:
        return float("nan")
    points = points[:: max(1, len(points) // MAX_POINTS)]
    try:
        corner, axes, size = bounding_rectangle(points[:, :2])
    except QhullError:
        return float("nan")
    z = points[:, 2] - (_ground(points[:, 2]) if ground_z_m is None else ground_z_m)
    place = (points[:, :2] - corner) @ axes.T
    # griddata wants one height for a place: MATLAB's takes the mean of points at the same place, and so do we.
    cm = np.round(place / 0.01).astype(np.int64)
    key, of_node = np.unique((cm[:, 0] << 32) | (cm[:, 1] & 0xFFFFFFFF), return_inverse=True)
    height = np.bincount(of_node, z) / np.bincount(of_node)
    node = np.column_stack([key >> 32, key & 0xFFFFFFFF])
    x, y = (np.arange(wall_band_m + cell_m / 2, side - wall_band_m, cell_m) for side in size)
    if len(x) == 0 or len(y) == 0:
        return float("nan")
    surface = linear_on_grid(node * 0.01, height, x, y)
    if np.isnan(surface).all():
        return float("nan")
    return float(np.nansum(surface) * cell_m**2)  # eq. 6


def bounding_rectangle(xy: Array) -> tuple[Array, Array, Array]:
    """The smallest rectangle about the points: a corner, (2, 2) rows of unit axes, and the lengths along them."""
    hull = xy[ConvexHull(xy).vertices]
    edges = np.roll(hull, -1, axis=0) - hull
    best: tuple[float, Array, Array, Array] | None = None
    for edge in edges / np.hypot(edges[:, 0], edges[:, 1])[:, None]:
        axes = np.array([edge, [-edge[1], edge[0]]])
        turned = hull @ axes.T
        low, size = turned.min(axis=0), np.ptp(turned, axis=0)
        area = float(size[0] * size[1])
        if best is None or area < best[0]:
            best = (area, low @ axes, axes, size)
    assert best is not None
    return best[1:]


def _ground(z: Array) -> float:
    """Height of the ground when nobody says: the fullest 5 cm layer of the lower half of the heights."""
    low = z[z <= np.median(z)]
    counts, edges = np.histogram(low, bins=max(4, int(np.ptp(low) / 0.05)))
    fullest = float(edges[int(np.argmax(counts))]) + 0.025
    return float(np.median(low[np.abs(low - fullest) < 0.3]))
