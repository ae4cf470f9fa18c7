"""Where the material meets the walls: the last half metre, in which its returns and the wall's are mixed.

A slope carried on to the wall is wrong where the material bends just there (a crest beside the wall, a valley at its
foot). But the wall's own returns tell: above the contact there are some, below it there are none, and what lies
before the wall lies on the material. So the height of the contact is that which explains the returns best, each as
one of the wall or one of the material, whichever is nearer.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from companion.messages import Array
from companion.volume.grid import Grid, Index, Mask
from companion.volume.polygon import along_edges

STEP_M = 0.5  # along the wall
WINDOW = np.array([0.5, 1.0, 0.5])  # over neighbouring steps
BEND = 0.35  # 1 sigma of how much steeper or flatter a flank gets within the strip, before anything was seen there
OFFSETS_M = np.arange(-1.5, 1.501, 0.03)
LEAST_HEIGHT_M = 0.3  # a foot lower than this is floor as far as the contact goes
OUTLIER = 3.0  # sigma
CORRELATED = 4.0  # returns of one ring of the sensor share its pose: so many tell as much as one


@dataclass(frozen=True, slots=True, kw_only=True)
class Contact:
    """What to add to the carried-on surface. All (ny, nx).

    rise_m: 0 outside the strip. sigma_m: 1 sigma of it. step: along the wall, errors of two steps are one's own; -1.
    """

    rise_m: Array
    sigma_m: Array
    step: Index


def fit_contact(
    grid: Grid, points: Array, key: Index, polygon: Array, carried_m: Array, height_m: Array, strip: Mask,
    *, width_m: float, noise_m: float,
) -> Contact:  # fmt: skip
    """Fit the contact along all walls.

    points: (N, 3); key: (N,) their cells. carried_m: (ny, nx) the surface carried on, within the strip and beyond the
    walls. height_m: the same above the floor. strip: cells of the strip inside the walls. width_m: from the wall to
    where the surface is known by its own returns. noise_m: 1 sigma of a wall return.
    """
    rise, sigma_m = np.zeros(grid.shape), np.zeros(grid.shape)
    step_of = np.full(grid.shape, -1, dtype=np.int64)
    material = strip & (height_m > LEAST_HEIGHT_M)
    if not material.any() or noise_m <= 0.0:
        return Contact(rise_m=rise, sigma_m=sigma_m, step=step_of)
    reach = int(np.ceil(OUTLIER * noise_m / grid.cell_m)) + 1
    looked_at = ndimage.binary_dilation(material, iterations=reach)
    near = np.flatnonzero((key >= 0) & looked_at.ravel()[np.maximum(key, 0)])
    steps = int(_perimeter(polygon) / STEP_M) + 1
    step, share, depth, wall_z, edge_z = _profile(grid, polygon, carried_m, points[near], width_m)
    used = (depth > -OUTLIER * noise_m) & (depth < width_m)
    used &= np.abs(points[near, 2] - wall_z) < 2.0 * OFFSETS_M[-1]
    cost = _costs(
        points[near[used], 2], step[used].astype(np.int64), share[used], depth[used], wall_z[used], edge_z[used],
        steps, width_m, noise_m,
    )  # fmt: skip
    offset, sigma = _posterior(cost, width_m)
    rows, columns = np.nonzero(strip & (height_m > 0.0))
    cx, cy = grid.centres()
    at = np.column_stack([cx[rows, columns], cy[rows, columns]])
    step, share, _, wall_z, edge_z = _profile(grid, polygon, carried_m, at, width_m)
    # Below the least height nothing changes, and it comes in by degrees.
    part = np.clip(height_m[rows, columns] / LEAST_HEIGHT_M, 0.0, 1.0)
    met = edge_z + share * (wall_z + np.interp(step - 0.5, np.arange(steps), offset, period=steps) - edge_z)
    rise[rows, columns] = part * (met - carried_m[rows, columns])
    sigma_m[rows, columns] = part * share * np.interp(step - 0.5, np.arange(steps), sigma, period=steps)
    step_of[rows, columns] = step.astype(np.int64)
    return Contact(rise_m=rise, sigma_m=sigma_m, step=step_of)


def _profile(
    grid: Grid, polygon: Array, carried_m: Array, p: Array, width: float
) -> tuple[Array, Array, Array, Array, Array]:
    """Of places near the walls: step along them, share of the way to the wall, depth; and of the profile across the
    strip there the carried-on height at the wall, and the height where the strip ends."""
    along, depth, normal = along_edges(polygon, p[:, 0], p[:, 1])
    wall_z = _interpolated(grid, carried_m, p[:, :2] - depth[:, None] * normal)
    edge_z = _interpolated(grid, carried_m, p[:, :2] + (width - depth)[:, None] * normal)
    return along / STEP_M, np.clip(1.0 - depth / width, 0.0, 1.0), depth, wall_z, edge_z


def _costs(
    z: Array, step: Index, share: Array, depth: Array, wall_z: Array, edge_z: Array, steps: int, width: float,
    noise: float,
) -> Array:  # fmt: skip
    """(steps, offsets): squared misfit in sigma of the returns near each step of the wall, for each offset."""
    cost = np.empty((steps, len(OFFSETS_M)))
    for i, offset in enumerate(OFFSETS_M):
        drop = wall_z + offset - edge_z
        to_material = (z - edge_z - share * drop) / np.hypot(1.0, drop / width)
        to_wall = np.hypot(depth, np.minimum(z - wall_z - offset, 0.0))
        miss = np.minimum(np.minimum(np.abs(to_material), to_wall) / noise, OUTLIER)
        cost[:, i] = np.bincount(step, miss**2, minlength=steps)[:steps]
    return np.asarray(ndimage.convolve1d(cost, WINDOW, axis=0, mode="wrap"))


def _posterior(cost: Array, width: float) -> tuple[Array, Array]:
    """Mean and 1 sigma of the offset at each step of the wall."""
    prior = (OFFSETS_M / (BEND * width)) ** 2
    log = -0.5 * (cost / CORRELATED + prior)
    weight = np.exp(log - log.max(axis=1, keepdims=True))
    weight /= weight.sum(axis=1, keepdims=True)
    mean = weight @ OFFSETS_M
    return mean, np.sqrt(np.maximum(weight @ OFFSETS_M**2 - mean**2, 0.0))


def _interpolated(grid: Grid, values: Array, p: Array) -> Array:
    """Values of the grid at the points, linear between the cells' centres."""
    row = (p[:, 1] - grid.y0_m) / grid.cell_m - 0.5
    column = (p[:, 0] - grid.x0_m) / grid.cell_m - 0.5
    return np.asarray(ndimage.map_coordinates(values, [row, column], order=1, mode="nearest"))


def _perimeter(polygon: Array) -> float:
    return float(np.hypot(*(np.roll(polygon, -1, axis=0) - polygon).T).sum())
