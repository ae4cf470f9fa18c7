"""Boxes, bins, machines: what stands on the floor with upright sides all around is not material.

Loose material lies at its angle of repose, at most some 45 deg. A thing that is steep along nearly all of its outline
was put there; a pile with one dug face is not. Where such a thing touches the pile, nobody can tell from heights
alone: it is counted, and said.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from companion.messages import Array
from companion.volume.grid import Grid, Mask, disc

STEEP = 1.5  # rise over run across two cells, corners too: 45 deg gives 1.41 there
FACE = 2.2  # the same within the material, where an uneven flank may be steep for a step
LEAST_HEIGHT_M = 0.3
LARGEST_AREA_M2 = 40.0
UPRIGHT_SHARE = 0.6  # of the outline: corners and hidden sides blur
LEAST_STEEP_M2 = 1.0  # of steep cells within the pile before it is said


@dataclass(frozen=True, slots=True, kw_only=True)
class Objects:
    """cells: covered by objects, with the rim that their returns blur. steep: upright faces that belong to none."""

    cells: Mask
    steep: Mask  # empty where there is too little of it to be said
    warnings: tuple[str, ...]


def find_objects(grid: Grid, height: Array, inside: Mask, trusted: Mask) -> Objects:
    """Find what stands upright. height: (ny, nx) above the floor; trusted: cells seen, away from the walls."""
    h = np.where(inside, height, 0.0)
    rise = ndimage.maximum_filter(h, 3) - ndimage.minimum_filter(h, 3)
    steep = (rise > STEEP * 2 * grid.cell_m) & trusted
    label, n = ndimage.label((h > LEAST_HEIGHT_M) & inside)
    covered = np.zeros(grid.shape, dtype=np.bool_)
    warnings: list[str] = []
    sizes = np.bincount(label.ravel(), minlength=n + 1) * grid.cell_area_m2
    for i in np.flatnonzero((sizes[1:] >= 0.2) & (sizes[1:] <= LARGEST_AREA_M2)) + 1:
        body = label == i
        outline = body & ~ndimage.binary_erosion(body)
        upright = ndimage.binary_dilation(steep & ndimage.binary_dilation(body))
        if upright[outline].mean() < UPRIGHT_SHARE:
            continue
        covered |= ndimage.binary_dilation(body, disc(2))
        volume = float(h[body].sum()) * grid.cell_area_m2
        row, column = (float(c) for c in ndimage.center_of_mass(body))
        warnings.append(
            f"an object with upright sides near x {grid.x0_m + (column + 0.5) * grid.cell_m:.1f} m, "
            f"y {grid.y0_m + (row + 0.5) * grid.cell_m:.1f} m, about {volume:.1f} m3, is not counted as material"
        )
    left = (rise > FACE * 2 * grid.cell_m) & trusted & ~covered
    area = float(left.sum()) * grid.cell_area_m2
    if area <= LEAST_STEEP_M2:
        left = np.zeros(grid.shape, dtype=np.bool_)
    else:
        warnings.append(
            f"upright faces over {area:.1f} m2 within the material: a dug face, or an object that touches it; it is counted"
        )
    return Objects(cells=covered & inside, steep=left, warnings=tuple(warnings))
