"""Simple polygons in plan: area, what lies inside, distance to the edges, outline of a cell mask."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from companion.messages import Array
from companion.volume.grid import Grid, Mask


def signed_area(polygon: Array) -> float:
    """Area of a (V, 2) polygon, positive when it runs counter-clockwise."""
    x, y = polygon[:, 0] - polygon[0, 0], polygon[:, 1] - polygon[0, 1]
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def contains(polygon: Array, x: Array, y: Array) -> Mask:
    """Which of the points lie inside (even-odd rule)."""
    inside = np.zeros(x.shape, dtype=np.bool_)
    for (ax, ay), (bx, by) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        crosses = (ay > y) != (by > y)
        if by != ay:
            inside ^= crosses & (x < ax + (y - ay) * (bx - ax) / (by - ay))
    return inside


def edge_distance(polygon: Array, x: Array, y: Array) -> Array:
    """Distance of each point to the nearest edge, unsigned."""
    best = np.full(x.shape, np.inf)
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        d = b - a
        length2 = float(d @ d)
        t = np.clip(((x - a[0]) * d[0] + (y - a[1]) * d[1]) / length2, 0.0, 1.0) if length2 > 0 else 0.0
        best = np.minimum(best, np.hypot(x - a[0] - t * d[0], y - a[1] - t * d[1]))
    return best


def along_edges(polygon: Array, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Of each of (N,) places: how far along the counter-clockwise polygon its nearest place on an edge lies, its
    distance from there (positive inside), and that edge's inward normal (N, 2)."""
    best, along, begin = np.full(x.shape, np.inf), np.zeros(x.shape), 0.0
    normal = np.zeros((*x.shape, 2))
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        d = b - a
        length = float(np.hypot(d[0], d[1]))
        if length == 0.0:
            continue
        d = d / length
        t = np.clip((x - a[0]) * d[0] + (y - a[1]) * d[1], 0.0, length)
        away = np.hypot(x - a[0] - t * d[0], y - a[1] - t * d[1])
        nearer = away < best
        best, along = np.where(nearer, away, best), np.where(nearer, begin + t, along)
        normal[nearer] = -d[1], d[0]
        begin += length
    return along, np.where(contains(polygon, x, y), best, -best), normal


def coverage(polygon: Array, grid: Grid, *, sub: int = 5) -> Array:
    """Share of each cell that lies inside the polygon, (ny, nx); by sub x sub samples near the edges."""
    cx, cy = grid.centres()
    share = contains(polygon, cx, cy).astype(np.float64)
    rows, cols = np.nonzero(edge_distance(polygon, cx, cy) < 0.75 * grid.cell_m)
    offsets = ((np.arange(sub) + 0.5) / sub - 0.5) * grid.cell_m
    ox, oy = (o.ravel() for o in np.meshgrid(offsets, offsets))
    hits = contains(polygon, cx[rows, cols][:, None] + ox, cy[rows, cols][:, None] + oy)
    share[rows, cols] = hits.mean(axis=1)
    return share


def outline(mask: Mask, grid: Grid) -> Array:
    """Outer boundary of the mask as a counter-clockwise (V, 2) polygon along cell edges: its largest loop."""
    padded = np.pad(mask, 1)
    # Directed cell edges with the mask on their left: each corner is left once (twice where cells touch by corners).
    leave: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for (di, dj), (start, end) in {
        (-1, 0): ((0, 0), (0, 1)),
        (0, 1): ((0, 1), (1, 1)),
        (1, 0): ((1, 1), (1, 0)),
        (0, -1): ((1, 0), (0, 0)),
    }.items():
        rows, cols = np.nonzero(padded & ~np.roll(padded, (-di, -dj), axis=(0, 1)))
        for i, j in zip(rows.tolist(), cols.tolist(), strict=True):
            leave.setdefault((i + start[0], j + start[1]), []).append((i + end[0], j + end[1]))
    best = np.zeros((0, 2))
    while leave:
        first = min(leave)
        loop, corner = [], first
        while corner in leave:
            loop.append(corner)
            following = leave[corner].pop()
            if not leave[corner]:
                del leave[corner]
            corner = following
        ij = np.array(loop, dtype=np.float64) - 1.0
        polygon = np.column_stack([grid.x0_m + ij[:, 1] * grid.cell_m, grid.y0_m + ij[:, 0] * grid.cell_m])
        if len(best) == 0 or abs(signed_area(polygon)) > abs(signed_area(best)):
            best = polygon
    return best


def resample(polygon: Array, step_m: float) -> Array:
    """Points along the closed polygon at about equal distances."""
    closed = np.vstack([polygon, polygon[:1]])
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(closed, axis=0).T))])
    count = max(8, int(s[-1] / step_m))
    at = np.linspace(0.0, s[-1], count, endpoint=False)
    return np.column_stack([np.interp(at, s, closed[:, 0]), np.interp(at, s, closed[:, 1])])


def simplify_closed(polygon: Array, tolerance_m: float) -> NDArray[np.int64]:
    """Indices of the vertices that Douglas and Peucker's method keeps of a closed polygon, in order."""
    centre = polygon.mean(axis=0)
    first = int(np.argmax(np.hypot(*(polygon - centre).T)))
    ring = np.roll(polygon, -first, axis=0)
    n = len(ring)
    far = int(np.argmax(np.hypot(*(ring - ring[0]).T)))
    ring = np.vstack([ring, ring[:1]])
    keep = {0, far}
    stack = [(0, far), (far, n)]
    while stack:
        a, b = stack.pop()
        if b - a < 2:
            continue
        d = ring[b] - ring[a]
        length = float(np.hypot(d[0], d[1]))
        rest = ring[a + 1 : b] - ring[a]
        away = np.abs(rest[:, 0] * d[1] - rest[:, 1] * d[0]) / length if length > 0 else np.hypot(*rest.T)
        k = int(np.argmax(away))
        if away[k] > tolerance_m:
            keep.add(a + 1 + k)
            stack += [(a, a + 1 + k), (a + 1 + k, b)]
    return np.array(sorted((k + first) % n for k in keep), dtype=np.int64)
