"""To the hall's wall from anywhere in it: back off if it is too near, else turn to it and fly up to it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from companion.config import NavigatorConfig
from companion.geometry import wrap_angle
from companion.messages import Array
from companion.navigator.scan_view import BEARING_RAD, DIRECTION, FAR_M, SECTORS, ScanView, Wall
from companion.navigator.wall_follower import (
    BRAKE_GAIN_PER_S,
    FRONT_RAD,
    TURN_MARGIN_M,
    YAW_GAIN_PER_S,
    Pose2,
    Steering,
)

EDGE_JUMP_M = 1.5  # a surface that ends with what lies behind it so much farther away stands in front of it
MAX_ISLAND_WIDTH_M = 15.0
MAX_HOLE_SECTORS = 6  # drop-outs in a wall are not its end
TRIED_DEG = 5


TOO_NEAR_M = 0.5  # nearer than D by this: back off first
FACING_RAD = math.radians(5)
ROOM_STEPS_M = (1.6, 0.8)  # so far off the room is tried; half the longer one is less than any start's room
MIN_GAIN = 0.25  # of the step: less is a place in the middle, or the noise
MAX_LOSS_M = 0.1  # on the way, of the room there is


@dataclass(frozen=True, slots=True)
class Island:
    """A round place in map that was gone round and is not the hall's wall."""

    x: float
    y: float
    radius_m: float


class Phase(Enum):
    LOOK = "look"
    RETREAT = "retreat"
    ORIENT = "orient"
    APPROACH = "approach"
    FOUND = "found"


class WallFinder:
    """From a hover to a wall at distance D; then `phase` is FOUND and `wall` the one to turn to (body bearing)."""

    def __init__(self, cfg: NavigatorConfig, lane_m: float) -> None:
        self._cfg = cfg
        self._lane = lane_m
        self._turn_rate = math.radians(cfg.turn_rate_dps)
        self._target_yaw = 0.0
        self._away_yaw = 0.0
        self._lack_m = 0.0
        self._front_m = math.inf
        self.phase = Phase.LOOK
        self.wall: Wall | None = None

    def see(self, view: ScanView, pose: Pose2, islands: tuple[Island, ...]) -> None:
        """Take in a new scan and the pose it was taken at."""
        standing = free_standing(view.smooth_m) | within(view.smooth_m, pose, islands)
        around = _nearest(view.smooth_m)
        wall = _nearest(np.where(standing, np.inf, view.smooth_m)) or around
        if around is None or wall is None:
            self.phase = Phase.LOOK
            return
        if self.phase in (Phase.LOOK, Phase.RETREAT):
            self._make_room(view, pose, standing, around, wall)
        if self.phase is Phase.LOOK:
            self._choose(view, pose, standing)
        elif self.phase is Phase.APPROACH:
            self._front_m, front = view.ahead(0.0, self._lane, self._lane)
            if self._front_m <= self._cfg.wall_distance_m + TURN_MARGIN_M:
                self._found(view, front)
            elif wall[0] < self._cfg.wall_distance_m - TOO_NEAR_M:
                self._found(view, wall[1])

    def step(self, pose: Pose2, speed_mps: float) -> Steering:
        """What to do now at most at this speed."""
        off = wrap_angle(self._target_yaw - pose.yaw)
        turn = max(-self._turn_rate, min(self._turn_rate, YAW_GAIN_PER_S * off))
        if self.phase is Phase.ORIENT and abs(off) < FACING_RAD:
            self.phase = Phase.APPROACH
        if self.phase is Phase.RETREAT:
            speed = min(speed_mps, 0.1 + 0.4 * self._lack_m)
            bearing = self._away_yaw - pose.yaw
            return self._steer(speed * math.cos(bearing), speed * math.sin(bearing), 0.0)
        if self.phase is Phase.ORIENT:
            return self._steer(0.0, 0.0, turn)
        if self.phase is Phase.APPROACH:
            brake = BRAKE_GAIN_PER_S * (self._front_m - self._cfg.wall_distance_m)
            return self._steer(min(speed_mps, max(0.05, brake)), 0.0, turn)
        return self._steer(0.0, 0.0, 0.0)

    def _make_room(
        self, view: ScanView, pose: Pose2, standing: NDArray[np.bool_], around: tuple[float, float],
        wall: tuple[float, float],
    ) -> None:  # fmt: skip
        """Back off from a wall nearer than D, from anything else nearer than a lane; one may then be at the wall."""
        retreating = self.phase is Phase.RETREAT
        to_wall = self._cfg.wall_distance_m - (0.2 if retreating else TOO_NEAR_M)
        to_other = self._lane - (0.0 if retreating else 0.3)
        lack = max(to_wall - wall[0], to_other - around[0])
        if lack <= 0.0:
            self.phase = Phase.LOOK
            if retreating and wall[0] < self._cfg.wall_distance_m + TOO_NEAR_M:
                self._found(view, wall[1])
            return
        bearing = roomier(view, standing, to_wall, to_other)
        if bearing is None:  # as near on the other side
            self._found(view, wall[1])
            return
        self.phase = Phase.RETREAT
        self._away_yaw = wrap_angle(pose.yaw + bearing)
        self._lack_m = lack

    def _choose(self, view: ScanView, pose: Pose2, standing: NDArray[np.bool_]) -> None:
        bearing = wall_bearing(view, self._lane, standing)
        if bearing is not None:
            self._target_yaw = wrap_angle(pose.yaw + bearing)
            self._front_m, _ = view.ahead(bearing, self._lane, self._lane)
            self.phase = Phase.ORIENT

    def _found(self, view: ScanView, bearing_rad: float) -> None:
        self.wall = view.wall(bearing_rad - FRONT_RAD, bearing_rad + FRONT_RAD)
        if self.wall is not None:
            self.phase = Phase.FOUND

    def _steer(self, forward: float, left: float, yaw_rate: float) -> Steering:
        return Steering(forward, left, yaw_rate, False, None, self._front_m)


def roomier(view: ScanView, standing: NDArray[np.bool_], to_wall_m: float, to_other_m: float) -> float | None:
    """Body bearing in which most room is gained; None in the middle of a narrow place.

    Of the wanted room, to_wall_m to walls and to_other_m to anything, as much is lacking as at its worst place: out of
    a corner the way is between the walls, not straight off the nearer one, and between two columns across their line.
    """
    seen = np.isfinite(view.smooth_m)
    things = view.smooth_m[seen, None] * DIRECTION[seen]
    wanted = np.where(standing[seen], to_other_m, max(to_wall_m, to_other_m))
    lacking = float(np.max(wanted - view.smooth_m[seen]))
    for step_m in ROOM_STEPS_M:
        halfway, there = (_lacking_at(things, wanted, 0.5 * step_m), _lacking_at(things, wanted, step_m))
        there = np.where(halfway < lacking + MAX_LOSS_M, there, np.inf)
        best = int(np.argmin(there))
        if lacking - float(there[best]) > MIN_GAIN * step_m:
            return float(BEARING_RAD[best * TRIED_DEG])
    return None


def _lacking_at(things: Array, wanted: Array, step_m: float) -> Array:
    """(72,) the room lacking after a step in each of the tried bearings. things (N, 2), wanted (N,)."""
    off = things[None, :, :] - step_m * DIRECTION[::TRIED_DEG, None, :]
    return np.asarray(np.max(wanted[None, :] - np.hypot(off[:, :, 0], off[:, :, 1]), axis=1))


def wall_bearing(view: ScanView, lane_m: float, standing: NDArray[np.bool_]) -> float | None:
    """Body bearing of the shortest free lane to a wall; None if nothing is seen.

    standing: (360,) sectors that show free-standing things: those are no walls, unless there is nothing else.
    """
    best: tuple[bool, float, float] | None = None
    for n in range(0, SECTORS, TRIED_DEG):
        distance, hit_rad = view.ahead(float(BEARING_RAD[n]), lane_m, lane_m)
        if math.isfinite(distance):
            hit = round(math.degrees(hit_rad)) % SECTORS
            tried = (bool(standing[hit]), distance, float(BEARING_RAD[n]))
            best = tried if best is None or tried < best else best
    return None if best is None else best[2]


def free_standing(smooth_m: Array) -> NDArray[np.bool_]:
    """(360,) True where a surface seems to be an island: narrow, with a step outward at both ends."""
    ranges = _without_holes(smooth_m)
    far = np.where(np.isfinite(ranges), ranges, FAR_M)
    step = np.roll(far, -1) - far  # from sector n to n + 1, counter-clockwise
    edges = np.flatnonzero(np.abs(step) > EDGE_JUMP_M)  # between n and n + 1
    out = np.zeros(SECTORS, dtype=np.bool_)
    for start, end in zip(edges, np.roll(edges, -1), strict=True):
        members = np.arange(start + 1, end + 1 + (SECTORS if end <= start else 0)) % SECTORS
        if len(edges) < 2 or not np.isfinite(ranges[members]).all():
            continue
        outward = step[start] < 0 and step[end] > 0
        ends = ranges[members[[0, -1]], None] * DIRECTION[members[[0, -1]]]
        width = math.hypot(*(ends[0] - ends[1]))
        if outward and width < MAX_ISLAND_WIDTH_M and len(members) < SECTORS // 3:
            out[members] = True
    return out


def _without_holes(ranges: Array) -> Array:
    """Short gaps filled from their nearer side."""
    filled = ranges.copy()
    finite = np.isfinite(ranges)
    if not finite.any():
        return filled
    for n in np.flatnonzero(~finite):
        for reach in range(1, MAX_HOLE_SECTORS):
            before, after = ranges[(n - reach) % SECTORS], ranges[(n + reach) % SECTORS]
            if math.isfinite(before) or math.isfinite(after):
                filled[n] = min(before, after)
                break
    return filled


def _nearest(ranges: Array) -> tuple[float, float] | None:
    n = int(np.argmin(ranges))
    return (float(ranges[n]), float(BEARING_RAD[n])) if math.isfinite(ranges[n]) else None


def within(ranges: Array, pose: Pose2, islands: tuple[Island, ...]) -> NDArray[np.bool_]:
    """(360,) True where a return lies on something that was gone round before."""
    out = np.zeros(SECTORS, dtype=np.bool_)
    finite = np.isfinite(ranges)
    reach = np.where(finite, ranges, 0.0)
    x = pose.x + reach * np.cos(BEARING_RAD + pose.yaw)
    y = pose.y + reach * np.sin(BEARING_RAD + pose.yaw)
    for island in islands:
        out |= finite & (np.hypot(x - island.x, y - island.y) < island.radius_m)
    return out
