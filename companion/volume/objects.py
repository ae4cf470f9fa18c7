"""Boxes, bins, machines: what stands with upright sides all around is not material.

Loose material lies at its angle of repose, at most some 45 deg. A thing that is steep along nearly all of its outline
was put there; a pile with one dug face is not. What stands in the foot of a pile, or beside it, shows such an outline
only from some height on: so outlines are looked at level by level, from the floor up. Where too little of one is steep,
nobody can tell from heights alone: it is counted, and said. They are looked for in cells of LARGEST_CELL_M at most: over two cells
of 0.4 m a box of 1.2 m rises no steeper than loose material may.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from companion.messages import Array
from companion.volume.grid import Grid, Mask, disc

STEEP = 1.5  # rise over run across two cells, corners too: 45 deg gives 1.41 there
FACE = 2.2  # the same within the material, where an uneven flank may be steep for a step
LARGEST_CELL_M = 0.25
LEAST_HEIGHT_M = 0.3
LEVEL_M = 0.3  # from one outline to the next
LEAST_ABOVE_M = 0.4  # what rises less above its outline is a clod
LARGEST_AREA_M2 = 40.0
LEAST_AREA_M2 = 0.2  # on the floor
LEAST_AREA_IN_PILE_M2 = 0.5
UPRIGHT_SHARE = 0.6  # of the outline: corners and hidden sides blur
DOUBTED_SHARE = 0.3  # from here on it may be one that a pile hides in part
LEVEL_TOP = 0.3  # spread of heights over the height above the outline
RIM_CELLS = 2
LEAST_STEEP_M2 = 1.0  # of steep cells within the pile before it is said


@dataclass(frozen=True, slots=True, kw_only=True)
class Objects:
    """share: of each cell, (ny, nx), that objects stand on. covered: the cells that they, and the rim that their returns blur,
    lie in. doubtful_m3: what is counted and may be objects."""

    share: Array
    covered: Mask
    doubtful_m3: float
    warnings: tuple[str, ...]


def find_objects(grid: Grid, height: Array, inside: Mask, trusted: Mask) -> Objects:
    """Find what stands upright. height: (ny, nx) above the floor; trusted: cells seen, away from the walls."""
    h = np.where(inside, height, 0.0)
    rise = ndimage.maximum_filter(h, 3) - ndimage.minimum_filter(h, 3)
    steep = (rise > STEEP * 2 * grid.cell_m) & trusted
    face = (rise > FACE * 2 * grid.cell_m) & trusted
    cells, covered, doubted = (np.zeros(grid.shape, dtype=np.bool_) for _ in range(3))
    warnings: list[str] = []
    doubtful: list[tuple[Mask, float]] = []
    for level in np.arange(LEAST_HEIGHT_M, max(float(h.max()) - LEAST_ABOVE_M, 2 * LEAST_HEIGHT_M), LEVEL_M):
        on_floor = level == LEAST_HEIGHT_M
        for body in _bodies(
            grid, (h > level) & inside & ~covered, LEAST_AREA_M2 if on_floor else LEAST_AREA_IN_PILE_M2
        ):
            if not on_floor and float(h[body].max()) < level + LEAST_ABOVE_M:
                continue
            share = _upright_share(body, steep if on_floor else face)
            if share >= UPRIGHT_SHARE:
                cells |= body
                covered |= ndimage.binary_dilation(body, disc(RIM_CELLS))
                warnings.append(_said(grid, h, body))
            elif share >= DOUBTED_SHARE and not (doubted & body).any() and _has_level_top(h, body, float(level)):
                doubted |= body
                doubtful.append((body, float((h[body] - level).sum()) * grid.cell_area_m2))
    left = face & ~covered
    area, doubtful_m3 = float(left.sum()) * grid.cell_area_m2, 0.0
    if area > LEAST_STEEP_M2:
        doubtful_m3 = float(h[left].sum()) * grid.cell_area_m2
        doubtful_m3 += sum(above_m3 for body, above_m3 in doubtful if not (body & covered).any())
        warnings.append(
            f"upright faces over {area:.1f} m2 within the material: a dug face, or an object that touches it; it is counted"
        )
    return Objects(
        share=cells.astype(np.float64),
        covered=covered,
        doubtful_m3=doubtful_m3,
        warnings=tuple(warnings),
    )


def on_grid(objects: Objects, of: Grid, grid: Grid) -> Objects:
    """Objects that were found on a finer grid, on this one."""
    x, y = of.centres()
    key = grid.key(np.column_stack([x.ravel(), y.ravel()]))
    fine = np.maximum(grid.count(key), 1.0)
    share = np.bincount(key[key >= 0], objects.share.ravel()[key >= 0], minlength=fine.size).reshape(grid.shape) / fine
    covered = grid.count(np.where(objects.covered.ravel(), key, -1)) > 0
    return replace(objects, share=share, covered=covered)


def without_objects(grid: Grid, height: Array, covered: Mask, inside: Mask) -> Array:
    """Heights with each covered patch laid on the plane of what is around it."""
    covered = covered & inside
    out = height.copy()
    x, y = grid.centres()
    label, n = ndimage.label(covered)
    for i in range(1, n + 1):
        patch = label == i
        around = ndimage.binary_dilation(patch, disc(RIM_CELLS)) & inside & ~covered
        if around.sum() < 3:
            continue
        design = np.stack([np.ones(grid.shape), x - x[patch].mean(), y - y[patch].mean()], axis=-1)
        plane = np.linalg.lstsq(design[around], height[around], rcond=None)[0]
        out[patch] = np.clip(design[patch] @ plane, min(0.0, float(height[around].min())), height[around].max())
    return out


def _bodies(grid: Grid, above: Mask, least_m2: float) -> list[Mask]:
    label, n = ndimage.label(above)
    sizes = np.bincount(label.ravel(), minlength=n + 1)[1:] * grid.cell_area_m2
    return [label == i + 1 for i in np.flatnonzero((sizes >= least_m2) & (sizes <= LARGEST_AREA_M2))]


def _upright_share(body: Mask, steep: Mask) -> float:
    """Of its outline."""
    outline = body & ~ndimage.binary_erosion(body)
    upright = ndimage.binary_dilation(steep & ndimage.binary_dilation(body))
    return float(upright[outline].mean())


def _has_level_top(h: Array, body: Mask, level: float) -> bool:
    """As things have, and loose material with flanks as steep has not."""
    top = h[ndimage.binary_erosion(body)]
    if top.size < 3:
        return True
    low, middle, high = np.quantile(top, [0.1, 0.5, 0.9])
    return bool(high - low < LEVEL_TOP * (middle - level))


def _said(grid: Grid, h: Array, body: Mask) -> str:
    row, column = (float(c) for c in ndimage.center_of_mass(body))
    return (
        f"an object with upright sides near x {grid.x0_m + (column + 0.5) * grid.cell_m:.1f} m, "
        f"y {grid.y0_m + (row + 0.5) * grid.cell_m:.1f} m, about {float(h[body].sum()) * grid.cell_area_m2:.1f} m3, "
        "is not counted as material"
    )
