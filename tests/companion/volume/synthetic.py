"""Maps of known volume, made without simbridge: halls as polygons, piles as functions, a lap, rays, noise, poses.

The scene's surface is a fine height grid; a ray marches over it with steps that its steepest slope allows. Walls and
columns are met exactly. The true volume is the sum over the same fine grid.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.messages import PointMap
from companion.volume.polygon import contains, edge_distance, resample

Array = NDArray[np.float64]
FINE_M = 0.05


@dataclass(frozen=True, kw_only=True)
class Hall:
    footprint: Array
    pile: Callable[[Array, Array], Array]
    columns: tuple[tuple[float, float, float], ...] = ()  # x, y, radius
    floor_slope: tuple[float, float] = (0.0, 0.0)
    floor_waves_m: float = 0.0
    boxes: tuple[tuple[float, float, float, float, float], ...] = ()  # x0, y0, x1, y1, height
    ceiling_m: float = 15.0


@dataclass(frozen=True, kw_only=True)
class Flight:
    height_m: float = 9.0
    wall_distance_m: float = 6.0
    speed_mps: float = 0.43
    scan_period_s: float = 0.5
    keyframe_period_s: float = 4.8
    noise_m: float = 0.12
    max_range_m: float = 40.0
    position_sigma_m: float = 0.0
    height_sigma_m: float = 0.0
    yaw_sigma_rad: float = 0.0
    tilt_sigma_rad: float = 0.0
    dust_ratio: float = 0.0
    lost_ratio: float = 0.0
    rows_deg: tuple[float, ...] = (0.0, -11.25, -22.5, -33.75, -45.0)
    columns: int = 512
    told_position_sigma_m: float | None = None
    arc: tuple[float, float] = (0.0, 1.0)  # part of the lap that is flown


@dataclass(frozen=True, kw_only=True)
class Synthetic:
    point_map: PointMap
    true_volume_m3: float
    true_points: Array = field(repr=False)


def rectangle(length: float = 50.0, width: float = 30.0) -> Array:
    return np.array([[0, 0], [length, 0], [length, width], [0, width]], dtype=float)


def l_shape() -> Array:
    return np.array([[0, 0], [54, 0], [54, 26], [30, 26], [30, 50], [0, 50]], dtype=float)


def circle(radius: float = 15.0, sides: int = 96) -> Array:
    a = 2 * np.pi * np.arange(sides) / sides
    return radius * np.column_stack([np.cos(a), np.sin(a)])


def rotated(polygon: Array, angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return polygon @ np.array([[c, s], [-s, c]])


def cone(x0: float, y0: float, height: float, slope: float) -> Callable[[Array, Array], Array]:
    return lambda x, y: np.maximum(height - slope * np.hypot(x - x0, y - y0), 0.0)


def ridge(
    x0: float, y0: float, half: float, height: float, slope: float, waves: float = 0.3
) -> Callable[[Array, Array], Array]:
    """A long pile along x with uneven flanks."""

    def pile(x: Array, y: Array) -> Array:
        beyond = np.maximum(np.abs(x - x0) - half, 0.0)
        top = height + waves * (np.sin(0.7 * x) + 0.6 * np.sin(1.1 * y + 0.5) + 0.4 * np.sin(0.9 * (x + y)))
        side = slope * (1.0 + 0.15 * np.sin(0.5 * x))
        h = top - side * np.hypot(beyond, y - y0)
        return np.maximum(h, 0.0)

    return pile


def leaning(y_wall: float, x0: float, half: float, height: float, slope: float) -> Callable[[Array, Array], Array]:
    """A pile against the wall y = y_wall, falling away from it."""

    def pile(x: Array, y: Array) -> Array:
        beyond = np.maximum(np.abs(x - x0) - half, 0.0)
        return np.maximum(height + 0.2 * np.sin(0.8 * x) - slope * np.hypot(np.abs(y - y_wall), beyond), 0.0)

    return pile


@njit(cache=True)
def _cast(origin, direction, walls, columns, z, x0, y0, cell, steepest, top, reach):  # type: ignore[no-untyped-def]
    """Distance along each ray to the first wall, column or surface; inf for none."""
    out = np.full(len(direction), np.inf)
    ny, nx = z.shape
    for r in range(len(direction)):
        ox, oy, oz = origin[r]
        dx, dy, dz = direction[r]
        best = reach
        hit = False
        for w in range(len(walls)):
            ax, ay, bx, by = walls[w]
            ex, ey = bx - ax, by - ay
            den = dx * ey - dy * ex
            if den != 0.0:
                t = ((ax - ox) * ey - (ay - oy) * ex) / den
                u = ((ax - ox) * dy - (ay - oy) * dx) / den
                if 0.0 < t < best and 0.0 <= u <= 1.0:
                    best = t
                    hit = True
        flat2 = dx * dx + dy * dy
        for c in range(len(columns)):
            px, py, radius = columns[c]
            b = (ox - px) * dx + (oy - py) * dy
            q = (ox - px) ** 2 + (oy - py) ** 2 - radius * radius
            disc = b * b - flat2 * q
            if disc > 0.0 and flat2 > 0.0:
                t = (-b - np.sqrt(disc)) / flat2
                if 0.0 < t < best:
                    best = t
                    hit = True
        flat = np.sqrt(flat2)
        closing = max(-dz, 0.0) + steepest * flat
        t = 0.0
        while t < best:
            pz = oz + t * dz
            if pz > top and dz >= 0.0:
                break
            fx = (ox + t * dx - x0) / cell - 0.5
            fy = (oy + t * dy - y0) / cell - 0.5
            ix = min(max(int(np.floor(fx)), 0), nx - 2)
            iy = min(max(int(np.floor(fy)), 0), ny - 2)
            u = min(max(fx - ix, 0.0), 1.0)
            v = min(max(fy - iy, 0.0), 1.0)
            h = (1 - v) * ((1 - u) * z[iy, ix] + u * z[iy, ix + 1]) + v * (
                (1 - u) * z[iy + 1, ix] + u * z[iy + 1, ix + 1]
            )
            gap = pz - h
            if gap < 1e-4:
                best = t
                hit = True
                break
            t += max(gap / closing, 5e-4)
        if hit:
            out[r] = best
    return out


def lap(hall: Hall, flight: Flight) -> tuple[Array, Array]:
    """Positions (K, 3) and headings (K,) of the scans: around the hall at the wall distance, clockwise or not."""
    from shapely.geometry import Polygon

    inner = Polygon(hall.footprint).buffer(-flight.wall_distance_m, join_style="mitre")
    loop = np.asarray(inner.exterior.coords)[:-1]
    points = resample(loop, flight.speed_mps * flight.scan_period_s)
    a, b = (int(f * len(points)) for f in flight.arc)
    points = points[a:b]
    ahead = np.roll(points, -1, axis=0) - points
    climb = np.linspace(0.3, flight.height_m, int(flight.height_m / 0.8 / flight.scan_period_s))
    xy = np.vstack([np.repeat(points[:1], len(climb), axis=0), points])
    z = np.concatenate([climb, np.full(len(points), flight.height_m)])
    heading = np.arctan2(ahead[:, 1], ahead[:, 0])
    return np.column_stack([xy, z]), np.concatenate([np.repeat(heading[:1], len(climb)), heading])


def surface_of(hall: Hall) -> tuple[Array, float, float, Array]:
    """Fine grid of the surface (floor and pile and boxes), its corner, and the pile alone."""
    low, high = hall.footprint.min(axis=0) - 0.5, hall.footprint.max(axis=0) + 0.5
    x = np.arange(low[0] + FINE_M / 2, high[0], FINE_M)
    y = np.arange(low[1] + FINE_M / 2, high[1], FINE_M)
    gx, gy = np.meshgrid(x, y)
    floor = hall.floor_slope[0] * gx + hall.floor_slope[1] * gy
    floor += hall.floor_waves_m * np.sin(0.6 * gx + 0.3) * np.sin(0.5 * gy)
    pile = hall.pile(gx, gy)
    solid = floor + pile
    for bx0, by0, bx1, by1, height in hall.boxes:
        box = (gx > bx0) & (gx < bx1) & (gy > by0) & (gy < by1)
        solid = np.where(box, np.maximum(solid, floor + height), solid)
    inside = contains(hall.footprint, gx, gy)
    for cx, cy, radius in hall.columns:
        inside &= np.hypot(gx - cx, gy - cy) > radius
    return solid, float(low[0]), float(low[1]), np.where(inside, pile, 0.0)


def make_map(hall: Hall, flight: Flight, seed: int) -> Synthetic:
    rng = np.random.default_rng(seed)
    solid, x0, y0, pile = surface_of(hall)
    steepest = 1.6 if not hall.boxes else 12.0
    position, heading = lap(hall, flight)
    k = len(position)
    floor_here = solid[((position[:, 1] - y0) / FINE_M).astype(int), ((position[:, 0] - x0) / FINE_M).astype(int)]
    position[:, 2] += floor_here[0]
    el = np.radians(flight.rows_deg)
    az = 2 * np.pi * np.arange(flight.columns) / flight.columns
    fan = np.stack(
        [np.outer(np.cos(el), np.cos(az)), np.outer(np.cos(el), np.sin(az)), np.outer(np.sin(el), np.ones_like(az))], -1
    ).reshape(-1, 3)
    c, s = np.cos(heading), np.sin(heading)
    turn = np.zeros((k, 3, 3))
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1], turn[:, 2, 2] = c, -s, s, c, 1.0
    direction = np.einsum("kij,nj->kni", turn, fan)
    origin = np.repeat(position, len(fan), axis=0)
    flat = direction.reshape(-1, 3)
    walls = np.hstack([hall.footprint, np.roll(hall.footprint, -1, axis=0)])
    columns = np.array(hall.columns, dtype=float).reshape(-1, 3)
    distance = _cast(origin, flat, walls, columns, solid, x0, y0, FINE_M, steepest, float(solid.max()) + 0.1, 200.0)
    keyframe = np.repeat((np.arange(k) * flight.scan_period_s / flight.keyframe_period_s).astype(np.int64), len(fan))
    hit = np.isfinite(distance) & (distance < flight.max_range_m) & (rng.random(len(distance)) >= flight.lost_ratio)
    measured = distance + rng.normal(0.0, flight.noise_m, len(distance))
    dusty = rng.random(len(distance)) < flight.dust_ratio
    measured = np.where(dusty, np.minimum(measured, rng.exponential(4.0, len(distance)) + 0.5), measured)
    true_points = origin + distance[:, None] * flat
    local = (measured[:, None] * fan.reshape(1, -1, 3).repeat(k, 0).reshape(-1, 3)).reshape(k, len(fan), 3)
    points = _place(local, position, heading, flight, rng)
    said = flight.position_sigma_m if flight.told_position_sigma_m is None else flight.told_position_sigma_m
    point_map = PointMap(
        points_map=points.reshape(-1, 3)[hit],
        keyframe_id=keyframe[hit],
        range_m=measured[hit],
        path_map=position,
        position_sigma_m=said,
        height_sigma_m=flight.height_sigma_m,
        scan_index=np.repeat(np.arange(k), len(fan))[hit],
    )
    return Synthetic(point_map=point_map, true_volume_m3=float(pile.sum() * FINE_M**2), true_points=true_points[hit])


def _place(local: Array, position: Array, heading: Array, flight: Flight, rng: np.random.Generator) -> Array:
    """Points by estimated poses, whose errors wander slowly (correlated over 10 keyframes)."""
    k = len(position)
    per_keyframe = flight.keyframe_period_s / flight.scan_period_s
    at = np.arange(k) / per_keyframe
    knots = int(at[-1]) + 3

    def wander(sigma: float) -> Array:
        rho = np.exp(-1 / 10)
        value = np.zeros(knots)
        value[0] = rng.normal()
        for i in range(1, knots):
            value[i] = rho * value[i - 1] + np.sqrt(1 - rho**2) * rng.normal()
        return sigma * np.interp(at, np.arange(knots), value)

    moved = position + np.column_stack(
        [wander(flight.position_sigma_m), wander(flight.position_sigma_m), wander(flight.height_sigma_m)]
    )
    yaw = heading + wander(flight.yaw_sigma_rad)
    roll, pitch = wander(flight.tilt_sigma_rad), wander(flight.tilt_sigma_rad)
    c, s = np.cos(yaw), np.sin(yaw)
    x, y, z = local[..., 0], local[..., 1], local[..., 2]
    x, z = x + pitch[:, None] * z, z - pitch[:, None] * x
    y, z = y - roll[:, None] * z, z + roll[:, None] * y
    return np.stack(
        [
            c[:, None] * x - s[:, None] * y + moved[:, 0:1],
            s[:, None] * x + c[:, None] * y + moved[:, 1:2],
            z + moved[:, 2:3],
        ],
        axis=-1,
    )


def distance_to_wall(hall: Hall, points: Array) -> Array:
    return edge_distance(hall.footprint, points[:, 0], points[:, 1])
