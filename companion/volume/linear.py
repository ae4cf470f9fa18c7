"""Piecewise linear interpolation over a Delaunay triangulation, at the centres of a regular grid.

SciPy's LinearNDInterpolator gives the same, but walks to each point's triangle, and where the walk fails (beyond the hull,
along slivers of a map that was cut short) looks through all of them: minutes for a map that takes a second here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError

from companion.jit import kernel
from companion.messages import Array

ON_EDGE = 1e-9  # of barycentric coordinates: a centre on an edge belongs to both its triangles


def linear_on_grid(nodes: Array, z: Array, x: Array, y: Array) -> Array:
    """(ny, nx) heights at the columns x (nx,) and rows y (ny,), evenly spaced and rising; NaN beyond the nodes' hull, and
    everywhere where (N, 2) nodes make no triangle. z: (N,)."""
    try:
        triangles = Delaunay(nodes).simplices
    except (QhullError, ValueError):
        return np.full((len(y), len(x)), np.nan)
    return _fill(
        np.ascontiguousarray(nodes),
        np.ascontiguousarray(z),
        triangles,
        np.ascontiguousarray(x),
        np.ascontiguousarray(y),
    )


@kernel
def _fill(nodes: Array, z: Array, triangles: NDArray[np.int32], x: Array, y: Array) -> Array:
    """Each triangle writes the centres that lie in it."""
    nx, ny = len(x), len(y)
    out = np.full((ny, nx), np.nan)
    if nx == 0 or ny == 0:
        return out
    dx = (x[-1] - x[0]) / max(nx - 1, 1)
    dy = (y[-1] - y[0]) / max(ny - 1, 1)
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ax, ay = nodes[a, 0], nodes[a, 1]
        ux, uy = nodes[b, 0] - ax, nodes[b, 1] - ay
        vx, vy = nodes[c, 0] - ax, nodes[c, 1] - ay
        twice_area = ux * vy - uy * vx
        if twice_area == 0.0:
            continue
        first_x, last_x = _centres_between(min(0.0, ux, vx) + ax - x[0], max(0.0, ux, vx) + ax - x[0], dx, nx)
        first_y, last_y = _centres_between(min(0.0, uy, vy) + ay - y[0], max(0.0, uy, vy) + ay - y[0], dy, ny)
        for i in range(first_y, last_y + 1):
            py = y[i] - ay
            for j in range(first_x, last_x + 1):
                px = x[j] - ax
                to_b = (px * vy - py * vx) / twice_area
                to_c = (ux * py - uy * px) / twice_area
                if to_b >= -ON_EDGE and to_c >= -ON_EDGE and to_b + to_c <= 1.0 + ON_EDGE:
                    out[i, j] = z[a] + to_b * (z[b] - z[a]) + to_c * (z[c] - z[a])
    return out


@kernel
def _centres_between(low: float, high: float, step: float, n: int) -> tuple[int, int]:
    """First and last centre from low to high, a cell more to either side."""
    if step <= 0.0:
        return 0, n - 1
    return max(0, int(np.floor(low / step))), min(n - 1, int(np.ceil(high / step)))
