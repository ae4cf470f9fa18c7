"""What errors of the poses leave in the volume, as the map itself tells it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from companion.messages import Array, PointMap
from companion.volume.edges import EdgeFit
from companion.volume.floor import Floor
from companion.volume.grid import Grid, Index, Mask
from companion.volume.jackknife import STRETCHES, Stretches
from companion.volume.keyframes import DRIFTS, LEAST_KEYFRAMES, by_keyframe, disagreement, drift_factor, untold_turn
from companion.volume.surface import Cells, Surface
from companion.volume.walls import Footprint

LEAST_ON_FLOOR, LEAST_OF_KEYFRAME, LEAST_OF_WALL = 100, 20, 8  # returns


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseErrors:
    """spread_m3: 1 sigma of what stretches of the flight disagree by; None: too short for any. turns_m3: of what turns move
    that walls do not show. floor_disagreement_m: of single keyframes on the floor's height; 0 where too few see it.
    face_m2: of material against the walls: the volume that a metre of error in their place would add."""

    spread_m3: float | None
    turns_m3: float
    floor_disagreement_m: float
    face_m2: float


def pose_errors(
    point_map: PointMap, grid: Grid, cells: Cells, surface: Surface, footprint: Footprint, floor: Floor,
    stretches: Stretches | None, pile_m2: Array, piles: Sequence[tuple[Mask, Mask]], faces: Sequence[tuple[EdgeFit, float]],
) -> PoseErrors:  # fmt: skip
    """pile_m2: (ny, nx) of the material's cells. piles: of each its cells and those of the floor that tells its height.
    faces: see `wall_faces`."""
    flown = np.unique(point_map.keyframe_id)
    of_floor, floor_noise = floor_by_keyframe(point_map, cells, floor, flown)
    seen_floor = of_floor[np.isfinite(of_floor)]
    spread = None
    if stretches is not None:
        of_walls = [
            by_keyframe(f.offsets_m, footprint.fit_keyframe[f.members], flown, LEAST_OF_WALL) for f in footprint.fits
        ]
        spread = stretches.spread_m3(pile_m2, piles, faces) * drift_factor([*of_walls, of_floor], STRETCHES)
    return PoseErrors(
        spread_m3=spread,
        turns_m3=_turns_m3(point_map, footprint, grid, surface, pile_m2),
        floor_disagreement_m=disagreement(seen_floor, floor_noise**2) if len(seen_floor) >= LEAST_KEYFRAMES else 0.0,
        face_m2=sum(face for _, face in faces),
    )


def floor_by_keyframe(point_map: PointMap, cells: Cells, floor: Floor, flown: Index) -> tuple[Array, float]:
    """How high above the plane each keyframe in `flown` (sorted) saw the floor, (K,), NaN where it saw too little; 1 sigma
    of that by noise."""
    on_floor = cells.of_point >= 0
    on_floor[on_floor] = floor.cells.ravel()[cells.of_point[on_floor]]
    index = np.flatnonzero(on_floor)
    if len(index) < LEAST_ON_FLOOR:
        return np.full(len(flown), np.nan), 0.0
    points, keyframe = point_map.points_map[index], point_map.keyframe_id[index]
    r = points[:, 2] - floor.z(points[:, 0], points[:, 1])
    means = by_keyframe(r, keyframe, flown, LEAST_OF_KEYFRAME)
    n = np.bincount(np.searchsorted(flown, keyframe), minlength=len(flown))[np.isfinite(means)]
    return means, float(np.sqrt(np.mean(np.var(r) / n))) if len(n) else 0.0


def wall_faces(footprint: Footprint, grid: Grid, pile: Mask, height: Array) -> list[tuple[EdgeFit, float]]:
    """The stretches of wall that material lies against, with the face of it at each, m2."""
    band = (np.abs(footprint.depth_m) < grid.cell_m) & (footprint.share > 0) & pile & (height > 0)
    if not footprint.fits or not band.any():
        return []
    x, y = (c[band] for c in grid.centres())
    away = []
    for fit in footprint.fits:
        dx, dy = x - fit.point[0], y - fit.point[1]
        along = np.abs(dx * fit.direction[0] + dy * fit.direction[1]) - 0.5 * fit.length_m
        away.append(np.hypot(dx * fit.direction[1] - dy * fit.direction[0], np.maximum(along, 0.0)))
    face = np.bincount(np.argmin(away, axis=0), height[band], minlength=len(away)) * grid.cell_m / 2.0
    return [(fit, float(m2)) for fit, m2 in zip(footprint.fits, face, strict=True) if m2 > 0.0]


def _turns_m3(point_map: PointMap, footprint: Footprint, grid: Grid, surface: Surface, pile_m2: Array) -> float:
    """What turns of the vehicle move that walls do not show (in round halls), 1 sigma over a lap: what lies on one side of
    it rises, on the other it sinks. A heap that is round about the middle is not moved."""
    unseen = untold_turn(footprint.polygon_m) if footprint.has_walls else 0.0
    if unseen == 0.0 or len(point_map.path_map) < 2:
        return 0.0
    middle = footprint.polygon_m.mean(axis=0)
    x, y = (c - m for c, m in zip(grid.centres(), middle, strict=True))
    radius = math.sqrt(float(np.mean(np.sum((point_map.path_map[:, :2] - middle) ** 2, axis=1))))
    per_rad = pile_m2 * (x * surface.slope_y - y * surface.slope_x)
    sides = math.hypot(float(np.maximum(per_rad, 0.0).sum()), float(np.maximum(-per_rad, 0.0).sum()))
    return unseen * point_map.position_sigma_m / math.sqrt(DRIFTS) / max(radius, 1e-9) * sides
