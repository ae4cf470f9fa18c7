"""The store seen from above: outline, obstacles, and what may not be said of them in a mission file."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from numpy.typing import NDArray

from simbridge import piles
from simbridge.section import refuse

if TYPE_CHECKING:
    from simbridge.config import Box, Column, Footprint, Pilasters, Start, WorldConfig

Array = NDArray[np.float64]

VEHICLE_RADIUS_M = 0.4  # rotor hub at 0.28 m and half a 10 inch propeller
MIN_START_TO_WALL_M = 1.0
MAX_CELLS = 4_000_000  # of the height grid over the hall: 400 x 400 m at the default cell
MIN_HEADROOM_M = 2.0  # between the floor at its highest and the ceiling
TOP_GRID = 200  # a pile's peak is looked for on so many places each way


@dataclass(frozen=True, slots=True, kw_only=True)
class Obstacle:
    """Something that stands on the floor. half_m: (x, y, z) before turning; a round one has x = y = its radius."""

    name: str
    center: tuple[float, float]
    half_m: tuple[float, float, float]
    yaw_rad: float
    is_round: bool
    foot_z: float

    @property
    def top_z(self) -> float:
        return self.foot_z + 2.0 * self.half_m[2]

    def outline(self) -> Any:
        """Its shapely polygon."""
        if self.is_round:
            return shapely.Point(self.center).buffer(self.half_m[0], quad_segs=16)
        return shapely.transform(
            shapely.box(-self.half_m[0], -self.half_m[1], self.half_m[0], self.half_m[1]), self._to_world
        )

    def _to_world(self, points: Array) -> Array:
        c, s = math.cos(self.yaw_rad), math.sin(self.yaw_rad)
        return np.asarray(points @ np.array([[c, s], [-s, c]]) + np.asarray(self.center))


def table(standing: tuple[Obstacle, ...]) -> Array:
    """(N, 9) for the kernel `nearness.obstacle`: x, y, half sizes, cosine and sine of the yaw, foot, 1 if round."""
    rows = [
        (*o.center, *o.half_m, math.cos(o.yaw_rad), math.sin(o.yaw_rad), o.foot_z, float(o.is_round)) for o in standing
    ]
    return np.array(rows, dtype=np.float64).reshape(-1, 9)


def outline(footprint: Footprint) -> Any:
    """The hall's shapely polygon."""
    return shapely.Polygon(corners(footprint))


def corners(footprint: Footprint) -> Array:
    """(N, 2) corners as given, without a repeated last one."""
    if isinstance(footprint, tuple):
        points = np.asarray(footprint, dtype=np.float64)
        return points[:-1] if len(points) > 3 and np.array_equal(points[0], points[-1]) else points
    angle = 2.0 * math.pi * np.arange(footprint.sides) / footprint.sides
    radius, center = footprint.circle.radius_m, np.asarray(footprint.circle.center)
    return np.asarray(center + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def signed_area(points: Array) -> float:
    """Of a polygon's corners; positive when they go counter-clockwise."""
    x, y = points[:, 0], points[:, 1]
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y)) / 2.0


def largest_wall_distance_m(footprint: Footprint) -> float:
    """The largest D with any place that far from every wall: radius of the largest circle inside."""
    return float(shapely.maximum_inscribed_circle(outline(footprint), 0.01).length)


def floor_z(world: WorldConfig, x: Array, y: Array) -> Array:
    """Height of the bare floor."""
    middle = outline(world.footprint).centroid
    return np.asarray(world.floor_slope[0] * (x - middle.x) + world.floor_slope[1] * (y - middle.y))


def obstacles(world: WorldConfig) -> tuple[Obstacle, ...]:
    """Pilasters, columns and boxes, in this order."""
    found = [
        _obstacle(f"pilasters[{i}][{k}]", world, center, (half[0], half[1]), yaw, False, None)
        for i, spec in enumerate(world.pilasters)
        for k, (center, half, yaw) in enumerate(_pilasters(world, spec))
    ]
    found += [_column(f"columns[{i}]", world, column) for i, column in enumerate(world.columns)]
    found += [_box(f"boxes[{i}]", world, box) for i, box in enumerate(world.boxes)]
    return tuple(found)


def _column(name: str, world: WorldConfig, column: Column) -> Obstacle:
    is_round = column.radius_m is not None
    size = column.size_m or (2.0 * (column.radius_m or 0.0),) * 2
    half = (size[0] / 2, size[1] / 2)
    return _obstacle(name, world, column.center, half, math.radians(column.yaw_deg), is_round, column.height_m)


def _box(name: str, world: WorldConfig, box: Box) -> Obstacle:
    half = (box.size_m[0] / 2, box.size_m[1] / 2)
    return _obstacle(name, world, box.center, half, math.radians(box.yaw_deg), False, box.size_m[2])


def _obstacle(
    name: str,
    world: WorldConfig,
    center: tuple[float, float],
    half: tuple[float, float],
    yaw_rad: float,
    is_round: bool,
    height_m: float | None,
) -> Obstacle:
    """Standing on the lowest floor under it, up to height_m above its centre's floor (none: the ceiling)."""
    z = float(floor_z(world, np.array(center[0]), np.array(center[1])))
    reach = math.hypot(*half) * math.hypot(*world.floor_slope)
    top = world.height_m if height_m is None else min(z + height_m, world.height_m)
    foot = z - reach
    return Obstacle(
        name=name, center=center, half_m=(*half, (top - foot) / 2), yaw_rad=yaw_rad, is_round=is_round, foot_z=foot
    )


def _pilasters(world: WorldConfig, spec: Pilasters) -> list[tuple[tuple[float, float], tuple[float, float], float]]:
    """(centre, half size, yaw) of each: half in the wall, evenly spaced, none at the corners."""
    points = corners(world.footprint)
    walls = range(len(points)) if spec.wall == "all" else [spec.wall]
    found = []
    for wall in walls:
        if wall >= len(points):
            continue  # refused by check_world
        a, b = points[wall], points[(wall + 1) % len(points)]
        length = math.dist(a, b)
        count = max(round(length / spec.spacing_m) - 1, 0)
        yaw = math.atan2(b[1] - a[1], b[0] - a[0])
        for k in range(count):
            middle = a + (b - a) * (k + 1) / (count + 1)
            found.append(((float(middle[0]), float(middle[1])), (spec.width_m / 2, spec.depth_m), yaw))
    return found


def check_world(world: WorldConfig) -> None:
    """Raises: ValidationError: parts that do not fit together, and what is allowed."""
    hall = outline(world.footprint)
    if not hall.is_valid or hall.area < 1.0:
        reason = shapely.is_valid_reason(hall) if not hall.is_valid else f"its area is {hall.area:.2f} m2"
        refuse(
            ("footprint",),
            world.footprint,
            f"crosses or touches itself, or is too small ({reason}); allowed is a simple polygon: "
            "corners in order along the wall, no edge crossing another",
        )
    _check_size(world, hall)
    count = len(corners(world.footprint))
    for i, spec in enumerate(world.pilasters):
        if spec.wall != "all" and not 0 <= spec.wall < count:
            refuse(("pilasters", i, "wall"), spec.wall, f"there is no such wall; allowed are 0 to {count - 1}, or all")
    _check_obstacles(world, hall)
    for i, pile in enumerate(world.piles):
        _check_pile(("piles", i), pile, hall)
        top, shown = pile_top_z(world, pile), pile.model_dump(exclude_defaults=True)
        if top == -math.inf:
            refuse(("piles", i), shown, "holds no material within the walls")
        if top >= world.height_m:
            reason = f"its top at {top:.4g} m reaches the ceiling at {world.height_m:g} m; it must be lower"
            refuse(("piles", i), shown, reason)


def _check_size(world: WorldConfig, hall: Any) -> None:
    """Raises: ValidationError: a corner given twice, too large to compute, or a floor that meets the ceiling."""
    points = corners(world.footprint)
    for i, (point, following) in enumerate(zip(points, np.roll(points, -1, axis=0), strict=True)):
        if math.dist(point, following) < 0.01:
            reason = f"corners {i} and {(i + 1) % len(points)} stand at the same place; each may be given once"
            refuse(("footprint",), world.footprint, reason)
    low_x, low_y, high_x, high_y = hall.bounds
    cells = (high_x - low_x) * (high_y - low_y) / world.pile_cell_m**2
    if cells > MAX_CELLS:
        spans = f"spans {high_x - low_x:g} x {high_y - low_y:g} m"
        reason = f"{spans}: more than {MAX_CELLS} cells of pile_cell_m {world.pile_cell_m:g}; make it smaller or those larger"
        refuse(("footprint",), world.footprint, reason)
    highest = highest_floor_z(world)
    if highest > world.height_m - MIN_HEADROOM_M:
        reason = f"the floor rises to {highest:.1f} m; at least {MIN_HEADROOM_M:g} m below the ceiling are needed"
        refuse(("floor_slope",), world.floor_slope, reason)


def highest_floor_z(world: WorldConfig) -> float:
    """Of the bare floor, at one of the corners."""
    points = corners(world.footprint)
    return float(np.max(floor_z(world, points[:, 0], points[:, 1])))


def pile_top_z(world: WorldConfig, pile: piles.Pile) -> float:
    """Height of a pile's peak within the walls, `world`; minus infinity where it has no material."""
    hall = outline(world.footprint)
    low_x, low_y, high_x, high_y = piles.outline(pile).buffer(piles.ragged_m(pile)).intersection(hall).bounds
    x, y = np.meshgrid(np.linspace(low_x, high_x, TOP_GRID), np.linspace(low_y, high_y, TOP_GRID))
    inside = shapely.contains_xy(hall, x.ravel(), y.ravel())
    x, y = x.ravel()[inside], y.ravel()[inside]
    top = piles.top_z(pile, x, y, lambda a, b: floor_z(world, a, b))
    material = top > floor_z(world, x, y)
    return float(np.max(top[material])) if material.any() else -math.inf


def start_floor_z(world: WorldConfig, start: Start) -> tuple[float, float]:
    """Lowest and highest floor where the flight may begin, `world`."""
    (x, y), radius = (start[:2], 0.0) if isinstance(start, tuple) else (start.circle.center, start.circle.radius_m)
    z, rise = float(floor_z(world, np.array(x), np.array(y))), radius * math.hypot(*world.floor_slope)
    return z - rise, z + rise


def _check_obstacles(world: WorldConfig, hall: Any) -> None:
    within = hall.buffer(0.01)
    for key, standing in (
        ("columns", [_column("", world, column) for column in world.columns]),
        ("boxes", [_box("", world, box) for box in world.boxes]),
    ):
        for i, obstacle in enumerate(standing):
            if not within.covers(obstacle.outline()):
                refuse((key, i), obstacle.center, "reaches outside the footprint; it must stand within the walls")


def _check_pile(location: tuple[str, int], pile: piles.Pile, hall: Any) -> None:
    base = piles.outline(pile)
    shown = pile.model_dump(exclude_defaults=True)
    if base.intersection(hall).area < 0.02 * base.area:
        refuse(location, shown, "lies outside the footprint; it must stand within the walls, or lean on one")
    if not pile.leaning and not hall.buffer(0.05).covers(base):
        reach = max(hall.distance(shapely.Point(x, y)) for x, y in shapely.get_coordinates(base))
        refuse(
            location,
            shown,
            f"reaches up to {reach:.1f} m outside the footprint; move it inward, make it smaller, "
            "or set leaning: true to let the walls cut it",
        )


def check_start(world: WorldConfig, start: Start) -> None:
    """Raises: ValidationError: the vehicle cannot stand there."""
    if isinstance(start, tuple):
        problem = start_problem(world, start[0], start[1])
        if problem:
            refuse(("vehicle", "start"), start, problem)
    elif len(start_places(world, start.circle.center, start.circle.radius_m, np.random.default_rng(0), 400)) == 0:
        problem = start_problem(world, *start.circle.center)
        shown = start.model_dump(exclude_defaults=True)
        refuse(("vehicle", "start"), shown, f"no place to stand in the circle: {problem or 'only its very centre'}")


def start_places(world: WorldConfig, center: tuple[float, float], radius_m: float, rng: Any, tries: int) -> Array:
    """(N, 2) random places of a circle, uniform over its area, where the vehicle can stand; at most `tries`."""
    angle, radius = rng.uniform(0.0, 2.0 * math.pi, tries), radius_m * np.sqrt(rng.random(tries))
    places = np.stack([center[0] + radius * np.cos(angle), center[1] + radius * np.sin(angle)], axis=1)
    return places[_can_stand(world, places)]


def start_problem(world: WorldConfig, x: float, y: float) -> str | None:
    """Why the vehicle cannot stand at (x, y), or None."""
    hall, place = outline(world.footprint), shapely.Point(x, y)
    if not hall.contains(place):
        low, high = hall.bounds[:2], hall.bounds[2:]
        return f"({x:g}, {y:g}) is outside the footprint, which spans {low} to {high}"
    to_wall = hall.exterior.distance(place)
    if to_wall < MIN_START_TO_WALL_M:
        return f"({x:g}, {y:g}) is {to_wall:.2f} m from a wall; at least {MIN_START_TO_WALL_M} m are needed"
    for obstacle in obstacles(world):
        gap = obstacle.outline().distance(place)
        if gap < MIN_START_TO_WALL_M:
            return f"({x:g}, {y:g}) is {gap:.2f} m from {obstacle.name}; at least {MIN_START_TO_WALL_M} m are needed"
    if not _can_stand(world, np.array([[x, y]]))[0]:
        return f"({x:g}, {y:g}) is on a pile; the start must be on the bare floor, a vehicle's radius from any pile"
    return None


def _can_stand(world: WorldConfig, places: Array) -> NDArray[np.bool_]:
    free = outline(world.footprint).buffer(-MIN_START_TO_WALL_M)
    for obstacle in obstacles(world):
        free = free.difference(obstacle.outline().buffer(MIN_START_TO_WALL_M))
    good = np.asarray(shapely.contains_xy(free, places[:, 0], places[:, 1]))
    for dx, dy in ((0.0, 0.0), (0.4, 0.0), (-0.4, 0.0), (0.0, 0.4), (0.0, -0.4)):
        x, y = places[:, 0] + dx, places[:, 1] + dy
        for pile in world.piles:
            good &= piles.top_z(pile, x, y, lambda a, b: floor_z(world, a, b)) <= floor_z(world, x, y) + 0.02
    return good
