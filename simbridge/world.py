"""The store: its model for rays and contact, and the truth about it for scoring and pictures."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
import shapely
from numpy.typing import NDArray

from simbridge import footprint as fp
from simbridge import nearness
from simbridge.config import VehicleConfig, WorldConfig
from simbridge.model import build_model
from simbridge.surface import Surface, build_surface, volume_m3

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Outlines for pictures, in `world` x, y: each a list of closed (N, 2) rings."""

    walls: list[Array]
    obstacles: list[Array]
    piles: list[Array]


@dataclass(frozen=True, kw_only=True)
class World:
    """A built store. footprint: shapely polygon. Nothing of it may reach what flies: it is the truth."""

    config: WorldConfig
    model: mujoco.MjModel
    footprint: Any
    height_m: float
    surface: Surface
    obstacles: tuple[fp.Obstacle, ...]

    @cached_property
    def true_volume_m3(self) -> float:
        """Material above the floor, from the very triangles that the rays hit, cut by walls and obstacles."""
        return volume_m3(self.surface, self.config)

    @cached_property
    def plan(self) -> Plan:
        contour = self.surface.contour(self.footprint)
        return Plan(
            walls=_rings(self.footprint),
            obstacles=[ring for o in self.obstacles for ring in _rings(o.outline().intersection(self.footprint))],
            piles=_rings(contour.simplify(self.surface.cell_m / 2)),
        )

    def outlines(self) -> list[Array]:
        """Rings (K, 2) of walls and obstacles seen from above, the last point not repeated."""
        return [ring[:-1] for ring in (*self.plan.walls, *self.plan.obstacles)]

    def wall_outlines(self) -> list[Array]:
        """The same of the walls alone."""
        return [ring[:-1] for ring in self.plan.walls]

    def new_data(self) -> mujoco.MjData:
        """Fresh simulation state, positions computed."""
        data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, data)
        return data

    def surface_height(self, x: float, y: float) -> float:
        """`world` z of the pile or floor at a place."""
        return self.surface.height(x, y)

    def clearance(self, point_world: Array) -> float:
        """Distance from a point to the nearest wall, obstacle, ceiling or pile; the bare floor does not count.

        To a pile: to the nearest corner of its triangles, so at most (cell^2 / 4 d) too much at distance d.
        """
        x, y, z = point_world.tolist()
        beside = min(nearness.wall(self._wall_ring, x, y), nearness.obstacle(self._obstacle_table, x, y, z))
        nearest = min(beside, max(self.height_m - z, 0.0))
        if self._is_pile is None:
            return float(nearest)
        surface = self.surface
        return float(nearness.pile(surface.z, surface.floor, self._is_pile, self._grid, x, y, z, nearest))

    @cached_property
    def _obstacle_table(self) -> Array:
        return fp.table(self.obstacles)

    @cached_property
    def _wall_ring(self) -> Array:
        return np.array(self.footprint.exterior.coords, dtype=np.float64)

    @cached_property
    def _grid(self) -> Array:
        return np.array([self.surface.x0, self.surface.y0, self.surface.cell_m])

    @cached_property
    def _is_pile(self) -> NDArray[np.bool_] | None:
        """(ny, nx): which corners of the surface belong to material inside the walls. None: there is none."""
        surface, has = self.surface, self.surface.cells_with_material()
        corners = np.zeros(surface.z.shape, dtype=np.bool_)
        for part in (corners[:-1, :-1], corners[:-1, 1:], corners[1:, :-1], corners[1:, 1:]):
            part |= has
        iy, ix = np.nonzero(corners)
        x, y = surface.x0 + ix * surface.cell_m, surface.y0 + iy * surface.cell_m
        corners[iy, ix] = shapely.contains_xy(self.footprint, x, y)
        return corners if corners.any() else None


def widest_wall_distance_m(config: WorldConfig) -> float:
    """The largest distance from all walls that any place in the hall has."""
    return fp.largest_wall_distance_m(config.footprint)


def build_world(config: WorldConfig, vehicle: VehicleConfig | None = None) -> World:
    """Build the store; with a vehicle in it if given. The same config gives the same store: nothing here is random."""
    surface = build_surface(config)
    return World(
        config=config,
        model=build_model(config, surface, vehicle),
        footprint=fp.outline(config.footprint),
        height_m=config.height_m,
        surface=surface,
        obstacles=fp.obstacles(config),
    )


def _rings(shape: Any) -> list[Array]:
    polygons = [part for part in getattr(shape, "geoms", [shape]) if part.geom_type == "Polygon" and not part.is_empty]
    return [np.asarray(ring.coords) for part in polygons for ring in (part.exterior, *part.interiors)]
