"""Where material lies: what stands out from the floor, its foot as far as it runs out, and a rim of floor around it.

A foot that runs out thin is lost in the noise of single cells. The mean of many tells it: the wider the window about a
place, the thinner the material that it tells, down to the floor's own waves. What is told so must hang together with
what is sure.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from companion.messages import Array
from companion.volume.floor import Floor
from companion.volume.grid import Grid, Mask, cells_of, disc
from companion.volume.surface import Cells

RIM_M = 1.5  # of floor, around the material
LEAST_PILE_M = 0.12  # that a heap rises to
LEAST_PILE_M2 = 1.0
LEAST_FOOT_M = 0.03
WINDOWS_M = (0.75, 1.5)  # to either side of a place
LEAST_TAIL_M = 0.005
SURE_SIGMA = 3.0
LEAST_CELLS = 8  # in a window


def pile_mask(height: Array, inside: Mask, cells: Cells, floor: Floor, grid: Grid) -> Mask:
    """Where material lies, with a rim of floor all around it.

    The rim (RIM_M) makes the choice free of bias: heights are summed with their sign, and a foot too thin to be told
    from noise is within the rim.
    """
    size = 2 * cells_of(0.25, grid) + 1
    known = inside.astype(np.float64)
    smooth = ndimage.uniform_filter(height * known, size, mode="constant")
    smooth /= np.maximum(ndimage.uniform_filter(known, size, mode="constant"), 1e-9)
    noise = float(np.nanmedian(cells.sigma_m[cells.seen])) if cells.seen.any() else 0.05
    least = max(LEAST_PILE_M, 4.0 * noise)
    label, n = ndimage.label((smooth > least) & inside)
    area = np.bincount(label.ravel(), minlength=n + 1) * grid.cell_area_m2
    area[0] = 0.0
    sure = area[label] >= LEAST_PILE_M2
    # Its foot may run out far: as far as it goes on, above what the floor departs from its plane by.
    foot = (smooth > np.clip(3.0 * floor.residual_m, LEAST_FOOT_M, least)) & inside
    material = np.asarray(ndimage.binary_propagation(sure, mask=foot))
    cell_sigma_m = max(floor.residual_m, noise)
    for to_side_m in WINDOWS_M:
        material = _with_its_tail(
            material, height, inside & cells.seen, cell_sigma_m, floor.undulation_m, grid, to_side_m
        )
    return np.asarray(ndimage.binary_dilation(material, disc(cells_of(RIM_M, grid))) & inside)


def _with_its_tail(
    material: Mask, height: Array, seen: Mask, cell_sigma_m: float, waves_m: float, grid: Grid, to_side_m: float
) -> Mask:
    """And what is beside it where the mean of a window, without what is material already, rises above the floor.

    cell_sigma_m, waves_m: 1 sigma of bare floor, of single cells and of whole windows.
    """
    beside = (seen & ~material).astype(np.float64)
    size = 2 * cells_of(to_side_m, grid) + 1
    share = ndimage.uniform_filter(beside, size, mode="constant")
    mean = ndimage.uniform_filter(height * beside, size, mode="constant") / np.maximum(share, 1e-9)
    count = share * size**2
    sigma = np.sqrt(cell_sigma_m**2 / np.maximum(count, 1.0) + waves_m**2)
    tail = (mean > np.maximum(SURE_SIGMA * sigma, LEAST_TAIL_M)) & (count >= LEAST_CELLS) & (beside > 0)
    return np.asarray(ndimage.binary_propagation(material, mask=material | tail))
