"""Floor and material as one height grid: the pile's triangles, its contour, and the true volume from just these.

Each cell of the grid is cut into two triangles along its diagonal from low x, low y to high x, high y; heights
between the corners are those of the triangles, everywhere (rays, contact, volume).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from simbridge import footprint as fp
from simbridge import piles
from simbridge.config import WorldConfig
from simbridge.kernels import triangle

Array = NDArray[np.float64]

OFF_GRID = 0.3819660  # of a cell: keeps the triangles' edges off round numbers, where a ray may slip between two
THINNEST_M = 0.01  # a thinner layer counts as swept floor


@dataclass(frozen=True, slots=True, kw_only=True)
class Surface:
    """Heights at the corners of a square grid. z, floor: (ny, nx), `world`; z >= floor, equal where bare."""

    x0: float
    y0: float
    cell_m: float
    z: Array
    floor: Array

    def height(self, x: float, y: float) -> float:
        """Top of material or floor at a place; the grid's edge counts on beyond it."""
        return float(triangle(self.z, self.x0, self.y0, self.cell_m, x, y)[0])

    def plane(self, x: float, y: float) -> tuple[float, float, float]:
        """Height, and rise per metre along x and y, of the triangle at a place."""
        height, slope_x, slope_y = triangle(self.z, self.x0, self.y0, self.cell_m, x, y)
        return float(height), float(slope_x), float(slope_y)

    def bare_height(self, x: float, y: float) -> float:
        """The floor alone at a place (it is a plane)."""
        fx, fy = (x - self.x0) / self.cell_m, (y - self.y0) / self.cell_m
        f = self.floor
        return float(f[0, 0] + fx * (f[0, 1] - f[0, 0]) + fy * (f[1, 0] - f[0, 0]))

    def cells_with_material(self) -> NDArray[np.bool_]:
        """(ny - 1, nx - 1): any of the four corners carries material."""
        has = self.z > self.floor
        return np.asarray(has[:-1, :-1] | has[1:, :-1] | has[:-1, 1:] | has[1:, 1:])

    def triangles(self) -> tuple[Array, NDArray[np.int32]]:
        """Vertices (N, 3) and counter-clockwise faces (M, 3) of the material's surface; empty without material."""
        ny, nx = self.z.shape
        index = np.arange(ny * nx, dtype=np.int64).reshape(ny, nx)
        mask = self.cells_with_material()
        a, b = index[:-1, :-1][mask], index[:-1, 1:][mask]
        c, d = index[1:, 1:][mask], index[1:, :-1][mask]
        faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
        used, renumbered = np.unique(faces, return_inverse=True)
        iy, ix = np.divmod(used, nx)
        vertices = np.stack([self.x0 + ix * self.cell_m, self.y0 + iy * self.cell_m, self.z[iy, ix]], axis=1)
        return vertices, renumbered.reshape(faces.shape).astype(np.int32)

    def contour(self, hall: Any) -> Any:
        """Plan outline of the material inside the walls: a shapely (multi)polygon."""
        iy, ix = np.nonzero(self.cells_with_material())
        return shapely.union_all(self.boxes(ix, iy)).intersection(hall)

    def boxes(self, ix: NDArray[np.intp], iy: NDArray[np.intp]) -> Any:
        """Outlines of cells; those of neighbours share their corners to the last bit."""
        x, y, cell = self.x0, self.y0, self.cell_m
        return shapely.box(x + ix * cell, y + iy * cell, x + (ix + 1) * cell, y + (iy + 1) * cell)


def build_surface(world: WorldConfig) -> Surface:
    """The floor with all piles on it; where piles overlap the higher one counts."""
    hall = fp.outline(world.footprint)
    cell = world.pile_cell_m
    low_x, low_y, high_x, high_y = hall.bounds
    x = low_x - OFF_GRID * cell + cell * np.arange(-2, math.ceil((high_x - low_x) / cell) + 4)
    y = low_y - OFF_GRID * cell + cell * np.arange(-2, math.ceil((high_y - low_y) / cell) + 4)
    gx, gy = np.meshgrid(x, y)

    def floor_of(px: Array, py: Array) -> Array:
        return fp.floor_z(world, px, py)

    floor = floor_of(gx, gy)
    top = floor.copy()
    for pile in world.piles:
        z = piles.top_z(pile, gx, gy, floor_of)
        z = np.where(_reach(pile, hall, gx, gy, cell) & (z > floor + THINNEST_M), z, floor)
        top = np.maximum(top, z)
    return Surface(x0=float(x[0]), y0=float(y[0]), cell_m=cell, z=top, floor=floor)


def _reach(pile: piles.Pile, hall: Any, gx: Array, gy: Array, cell_m: float) -> NDArray[np.bool_]:
    """Where the pile may lie: the part of the hall that its base reaches without crossing a wall, and a bit beyond.

    Without this a pile that leans on the inner wall of an L would come out on the wall's other side.
    """
    base = piles.outline(pile).buffer(piles.ragged_m(pile))
    parts = list(getattr(base.intersection(hall), "geoms", [base.intersection(hall)]))
    middle = base.centroid
    nearest = min(parts, key=lambda part: part.distance(middle)).buffer(2.0 * cell_m)
    shapely.prepare(nearest)
    return np.asarray(shapely.contains_xy(nearest, gx, gy))


def volume_m3(surface: Surface, world: WorldConfig) -> float:
    """Material above the floor within the walls, in none of the obstacles: exactly that of the triangles."""
    hall = fp.outline(world.footprint)
    standing = [(o.outline(), o.top_z) for o in fp.obstacles(world)]
    tall = shapely.union_all([shape for shape, top in standing if top >= world.height_m - 1e-9])
    low = [(shape, top) for shape, top in standing if top < world.height_m - 1e-9]
    free = hall.difference(tall)
    total = _thickness_integral(surface, free)
    for shape, top in low:  # a box displaces material as high as it stands
        total -= _displaced_integral(surface, shape.intersection(free), top)
    return total


def _thickness_integral(surface: Surface, area: Any) -> float:
    """Integral of z - floor over a polygon: whole cells at once, cells on its edge cut exactly."""
    cell = surface.cell_m
    iy, ix = np.nonzero(surface.cells_with_material())
    boxes = surface.boxes(ix, iy)
    shapely.prepare(area)
    whole = shapely.contains_properly(area, boxes)
    cut = shapely.intersects(area, boxes) & ~whole
    t = surface.z - surface.floor
    a, b, c, d = t[iy, ix], t[iy, ix + 1], t[iy + 1, ix + 1], t[iy + 1, ix]
    total = float(np.sum((2 * a + b + 2 * c + d)[whole])) * cell**2 / 6.0
    for k in np.nonzero(cut)[0]:
        x, y = surface.x0 + ix[k] * cell, surface.y0 + iy[k] * cell
        for corners, plane in (
            ([(x, y), (x + cell, y), (x + cell, y + cell)], (a[k], (b[k] - a[k]) / cell, (c[k] - b[k]) / cell)),
            ([(x, y), (x + cell, y + cell), (x, y + cell)], (a[k], (c[k] - d[k]) / cell, (d[k] - a[k]) / cell)),
        ):
            part = shapely.Polygon(corners).intersection(area)
            if part.area > 0.0:
                middle = part.centroid
                total += part.area * float(plane[0] + plane[1] * (middle.x - x) + plane[2] * (middle.y - y))
    return total


def _displaced_integral(surface: Surface, shape: Any, top_z: float) -> float:
    """Material that a low obstacle displaces, on a fine raster."""
    if shape.is_empty:
        return 0.0
    step = surface.cell_m / 8.0
    low_x, low_y, high_x, high_y = shape.bounds
    gx, gy = np.meshgrid(np.arange(low_x + step / 2, high_x, step), np.arange(low_y + step / 2, high_y, step))
    inside = shapely.contains_xy(shape, gx, gy)
    if not inside.any():
        return 0.0
    x, y = gx[inside], gy[inside]
    z = np.array([surface.height(px, py) for px, py in zip(x, y, strict=True)])
    floor = np.array([surface.bare_height(px, py) for px, py in zip(x, y, strict=True)])
    return float(np.mean(np.maximum(np.minimum(z, top_z) - floor, 0.0))) * float(shape.area)
