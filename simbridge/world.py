"""The store: its model for rays and contact, and the truth about it for scoring and pictures."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from simbridge import footprint as fp
from simbridge.config import VehicleConfig, WorldConfig
from simbridge.kernels import nearest_obstacle
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
        x, y, z = (float(v) for v in point_world)
        place = shapely.Point(x, y)
        to_wall = float(self._walls.distance(place)) if shapely.contains(self.footprint, place) else 0.0
        nearest = min(to_wall, max(self.height_m - z, 0.0), float(nearest_obstacle(self._obstacle_table, x, y, z)))
        if self._pile_tree is not None:
            distance, _ = self._pile_tree.query(point_world, distance_upper_bound=nearest)
            is_inside = self.surface.height(x, y) >= z and self._is_pile(x, y)
            nearest = 0.0 if is_inside else min(nearest, float(distance))
        return nearest

    @cached_property
    def _obstacle_table(self) -> Array:
        return fp.table(self.obstacles)

    @cached_property
    def _walls(self) -> Any:
        shapely.prepare(self.footprint)
        shapely.prepare(self.footprint.exterior)
        return self.footprint.exterior

    @cached_property
    def _pile_tree(self) -> Any:
        vertices, _ = self.surface.triangles()
        inside = shapely.contains_xy(self.footprint, vertices[:, 0], vertices[:, 1])
        return cKDTree(vertices[inside]) if inside.any() else None

    def _is_pile(self, x: float, y: float) -> bool:
        return self.surface.height(x, y) > self.surface.bare_height(x, y) + 0.02


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
