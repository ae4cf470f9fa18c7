"""How far the volume follows the map where that is bent: by an offset of the sensor's ranges, and by walls that are no lines.

Longer ranges alone let a pile sink less than the floor below it, since its beams are flatter. But the odometry places each scan by
walls and ground that it measured with the same ranges: walls stand farther out the more squarely they are met, which moves
the body; lower layers meet a near wall less far out than the horizontal one, which passes for a tilt; each scan's height is
the one that fits the ground. All of it is linear in the offset, and is followed here in the returns themselves: the normal
equations of the scans' places, tilts and heights, in the order in which the odometry finds them.

Steps in a wall (pilasters) draw the body inward, from whatever wall is near: seen from afar and from nearby the wall then lies
elsewhere. All stretches of a flight share that, so it does not show in what they differ by.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from companion.messages import Array, PointMap
from companion.volume.edges import EdgeFit
from companion.volume.floor import Floor
from companion.volume.grid import Grid, Index, Mask
from companion.volume.surface import Cells, Surface
from companion.volume.walls import Footprint

MOST_RETURNS = 400_000  # more tell nothing new: it is geometry, not noise, that counts
LEAST_FLOOR_CELLS = 50
LEAST_IN_CELL = 2  # returns
STRIP_M = 1.5  # of wall, as wide as the odometry's lines
LEAST_IN_STRIP = 5  # returns of the horizontal layer
LEVEL_SIN = 0.026  # a beam less steep than 1.5 deg is of the horizontal layer
PASSES = 10  # between scans and what they see: the next twenty change the volume by a hundredth
LOOSE = 1.0  # information that holds a place or tilt which no wall tells, against that of one return


@dataclass(frozen=True, slots=True, kw_only=True)
class _Returns:
    """flown: (K,) keyframes of the map, sorted. keyframe: (N,) which of them. point: (N, 3) in map; beam: unit, and reach_m: from
    the body, to it. cell: (N,) flat, -1 off the surface."""

    flown: Index
    keyframe: Index
    point: Array
    beam: Array
    reach_m: Array
    cell: Index


@dataclass(frozen=True, slots=True, kw_only=True)
class _OnWalls:
    """index: (M,) of returns. strip: (M,), of so many. normal: (M, 2) outwards. of_fit: (strips,) whose piece each is."""

    index: Index
    strip: Index
    normal: Array
    of_fit: Index


@dataclass(frozen=True, slots=True, kw_only=True)
class Bending:
    """per_range_m2: volume, m3, that a metre added to all ranges adds; None where the map shows too little floor.
    contradicted_m3: that the volume would grow by, stood each keyframe where the walls as a whole have it."""

    per_range_m2: float | None
    contradicted_m3: float


def bending(
    point_map: PointMap, grid: Grid, cells: Cells, surface: Surface, footprint: Footprint, floor: Floor,
    pile_m2: Array, piles: Sequence[tuple[Mask, Mask]], faces: Sequence[tuple[EdgeFit, float]],
) -> Bending | None:  # fmt: skip
    """None where the map does not tell its beams.

    Args: pile_m2: (ny, nx) of the material's cells. piles: of each its cells and those of the floor that tells its height.
        faces: straight pieces of wall with the face of material at each, m2.
    """
    returns = _returns(point_map, cells)
    if returns is None:
        return None
    on_walls = _on_walls(returns, footprint)
    place, out = _places(returns, on_walls)
    tilt = _tilts(returns, on_walls, place, out)
    rise, known = _rises(returns, grid, surface, _moved(returns, place, tilt))
    per_range = _volume(grid, floor, pile_m2, piles, rise, known)
    if per_range is not None:
        for fit, face_m2 in faces:
            of_fit = np.isin(on_walls.of_fit, [k for k, f in enumerate(footprint.fits) if f is fit]) & np.isfinite(out)
            per_range += face_m2 * (float(out[of_fit].mean()) if of_fit.any() else 1.0)
    shift = np.zeros((len(returns.keyframe), 3))
    shift[:, :2] = _by_walls(returns.flown, footprint)[returns.keyframe]
    contradicted = _volume(grid, floor, pile_m2, piles, *_rises(returns, grid, surface, shift))
    return Bending(per_range_m2=per_range, contradicted_m3=contradicted or 0.0)


def _volume(
    grid: Grid, floor: Floor, pile_m2: Array, piles: Sequence[tuple[Mask, Mask]], rise: Array, known: Mask
) -> float | None:
    """m3 by which the piles grow, against the floor around them, where the surface rises so; None: too little floor."""
    on_floor = floor.cells & known
    if on_floor.sum() < LEAST_FLOOR_CELLS:
        return None
    x, y = grid.centres()
    design = np.stack([np.ones(grid.shape), x, y], axis=-1)
    rise = rise - design @ np.linalg.lstsq(design[on_floor], rise[on_floor], rcond=None)[0]
    total = 0.0
    for pile, ring in piles:
        beneath = float(rise[ring & known].mean()) if (ring & known).any() else 0.0
        total += float(np.sum((pile_m2 * (rise - beneath))[pile]))
    return total


def _returns(point_map: PointMap, cells: Cells) -> _Returns | None:
    """Some of them, drawn, since they lie in the map row by row."""
    if point_map.scan_index is None or not len(point_map.points_map):
        return None
    count = len(point_map.points_map)
    chosen = np.flatnonzero(np.random.default_rng(0).random(count) * count < MOST_RETURNS)
    points = point_map.points_map[chosen]
    reach = points - point_map.path_map[point_map.scan_index[chosen]]
    flown = np.unique(point_map.keyframe_id)
    return _Returns(
        flown=flown,
        keyframe=np.searchsorted(flown, point_map.keyframe_id[chosen]),
        point=points,
        beam=reach / np.maximum(np.linalg.norm(reach, axis=1), 1e-9)[:, None],
        reach_m=reach,
        cell=(cells.of_point if cells.meets_in is None else cells.meets_in)[chosen],
    )


def _on_walls(returns: _Returns, footprint: Footprint) -> _OnWalls:
    index = np.flatnonzero((returns.cell < 0) & (returns.point[:, 2] < footprint.ceiling_m))
    nearest, strip = np.full(len(index), footprint.margin_m), np.full(len(index), -1.0)
    normal, of_fit = np.zeros((len(index), 2)), np.zeros(0, dtype=np.int64)
    for k, fit in enumerate(footprint.fits):
        off = returns.point[index, :2] - fit.point
        across = np.array([fit.direction[1], -fit.direction[0]])
        along_m, away_m = off @ fit.direction + 0.5 * fit.length_m, np.abs(off @ across)
        here = (along_m >= 0.0) & (along_m < fit.length_m) & (away_m < nearest)
        nearest[here] = away_m[here]
        strip[here] = len(of_fit) + np.floor(along_m[here] / STRIP_M)
        normal[here] = across
        of_fit = np.append(of_fit, np.full(int(fit.length_m / STRIP_M) + 1, k))
    found = strip >= 0
    outwards = np.sign(np.sum(returns.beam[index, :2] * normal, axis=1))  # what is met is met from within
    return _OnWalls(
        index=index[found],
        strip=strip[found].astype(np.int64),
        normal=(normal * outwards[:, None])[found],
        of_fit=of_fit,
    )


def _places(returns: _Returns, walls: _OnWalls) -> tuple[Array, Array]:
    """(K, 2) by how much each keyframe is displaced, and (strips,) how far out the walls stand, by their horizontal returns;
    NaN where there are too few of them. For a metre of offset, as all below."""
    level = np.abs(returns.beam[walls.index, 2]) < LEVEL_SIN
    index, strip, normal = walls.index[level], walls.strip[level], walls.normal[level]
    keyframe, longer = returns.keyframe[index], np.sum(returns.beam[index, :2] * normal, axis=1)
    place, out, count = _agreed(longer, normal, keyframe, len(returns.flown), strip, len(walls.of_fit))
    return place, np.where(count >= LEAST_IN_STRIP, out, np.nan)


def _agreed(
    away: Array, normal: Array, keyframe: Index, keyframes: int, wall: Index, walls: int
) -> tuple[Array, Array, Index]:
    """(K, 2) by how much each keyframe is displaced and (walls,) how far out the walls stand, so that both agree best; (walls,) by
    how many returns. away: (M,) how far out each return lies. normal: (M, 2) of its wall, outwards."""
    count = np.bincount(wall, minlength=walls)
    place, out = np.zeros((keyframes, 2)), np.zeros(walls)
    for _ in range(PASSES):
        seen = away + np.sum(place[keyframe] * normal, axis=1)
        out = np.bincount(wall, seen, minlength=walls) / np.maximum(count, 1)
        place = -_solved(normal, away - out[wall], keyframe, keyframes)
    return place, out, count


def _tilts(returns: _Returns, walls: _OnWalls, place: Array, out: Array) -> Array:
    """(K, 2) by how much each keyframe is turned about map x and y, for walls to stay plumb; its place is free beside."""
    lower = (returns.beam[walls.index, 2] <= -LEVEL_SIN) & np.isfinite(out[walls.strip])
    index, strip, normal = walls.index[lower], walls.strip[lower], walls.normal[lower]
    keyframe, up = returns.keyframe[index], returns.reach_m[index, 2]
    left = np.sum((returns.beam[index, :2] + place[keyframe]) * normal, axis=1) - out[strip]
    rows = np.column_stack([-normal[:, 1] * up, normal[:, 0] * up, normal])
    return -_solved(rows, left, keyframe, len(returns.flown))[:, :2]


def _moved(returns: _Returns, place: Array, tilt: Array) -> Array:
    """(N, 3) by how much each return is displaced: along its beam by one, and as its keyframe is."""
    keyframe, reach = returns.keyframe, returns.reach_m
    moved = returns.beam.copy()
    moved[:, 0] += place[keyframe, 0] + tilt[keyframe, 1] * reach[:, 2]
    moved[:, 1] += place[keyframe, 1] - tilt[keyframe, 0] * reach[:, 2]
    moved[:, 2] += tilt[keyframe, 0] * reach[:, 1] - tilt[keyframe, 1] * reach[:, 0]
    return moved


def _rises(returns: _Returns, grid: Grid, surface: Surface, moved: Array) -> tuple[Array, Mask]:
    """(ny, nx) by how much the surface rises as the returns move, each keyframe at the height that fits the ground, and where
    that was seen: elsewhere (at crests, most of all) it is what it is nearby."""
    on = returns.cell >= 0
    cell, keyframe, moved = returns.cell[on], returns.keyframe[on], moved[on]
    slope_x, slope_y = surface.slope_x.ravel()[cell], surface.slope_y.ravel()[cell]
    above = moved[:, 2] - slope_x * moved[:, 0] - slope_y * moved[:, 1]
    size = grid.shape[0] * grid.shape[1]
    in_cell, of_keyframe = np.bincount(cell, minlength=size), np.bincount(keyframe, minlength=len(returns.flown))
    height, rise = np.zeros(len(returns.flown)), np.zeros(size)
    for _ in range(PASSES):
        rise = np.bincount(cell, above + height[keyframe], minlength=size) / np.maximum(in_cell, 1)
        misfit = np.bincount(keyframe, above - rise[cell], minlength=len(returns.flown))
        height = -misfit / np.maximum(of_keyframe, 1)
    known = (in_cell >= LEAST_IN_CELL).reshape(grid.shape)
    nearest = ndimage.distance_transform_edt(~known, return_distances=False, return_indices=True)
    return rise.reshape(grid.shape)[tuple(nearest)], known


def _by_walls(flown: Index, footprint: Footprint) -> Array:
    """(K, 2) from where each keyframe stands to where it would see the walls as all together see them."""
    fits = footprint.fits
    if not fits:
        return np.zeros((len(flown), 2))
    of_fit = np.repeat(np.arange(len(fits)), [len(fit.members) for fit in fits])
    off = np.concatenate([fit.offsets_m for fit in fits])
    normal = np.array([(fit.direction[1], -fit.direction[0]) for fit in fits])[of_fit]
    keyframe = np.searchsorted(flown, footprint.fit_keyframe[np.concatenate([fit.members for fit in fits])])
    return _agreed(off, normal, keyframe, len(flown), of_fit, len(fits))[0]


def _solved(rows: Array, values: Array, keyframe: Index, keyframes: int) -> Array:
    """(K, P) least squares of values (M,) on rows (M, P), of each keyframe on its own; 0 where nothing tells."""
    unknowns = range(rows.shape[1])
    normal = np.array(
        [[np.bincount(keyframe, rows[:, i] * rows[:, j], minlength=keyframes) for j in unknowns] for i in unknowns]
    )
    right = np.array([np.bincount(keyframe, rows[:, i] * values, minlength=keyframes) for i in unknowns])
    held = normal.transpose(2, 0, 1) + LOOSE * np.eye(rows.shape[1])
    return np.asarray(np.linalg.solve(held, right.T[..., None])[..., 0])
