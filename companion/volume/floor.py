"""One honest floor: the lowest consistent plane, fitted to the cells that are floor and to no toe of the pile."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from companion.messages import Array
from companion.volume.grid import Grid, Index, Mask, cells_of, disc, squares

MAX_SLOPE = 0.12  # steeper than any floor that trucks drive on; loose material at rest is far steeper
TRIALS = 500
LEAST_CELLS = 50  # of bare floor, away from all that rises
LEAST_BEYOND = 0.25  # of the floor's cells, so that those beyond the material tell it
SURE_SHARE = 0.1  # of all cells, on one plane
BENT_M = 0.1  # what a floor departs from its plane by, where the attitude that mapped it was off
FROM_M, TO_M = 1.0, 3.0  # beyond a pile's rim: floor that tells how high it lies beneath; nearer its foot may run out
LEAST_IN_BLOCK, LEAST_BLOCKS, LEAST_AROUND = 6, 4, 6
BLOCK_M = 3.0  # floors undulate over a few metres: residuals are judged in blocks of this size


@dataclass(frozen=True, slots=True, kw_only=True)
class Floor:
    """z = plane[0] + plane[1] (x - centre x) + plane[2] (y - centre y), map.

    cells: which were taken as floor. covariance: (3, 3) of plane. undulation_m: 1 sigma of the floor about the plane
    over blocks of BLOCK_M. residual_m: 1 sigma of single cells. found: False where no floor could be told.
    """

    plane: Array
    centre_m: Array
    covariance: Array
    cells: Mask
    undulation_m: float
    residual_m: float
    found: bool

    def z(self, x: Array, y: Array) -> Array:
        return np.asarray(
            self.plane[0] + self.plane[1] * (x - self.centre_m[0]) + self.plane[2] * (y - self.centre_m[1])
        )


def fit_floor(grid: Grid, x: Array, y: Array, z: Array, sigma: Array, usable: Mask) -> Floor:
    """Fit the floor. x, y, z, sigma: (ny, nx) cell centroids and the 1 sigma of z; usable: the cells to look at."""
    index: Index = np.flatnonzero(usable).astype(np.int64)
    centre = np.array([np.mean(x.ravel()[index]), np.mean(y.ravel()[index])]) if len(index) else np.zeros(2)
    nothing = np.zeros(grid.shape, dtype=np.bool_)
    if len(index) < 20:
        return Floor(
            plane=np.zeros(3),
            centre_m=centre,
            covariance=np.eye(3),
            cells=nothing,
            undulation_m=0.0,
            residual_m=0.0,
            found=False,
        )
    px, py, pz = (v.ravel()[index] for v in (x, y, z))
    design = np.column_stack([np.ones(len(index)), px - centre[0], py - centre[1]])
    tolerance = float(np.clip(3.0 * np.median(sigma.ravel()[index]), 0.04, 0.25))
    plane, cells = _settled(grid, index, design, pz, _lowest_plane(design, pz, tolerance), tolerance)
    if cells.sum() >= SURE_SHARE * len(index):  # it is floor: now all of it, also where the map is bent
        wide = max(tolerance, BENT_M)
        plane, cells = _settled(grid, index, design, pz, _lowest_plane(design, pz, wide), wide)
    chosen = cells.ravel()[index]
    if _is_toe(grid, index, design, pz, plane, chosen, cells):
        cells, chosen = nothing, np.zeros_like(chosen)
    return _judged(grid, plane, centre, design, pz, chosen, cells, index)


def floor_beyond(floor: Floor, grid: Grid, x: Array, y: Array, z: Array, material: Mask) -> Floor:
    """The same floor told by what of it lies beyond the material, however thin that runs out; as it is where little does.

    x, y, z: (ny, nx) cell centroids. material: (ny, nx), with its rim.
    """
    beyond = floor.cells & ~material
    if not floor.found or beyond.sum() < max(LEAST_CELLS, LEAST_BEYOND * floor.cells.sum()):
        return floor
    index = np.flatnonzero(beyond).astype(np.int64)
    px, py, pz = (v.ravel()[index] for v in (x, y, z))
    design = np.column_stack([np.ones(len(index)), px - floor.centre_m[0], py - floor.centre_m[1]])
    plane = np.asarray(np.linalg.lstsq(design, pz, rcond=None)[0], dtype=np.float64)
    told = _judged(grid, plane, floor.centre_m, design, pz, np.ones(len(index), dtype=np.bool_), beyond, index)
    return told if told.found else floor


def _settled(grid: Grid, index: Index, design: Array, z: Array, plane: Array, tolerance: float) -> tuple[Array, Mask]:
    """The plane and its cells, from a plane near it, with a tolerance that shrinks to what they spread by."""
    cells = np.zeros(grid.shape, dtype=np.bool_)
    for _ in range(6):
        cells = _floor_cells(grid, index, design, z, plane, tolerance)
        chosen = cells.ravel()[index]
        if chosen.sum() < 10:
            break
        plane = np.asarray(np.linalg.lstsq(design[chosen], z[chosen], rcond=None)[0], dtype=np.float64)
        spread = 1.4826 * float(np.median(np.abs(z[chosen] - design[chosen] @ plane)))
        tolerance = float(np.clip(3.5 * spread, 0.03, tolerance))
    return plane, cells


def level_floor(grid: Grid, z_m: float) -> Floor:
    """A floor that somebody knows."""
    return Floor(
        plane=np.array([z_m, 0.0, 0.0]),
        centre_m=np.zeros(2),
        covariance=np.zeros((3, 3)),
        cells=np.zeros(grid.shape, dtype=np.bool_),
        undulation_m=0.0,
        residual_m=0.0,
        found=True,
    )


def floor_beside(
    grid: Grid, floor: Floor, height: Array, pile: Mask, halves: tuple[Array, Array] | None = None
) -> tuple[Array, Array]:
    """How far the floor under each pile lies above the plane, as the floor around it tells, and its 1 sigma.

    Floors undulate, and a map whose attitude drifted is bent: what lies about a pile was seen by the same scans as the
    pile, so its departure is the pile's own. The sigma is NaN where too little floor lies around: the plane has to do.

    Args: height: (ny, nx) of the surface above the plane. pile: (ny, nx), with its rim of floor. halves: (ny, nx) each,
        how far above the surface half of the flight saw it: then the sigma holds only what both halves show, the
        ground's own waves and the map's; without, what its returns and poses err by too.
    Returns: (ny, nx) each, in m; zero and NaN outside the piles.
    """
    rise, sigma = np.zeros(grid.shape), np.full(grid.shape, np.nan)
    for own, ring in floor_around(grid, floor, pile):
        # Where it leans, the middle is still its mean: what counts is how far it departs from a plane.
        left = _about_planes(grid, ring, height)
        if left is None:
            continue
        blocks = len(left[0])
        error2 = float(np.sum(left[0] ** 2)) / (blocks - 3) / blocks
        # As far as it stands out from what a ring tells by chance.
        trust = floor.undulation_m**2 / max(floor.undulation_m**2 + error2, 1e-12)
        rise[own] = trust * float(np.mean(height[ring]))
        shared2 = None if halves is None else _shared2(grid, halves, height, ring)
        sigma[own] = np.sqrt(error2 if shared2 is None else shared2 / blocks)
    return rise, sigma


def waves_m(grid: Grid, floor: Floor, height: Array, halves: tuple[Array, Array] | None) -> float:
    """1 sigma of the bare floor about its plane over blocks of BLOCK_M: with halves only of what both of them show."""
    shared2 = None if halves is None else _shared2(grid, halves, height, floor.cells)
    return floor.undulation_m if shared2 is None else float(np.sqrt(shared2))


def _shared2(grid: Grid, halves: tuple[Array, Array], height: Array, where: Mask) -> float | None:
    """Covariance, over blocks, of the heights that two halves of a flight saw, each about its own plane; at least 0.
    None: too few blocks that both saw."""
    both = where & np.isfinite(halves[0]) & np.isfinite(halves[1])
    left = _about_planes(grid, both, height + halves[0], height + halves[1])
    return None if left is None else max(float(left[0] @ left[1]) / (len(left[0]) - 3), 0.0)


def _about_planes(grid: Grid, where: Mask, *heights: Array) -> list[Array] | None:
    """Of each (ny, nx) of heights its means over blocks of BLOCK_M within `where`, about their own plane. None: too few."""
    _, of_block = np.unique(squares(grid, BLOCK_M)[where], return_inverse=True)
    count = np.bincount(of_block)
    full = count >= LEAST_IN_BLOCK
    if full.sum() < LEAST_AROUND:
        return None
    row_at, column_at, *means = (
        (np.bincount(of_block, v[where]) / count)[full] for v in (*np.indices(grid.shape).astype(np.float64), *heights)
    )
    design = np.column_stack([np.ones(len(row_at)), row_at, column_at])
    return [m - design @ np.linalg.lstsq(design, m, rcond=None)[0] for m in means]


def floor_around(grid: Grid, floor: Floor, pile: Mask) -> Iterator[tuple[Mask, Mask]]:
    """Of each pile its cells, and those of the bare floor around it."""
    label, n = ndimage.label(pile)
    near = ndimage.binary_dilation(pile, disc(cells_of(FROM_M, grid)))
    for k in range(1, n + 1):
        own = np.asarray(label == k)
        yield own, np.asarray(ndimage.binary_dilation(own, disc(cells_of(TO_M, grid))) & ~near & floor.cells)


def _lowest_plane(design: Array, z: Array, tolerance: float) -> Array:
    """The plane with the most cells upon it and the fewest beneath it (a pile's flat top has many beneath)."""
    rng = np.random.default_rng(0)
    subset = rng.permutation(len(z))[:4000]
    d, zs = design[subset], z[subset]
    low = np.argsort(zs)[: max(len(zs) * 2 // 3, 10)]
    best, best_score = np.array([float(np.quantile(zs, 0.1)), 0.0, 0.0]), -np.inf
    extent = float(max(np.ptp(d[:, 1]), np.ptp(d[:, 2]), 1.0))
    candidates = [best]
    for _ in range(TRIALS):
        pick = rng.choice(low, 3, replace=False)
        three = d[pick]
        if abs(np.linalg.det(three)) > 0.005 * extent**2:
            candidates.append(np.linalg.solve(three, zs[pick]))
    for plane in candidates:
        if np.hypot(plane[1], plane[2]) > MAX_SLOPE:
            continue
        r = zs - d @ plane
        score = float(np.sum(np.abs(r) < tolerance)) - 3.0 * float(np.sum(r < -tolerance))
        if score > best_score:
            best, best_score = plane, score
    return best


def _floor_cells(grid: Grid, index: Index, design: Array, z: Array, plane: Array, tolerance: float) -> Mask:
    """Cells on the plane, away from everything that rises above it (so that no toe of the pile lifts the floor)."""
    r = z - design @ plane
    on = np.zeros(grid.shape, dtype=np.bool_)
    above = np.zeros(grid.shape, dtype=np.float64)
    known = np.zeros(grid.shape, dtype=np.float64)
    on.ravel()[index] = np.abs(r) < tolerance
    above.ravel()[index] = np.clip(r / tolerance, -1.5, 4.0)
    known.ravel()[index] = 1.0
    # Rising ground: the mean over a window is above, which single noisy cells are not.
    size = 2 * cells_of(0.5, grid) + 1
    share = ndimage.uniform_filter(known, size, mode="constant")
    mean = ndimage.uniform_filter(above, size, mode="constant") / np.maximum(share, 1e-9)
    rising = (mean > 0.6) & (share > 0.05)
    near_rising = ndimage.binary_dilation(rising, disc(cells_of(0.75, grid)))
    chosen = on & ~near_rising
    return np.asarray(chosen if chosen.sum() >= LEAST_CELLS else on)


def _is_toe(grid: Grid, index: Index, design: Array, z: Array, plane: Array, chosen: Mask, cells: Mask) -> bool:
    """Whether what was taken as floor is but the toe of a pile: everything beside it rises, nothing goes on level."""
    if not chosen.any():
        return False
    beside = ndimage.binary_dilation(cells, disc(cells_of(0.75, grid)))
    around = beside.ravel()[index] & ~chosen
    r = z - design @ plane
    spread = 3.0 * max(1.4826 * float(np.median(np.abs(r[chosen]))), 0.02)
    rising = int((r[around] > spread).sum())
    return chosen.sum() < LEAST_CELLS or rising > 2 * int(chosen.sum())


def _judged(
    grid: Grid, plane: Array, centre: Array, design: Array, z: Array, chosen: Mask, cells: Mask, index: Index
) -> Floor:
    r = (z - design @ plane)[chosen]
    d = design[chosen]
    residual = float(np.std(r)) if len(r) else 0.0
    block = np.floor(d[:, 1:] / BLOCK_M).astype(np.int64)
    _, of_block = np.unique(block, axis=0, return_inverse=True)
    n = np.bincount(of_block) if len(r) else np.zeros(0)
    full = n >= LEAST_IN_BLOCK
    covariance: Array = np.eye(3)
    undulation = 0.1
    if full.sum() >= LEAST_BLOCKS:
        means = (np.bincount(of_block, r) / n)[full]
        undulation = float(np.sqrt(max(float(np.var(means)) - float(np.mean(residual**2 / n[full])), 0.0)))
        rows = np.column_stack([np.bincount(of_block, d[:, i]) / n for i in range(3)])[full]
        information = rows.T @ rows
        per_block = float(np.var(means)) * len(means) / max(len(means) - 3, 1)
        covariance = np.asarray(per_block * np.linalg.pinv(information), dtype=np.float64)
    return Floor(
        plane=plane,
        centre_m=centre,
        covariance=covariance,
        cells=cells,
        undulation_m=undulation,
        residual_m=residual,
        found=bool(full.sum() >= LEAST_BLOCKS),
    )
