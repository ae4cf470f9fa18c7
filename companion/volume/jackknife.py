"""How far the volume hangs on single stretches of the flight: the delete-a-group jackknife (Kott, J. Official Statistics 2001).

The keyframes are cut into stretches one after the other. Without each of them in turn the piles, the floor about them
and the walls would lie a little elsewhere; by how much the volume then differs tells what the errors of the poses and
of the returns leave in it. What moves pile, floor and walls alike moves nothing. What drifts on from one stretch into the
next makes neighbours agree, and is told too small: `keyframes.drift_factor` says by how much.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from companion.messages import Array, PointMap
from companion.volume.edges import EdgeFit
from companion.volume.grid import Grid, Index, Mask
from companion.volume.surface import Cells, Surface

STRETCHES = 8  # of a lap: long enough that what drifts differs between them, enough of them to tell a spread
STARTS = 2  # where the first of them begins, by so many parts of one: a spread of eight alone is known to a quarter
LEAST_KEYFRAMES = 3 * STRETCHES


@dataclass(frozen=True, slots=True, kw_only=True)
class Stretches:
    """Who saw what. cell, above_m: (N,) where each return's beam meets the surface, and how far above it the return lies.
    of_point: (STARTS, N) its stretch, for each way to cut the flight. of_wall: (STARTS, F) of each point that the walls
    were fitted to."""

    shape: tuple[int, int]
    cell: Index
    above_m: Array
    of_point: Index
    of_wall: Index

    def spread_m3(
        self, area_m2: Array, piles: Iterable[tuple[Mask, Mask]], walls: Sequence[tuple[EdgeFit, float]]
    ) -> float:
        """1 sigma of the volume by the errors of poses and returns.

        Args: area_m2: (ny, nx) of each cell that counts. piles: of each its cells and those of the floor that tells its
            height. walls: straight pieces with the face of material at each, m2.
        """
        of_piles = [((area_m2 * pile).ravel(), ring.ravel().astype(np.float64)) for pile, ring in piles]
        of_all, variances = self._sums(np.ones(len(self.cell), dtype=np.bool_)), []
        for of_point, of_wall in zip(self.of_point, self.of_wall, strict=True):
            due = np.array([_due_to(self._sums(of_point == k), of_all, of_piles) for k in range(STRETCHES)])
            for fit, face_m2 in walls:
                due += face_m2 * _due_to_wall(fit.offsets_m, of_wall[fit.members])
            variances.append((STRETCHES - 1) * float(np.var(due)))
        return math.sqrt(float(np.mean(variances)))

    def halves_m(self) -> tuple[Array, Array]:
        """(ny, nx) each: how far above the mean of all every other stretch saw the surface, and the others; NaN where they
        did not. What both halves show is of the ground, or of the whole map; what one alone shows is an error of its own."""
        is_odd = self.of_point[0] % 2 == 1
        even, odd, both = (self._sums(half) for half in (~is_odd, is_odd, np.ones_like(is_odd)))
        first, second = (_mean(*half) - _mean(*both) for half in (even, odd))
        return first.reshape(self.shape), second.reshape(self.shape)

    def _sums(self, wanted: Mask) -> tuple[Array, Array]:
        """(cells,) how many of these returns are in each, and the sum of how far they lie above the surface."""
        cell, size = self.cell[wanted], self.shape[0] * self.shape[1]
        count = np.bincount(cell, minlength=size).astype(np.float64)
        return count, np.bincount(cell, self.above_m[wanted], minlength=size).astype(np.float64)


def cut_in_stretches(
    point_map: PointMap, grid: Grid, cells: Cells, surface: Surface, wall_keyframe: Index
) -> Stretches | None:
    """The map that gave `cells` and `surface`, by stretches of the flight; None: too few keyframes to tell any.

    wall_keyframe: (F,) of the points that the walls were fitted to, by `EdgeFit.members`.
    """
    flown = np.unique(point_map.keyframe_id)
    if len(flown) < LEAST_KEYFRAMES:
        return None
    if cells.meets_in is None or cells.above_m is None:
        cell, above = cells.of_point, _above_surface(point_map.points_map, cells.of_point, grid, surface)
    else:
        cell, above = cells.meets_in, cells.above_m
    known = (cell >= 0) & np.isfinite(above)
    order = np.searchsorted(flown, point_map.keyframe_id[known])
    wall_order = np.searchsorted(flown, wall_keyframe)
    of_point, of_wall = (stretch_of(n, len(flown)) for n in (order, wall_order))
    return Stretches(shape=grid.shape, cell=cell[known], above_m=above[known], of_point=of_point, of_wall=of_wall)


def stretch_of(order: Index, flown: int) -> Index:
    """(STARTS, N) stretch of each keyframe, for each way to cut a flight of so many. order: (N,) from 0."""
    begins = [start * flown // (STARTS * STRETCHES) for start in range(STARTS)]
    return np.array([(order + begin) * STRETCHES // flown % STRETCHES for begin in begins])


def _mean(count: Array, total: Array) -> Array:
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1.0), np.nan))


def _above_surface(points: Array, cell: Index, grid: Grid, surface: Surface) -> Array:
    """(N,) how far each point lies above the surface, along z; of no meaning where cell is -1."""
    x, y = (c.ravel()[cell] for c in grid.centres())
    z, gx, gy = (v.ravel()[cell] for v in (surface.z_m, surface.slope_x, surface.slope_y))
    return np.asarray(points[:, 2] - z - gx * (points[:, 0] - x) - gy * (points[:, 1] - y))


def _due_to(stretch: tuple[Array, Array], of_all: tuple[Array, Array], piles: Sequence[tuple[Array, Array]]) -> float:
    """What of the volume is due to a stretch's differing from the others: piles against the floor around them."""
    (count, total), (all_count, all_total) = stretch, of_all
    others = all_count - count
    both = (count > 0) & (others > 0)
    differs = np.where(both, total / np.maximum(count, 1) - (all_total - total) / np.maximum(others, 1), 0.0)
    told_by = count * others / np.maximum(all_count, 1)  # returns

    def mean(area: Array) -> float:
        """Over the area that anybody saw. Where this stretch alone looked, it differs by what it does elsewhere."""
        elsewhere = float(differs @ (told_by * area)) / max(float(told_by @ area), 1e-12)
        alone = float(area @ ((count > 0) & (others == 0)))
        shared = float(differs @ (area * count / np.maximum(all_count, 1)))
        return (shared + alone * elsewhere) / max(float(area @ (all_count > 0)), 1e-12)

    return sum(float(pile.sum()) * (mean(pile) - mean(ring)) for pile, ring in piles)


def _due_to_wall(offsets_m: Array, stretch: Index) -> Array:
    """(STRETCHES,) how far out the wall lies by each stretch's differing from the others."""
    count = np.bincount(stretch, minlength=STRETCHES).astype(np.float64)
    total = np.bincount(stretch, offsets_m, minlength=STRETCHES)
    others = count.sum() - count
    differs = total / np.maximum(count, 1) - (total.sum() - total) / np.maximum(others, 1)
    return np.where((count > 0) & (others > 0), differs * count / max(float(count.sum()), 1.0), 0.0)
