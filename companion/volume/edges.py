"""Straight stretches of wall: fitted each to its own returns, joined where they meet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.messages import Array
from companion.volume.grid import Index
from companion.volume.keyframes import LEAST_KEYFRAMES, disagreement
from companion.volume.polygon import signed_area, simplify_closed

BULGE_M = 4.0  # walls bulge over about so many metres


@dataclass(frozen=True, slots=True, kw_only=True)
class EdgeFit:
    """One straight stretch: its middle, direction and length, and how its returns lie about it: offsets_m, outwards, of
    the points `members`."""

    point: Array
    direction: Array
    length_m: float
    noise_m: float
    waviness_m: float
    members: Index
    offsets_m: Array


def fit_edges(loop: Array, points: Array, spread: float) -> tuple[Array, list[EdgeFit]]:
    """Straight stretches by Douglas and Peucker, each fitted to its returns, joined at their intersections."""
    corners = loop[simplify_closed(loop, max(0.12, 0.7 * spread))]
    if signed_area(corners) < 0:
        corners = corners[::-1]
    ends = np.roll(corners, -1, axis=0)
    lines = [_fit_edge(a, b, points, spread) for a, b in zip(corners, ends, strict=True)]
    corners, lines = _without_chamfers(corners, ends, lines)
    vertices: list[Array] = []
    for i, corner in enumerate(corners):
        vertices += _join(lines[i - 1], lines[i], corner)
    return np.array(vertices), [line for line in lines if line is not None]


def _without_chamfers(corners: Array, ends: Array, lines: list[EdgeFit | None]) -> tuple[Array, list[EdgeFit | None]]:
    """Leave out the short cuts that smoothing draws across corners: where the walls on both sides meet just beyond."""
    count = len(lines)
    length = np.hypot(*(ends - corners).T)
    is_cut = length < 1.0
    if count < 4 or is_cut.all():
        return corners, lines
    start = int(np.flatnonzero(~is_cut)[0])
    kept: list[tuple[Array, EdgeFit | None]] = []
    run: list[int] = []
    for k in [(start + n) % count for n in range(1, count + 1)]:
        if is_cut[k]:
            run.append(k)
            continue
        corner = corners[k]
        if run:
            middle = 0.5 * (corners[run[0]] + ends[run[-1]])
            before, after = lines[run[0] - 1], lines[k]
            is_corner = before is not None and after is not None and len(_join(before, after, middle)) == 1
            if is_corner and float(length[run].sum()) < 1.6:
                corner = middle
            else:
                kept += [(corners[r], lines[r]) for r in run]
        kept.append((corner, lines[k]))
        run = []
    return np.array([c for c, _ in kept]), [line for _, line in kept]


def _fit_edge(a: Array, b: Array, points: Array, spread: float) -> EdgeFit | None:
    length = float(np.hypot(*(b - a)))
    if length < 0.8:
        return None
    direction = (b - a) / length
    trim = min(0.4, 0.2 * length)
    d = points - a
    along = d @ direction
    across = d @ np.array([direction[1], -direction[0]])
    near = np.flatnonzero((along > trim) & (along < length - trim) & (np.abs(across) < 6 * spread + 0.1))
    if len(near) < 30:
        return None
    s, e = along[near] - 0.5 * length, across[near]
    offset, slope, sigma = 0.0, 0.0, 2 * spread + 0.05
    for _ in range(5):
        r = e - offset - slope * s
        ok = np.abs(r) < 3.5 * sigma
        if ok.sum() < 20:
            return None
        slope, offset = (float(v) for v in np.polyfit(s[ok], e[ok], 1))
        sigma = max(1.4826 * float(np.median(np.abs(e[ok] - offset - slope * s[ok]))), 0.005)
    r = e - offset - slope * s
    ok = np.abs(r) < 3.5 * sigma
    normal = np.array([direction[1], -direction[0]])
    turned = direction + slope * normal
    return EdgeFit(
        point=a + 0.5 * length * direction + offset * normal,
        direction=turned / np.hypot(*turned),
        length_m=length,
        noise_m=sigma,
        waviness_m=_waviness(s[ok], r[ok], length),
        members=near[ok],
        offsets_m=r[ok],
    )


def _waviness(s: Array, r: Array, length: float) -> float:
    """1 sigma of the place of the stretch as a whole, from how it waves: means over about 1 m, less what noise explains.

    Bulges go on for some metres: so many means tell as much as one.
    """
    bins = max(2, int(length))
    index = np.clip(((s / length + 0.5) * bins).astype(np.int64), 0, bins - 1)
    n = np.bincount(index, minlength=bins)
    full = n >= 5
    if full.sum() < 2:
        return 0.0
    means = np.bincount(index, r, minlength=bins)[full] / n[full]
    explained = float(np.mean(np.var(r) / n[full]))
    independent = max(1.0, float(full.sum()) / BULGE_M)
    return float(np.sqrt(max(float(np.mean(means**2)) - explained, 0.0) / independent))


def _join(before: EdgeFit | None, after: EdgeFit | None, corner: Array) -> list[Array]:
    """The vertex (or two) where two stretches meet: their intersection where it is well placed."""
    if before is None and after is None:
        return [corner]
    if before is None or after is None:
        line = before or after
        assert line is not None
        return [line.point + ((corner - line.point) @ line.direction) * line.direction]
    cross = before.direction[0] * after.direction[1] - before.direction[1] * after.direction[0]
    if abs(cross) > 0.1:
        gap = after.point - before.point
        t = (gap[0] * after.direction[1] - gap[1] * after.direction[0]) / cross
        meeting = before.point + t * before.direction
        if np.hypot(*(meeting - corner)) < 1.0:
            return [meeting]
    return [line.point + ((corner - line.point) @ line.direction) * line.direction for line in (before, after)]


def pose_disagreement(fits: list[EdgeFit], keyframe: Index) -> float:
    """How far single keyframes disagree on where a wall is, 1 sigma; NaN where too few see any."""
    single2, weight = 0.0, 0.0
    for fit in fits:
        _, index = np.unique(keyframe[fit.members], return_inverse=True)
        n = np.bincount(index)
        seen = n >= 8
        if seen.sum() < LEAST_KEYFRAMES:
            continue
        means = np.bincount(index, fit.offsets_m)[seen] / n[seen]
        single2 += float(seen.sum()) * disagreement(means, float(np.mean(fit.noise_m**2 / n[seen]))) ** 2
        weight += float(seen.sum())
    return float(np.sqrt(single2 / weight)) if weight else float("nan")
