"""A small hall to cast rays in, with exact truth: polygon walls, flat floor, ceiling, cones; and flights through it.

Made for these tests alone and of simple formulas, so that it shares no code with simbridge nor with companion.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from companion.messages import AttitudeSample, LidarGeometry, LidarScan, RangefinderSample

Array = NDArray[np.float64]
COLUMNS = 512


def rectangle(length: float, width: float, x: float = 0.0, y: float = 0.0) -> Array:
    """(4, 2) corners."""
    return np.array([[0, 0], [length, 0], [length, width], [0, width]], float) + (x, y)


def circle(radius: float, x: float, y: float, corners: int = 240) -> Array:
    a = np.arange(corners) * 2 * math.pi / corners
    return np.stack((x + radius * np.cos(a), y + radius * np.sin(a)), axis=1)


@dataclass
class Hall:
    """walls: outlines, each a closed polygon (footprint and columns). cones: x, y, radius, height."""

    walls: list[Array]
    height_m: float = 15.0
    cones: list[tuple[float, float, float, float]] = field(default_factory=list)

    def cast(self, origin: Array, direction: Array) -> Array:
        """(N,) distance along each ray to the first surface."""
        best = np.full(len(origin), np.inf)
        for outline in self.walls:
            for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True):
                best = np.minimum(best, self._wall(origin, direction, a, b))
        with np.errstate(divide="ignore", invalid="ignore"):
            for level in (0.0, self.height_m):
                t = (level - origin[:, 2]) / direction[:, 2]
                best = np.where((t > 1e-6) & (t < best), t, best)
        for cone in self.cones:
            best = np.minimum(best, self._cone(origin, direction, cone))
        return best

    @staticmethod
    def _wall(o: Array, d: Array, a: Array, b: Array) -> Array:
        e = b - a
        det = d[:, 0] * -e[1] + d[:, 1] * e[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = ((a[0] - o[:, 0]) * -e[1] + (a[1] - o[:, 1]) * e[0]) / det
            u = (d[:, 0] * (a[1] - o[:, 1]) - d[:, 1] * (a[0] - o[:, 0])) / det
        return np.where((t > 1e-6) & (u >= 0) & (u <= 1), t, np.inf)

    @staticmethod
    def _cone(o: Array, d: Array, cone: tuple[float, float, float, float]) -> Array:
        cx, cy, radius, height = cone
        k2 = (radius / height) ** 2
        x, y, z = o[:, 0] - cx, o[:, 1] - cy, height - o[:, 2]
        a = d[:, 0] ** 2 + d[:, 1] ** 2 - k2 * d[:, 2] ** 2
        b = x * d[:, 0] + y * d[:, 1] + k2 * z * d[:, 2]
        c = x * x + y * y - k2 * z * z
        disc = np.maximum(b * b - a * c, 0.0)
        best = np.full(len(o), np.inf)
        with np.errstate(divide="ignore", invalid="ignore"):
            for sign in (-1.0, 1.0):
                t = (-b + sign * np.sqrt(disc)) / a
                level = o[:, 2] + t * d[:, 2]
                good = (b * b >= a * c) & (t > 1e-6) & (level >= 0) & (level <= height)
                best = np.where(good & (t < best), t, best)
        return best


def lidar_geometry(elevations_deg: tuple[float, ...] = (0.0, -11.25, -22.5, -33.75, -45.0)) -> LidarGeometry:
    """Columns turn clockwise from behind, as an Ouster's encoder counts."""
    elevation = np.radians(np.array(elevations_deg))
    azimuth = math.pi - 2 * math.pi * np.arange(COLUMNS) / COLUMNS
    directions = np.stack(
        (
            np.cos(elevation)[:, None] * np.cos(azimuth),
            np.cos(elevation)[:, None] * np.sin(azimuth),
            np.repeat(np.sin(elevation)[:, None], COLUMNS, axis=1),
        ),
        axis=2,
    )
    return LidarGeometry(
        directions=directions, offsets_m=np.zeros_like(directions), elevation_rad=elevation, horizontal_row=0
    )


@dataclass
class Track:
    """The true flight at 50 Hz: t_s (N,), position (N, 3), roll, pitch, yaw (N, 3), in world."""

    t_s: Array
    position: Array
    rpy: Array

    def at(self, t_s: Array) -> tuple[Array, Array]:
        position = np.stack([np.interp(t_s, self.t_s, self.position[:, k]) for k in range(3)], axis=1)
        rpy = np.stack([np.interp(t_s, self.t_s, self.rpy[:, k]) for k in range(3)], axis=1)
        return position, rpy


def fly(
    start: tuple[float, float, float],
    legs: list[tuple[float, float, float, float]],
    *,
    stand_s: float = 20.0,
    up_m: float = 0.2,
) -> Track:
    """A track from legs of (duration s, forward m/s, up m/s, turn deg/s), with lags and the tilt they need."""
    dt = 0.02
    position, yaw = np.array([start[0], start[1], up_m]), start[2]
    velocity, wanted, rate = np.zeros(3), np.zeros(3), 0.0
    rows: list[Array] = []
    for duration, forward, up, turn in [(stand_s, 0.0, 0.0, 0.0), *legs]:
        for _ in range(round(duration / dt)):
            command = np.array([forward * math.cos(yaw), forward * math.sin(yaw), up])
            wanted = wanted + (command - wanted) * dt / 0.4
            acceleration = (wanted - velocity) / 0.4
            velocity = velocity + acceleration * dt
            rate += (math.radians(turn) - rate) * dt / 0.2
            yaw += rate * dt
            position = position + velocity * dt
            ahead = math.cos(yaw) * acceleration[0] + math.sin(yaw) * acceleration[1]
            left = -math.sin(yaw) * acceleration[0] + math.cos(yaw) * acceleration[1]
            rows.append(np.array([*position, -math.atan(left / 9.81), math.atan(ahead / 9.81), yaw]))
    table = np.array(rows)
    return Track(np.arange(len(table)) * dt, table[:, :3], table[:, 3:])


def lap(length: float, width: float, distance: float, speed: float, *, climb_m: float = 8.8) -> tuple[Track, Array]:
    """Start near a corner, climb, once round a rectangular hall at that distance from the walls, land."""
    turn = (90.0 / 20.0, speed, 0.0, 20.0)
    radius = speed / math.radians(20.0)
    long, short = length - 2 * distance - 2 * radius, width - 2 * distance - 2 * radius
    legs = [(climb_m / 0.8, 0.0, 0.8, 0.0), (2.0, 0.0, 0.0, 0.0)]
    for side in (long, short, long, short):
        legs += [(side / speed, speed, 0.0, 0.0), turn]
    legs += [(3.0, 0.0, 0.0, 0.0), ((climb_m - 0.1) / 0.7, 0.0, -0.7, 0.0)]
    start = (distance + radius, distance, 0.0)
    return fly(start, legs), np.array(start)


@dataclass
class Noise:
    range_m: float = 0.12
    tilt_deg: float = 0.3  # wandering, over 20 s
    tilt_bias_deg: tuple[float, float] = (0.0, 0.0)
    tilt_white_rad: float = 5e-4
    gyro_radps: float = 0.002
    gyro_bias_radps: float = 0.0005
    rangefinder_m: float = 0.02


def _rotations(rpy: Array) -> Array:
    cr, sr = np.cos(rpy[:, 0]), np.sin(rpy[:, 0])
    cp, sp = np.cos(rpy[:, 1]), np.sin(rpy[:, 1])
    cy, sy = np.cos(rpy[:, 2]), np.sin(rpy[:, 2])
    return np.stack(
        [
            np.stack([cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr], axis=1),
            np.stack([sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr], axis=1),
            np.stack([-sp, cp * sr, cp * cr], axis=1),
        ],
        axis=1,
    )


def _quaternion(roll: float, pitch: float, yaw: float) -> Array:
    half = np.array([roll, pitch, yaw]) / 2
    (cr, cp, cy), (sr, sp, sy) = np.cos(half), np.sin(half)
    return np.array(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


def stream(
    hall: Hall,
    track: Track,
    geometry: LidarGeometry,
    noise: Noise,
    seed: int,
    *,
    mount_m: tuple[float, float, float] = (0.0, 0.0, 0.08),
    max_range_m: float = 50.0,
    mount_error_deg: tuple[float, float] = (0.0, 0.0),
) -> Iterator[AttitudeSample | RangefinderSample | LidarScan]:
    """All that the odometry hears on that flight, in order of arrival."""
    rng = np.random.default_rng(seed)
    scans = round((track.t_s[-1] - 0.2) * 10)
    wander = np.zeros(2)
    directions, elevations = geometry.directions, geometry.directions.shape[0]
    tilt_error = _rotations(np.array([[*np.radians(mount_error_deg), 0.0]]))[0]
    k = 0
    for frame in range(scans):
        t_end = 0.1 * (frame + 1)
        while k < len(track.t_s) and track.t_s[k] <= t_end + 0.011:
            wander += -wander * 0.02 / 20.0 + rng.normal(size=2) * math.radians(noise.tilt_deg) * math.sqrt(0.04 / 20.0)
            roll, pitch = (
                track.rpy[k, :2] + wander + np.radians(noise.tilt_bias_deg) + rng.normal(size=2) * noise.tilt_white_rad
            )
            ahead, back = min(k + 1, len(track.t_s) - 1), max(k - 1, 0)
            rate = (track.rpy[ahead] - track.rpy[back]) / max(track.t_s[ahead] - track.t_s[back], 1e-9)
            rate = rate + rng.normal(size=3) * noise.gyro_radps + (0, 0, noise.gyro_bias_radps)
            t_ns = round(track.t_s[k] * 1e9)
            yield AttitudeSample(
                t_ns=t_ns,
                q_ref_body_wxyz=_quaternion(roll, pitch, track.rpy[k, 2] + 0.7),
                rate_body_radps=rate,
            )
            down = hall.cast(track.position[k : k + 1], np.array([[0.0, 0.0, -1.0]]))[0]
            yield RangefinderSample(t_ns=t_ns, distance_m=float(down + rng.normal() * noise.rangefinder_m))
            k += 1
        t_column = t_end - 0.1 + 0.1 * (np.arange(COLUMNS) + 1) / COLUMNS
        position, rpy = track.at(t_column)
        r = _rotations(rpy)
        origin = position + r @ np.array(mount_m)
        d = np.einsum("cij,jk,rck->rci", r, tilt_error, directions).reshape(-1, 3)
        ranges = hall.cast(np.tile(origin, (elevations, 1)), d).reshape(elevations, COLUMNS)
        measured = ranges + rng.normal(size=ranges.shape) * noise.range_m
        measured[(ranges > max_range_m) | (ranges < 0.3) | (measured < 0.3)] = 0.0
        yield LidarScan(
            t_ns=round(t_end * 1e9),
            frame_id=frame,
            t_column_ns=np.round(t_column * 1e9).astype(np.int64),
            range_m=measured.astype(np.float32),
            signal=np.ones_like(measured, np.float32),
            column_valid=np.ones(COLUMNS, bool),
            geometry=geometry,
        )


def truth_in_map(track: Track, t_ns: int, t0_ns: int) -> Array:
    """(4,) x, y, z, yaw of the body, relative to where it was at t0_ns."""
    p, rpy = track.at(np.array([t_ns * 1e-9, t0_ns * 1e-9]))
    yaw0 = rpy[1, 2]
    d = p[0] - p[1]
    c, s = math.cos(yaw0), math.sin(yaw0)
    return np.array([c * d[0] + s * d[1], -s * d[0] + c * d[1], d[2], rpy[0, 2] - yaw0])
