"""The paper's wall following: forward with the wall on the right, d_r held at D by the heading, left when d_f <= D.

What it adds to section 2.2: d_r and its rate come from a line fitted to the wall instead of one beam and its
difference, so that the derivative is not noise; the distance counts to the nearest thing on the right, so that
outer corners, columns and piles are rounded at D; and it stops to turn, so that both walls of a corner keep D.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from companion.config import CompanionConfig
from companion.geometry import wrap_angle
from companion.navigator.scan_view import ScanView, Wall

RIGHT = -math.pi / 2
WINDOW_RIGHT = (math.radians(-150), math.radians(20))  # where the wall on the right may be
WINDOW_LEFT = (math.radians(30), math.radians(150))
FRONT_RAD = math.radians(10)  # the wall ahead is fitted about the thing that stops us
TRACK_RAD = math.radians(35)  # the wall that is turned to is looked for so near its last bearing
ALIGNED_RAD = math.radians(3)
STEEP_RAD = math.radians(-30)  # heading so steeply to a wall nearer than D: stop and turn, as before a front wall
MAX_SIN_APPROACH = 0.5  # of the angle to the wall while coming back to D
MAX_SIDE_MPS = 0.15
SIDE_GAIN_PER_S = 0.15
BRAKE_GAIN_PER_S = 0.6
TURN_MARGIN_M = 0.1
YAW_GAIN_PER_S = 1.5
STRAIGHT_M = 1.0  # seen to both sides of the foot: neither at a corner nor beside a column
LANE_RIGHT_M = 1.0  # narrow on the right: there d_r keeps the distance
MIN_DAMPING_MPS = 0.25  # the derivative keeps working when slow


def lane_m(config: CompanionConfig) -> float:
    """Half width of a lane to fly in: what stands nearer to its middle line is in the way."""
    wall = config.navigator.wall_distance_m
    return min(max(0.5 * wall, config.guard.stop_distance_m + 0.4), 3.0, wall)


class FollowMode(Enum):
    AHEAD = "ahead"
    TURN = "turn"


@dataclass(frozen=True, slots=True)
class Pose2:
    """Body in map, level: metres, rad."""

    x: float
    y: float
    yaw: float


@dataclass(frozen=True, slots=True)
class Steering:
    """Velocity forward and to the left in the body's heading, and turn rate. right_m, front_m: what it was based on.

    is_along_wall: what is followed is a wall with a line, and not a column or a corner.
    """

    forward_mps: float
    left_mps: float
    yaw_rate_radps: float
    is_straight: bool
    right_m: float | None
    front_m: float
    is_along_wall: bool = False


@dataclass(frozen=True, slots=True)
class _MapWall:
    """A wall's line in map: points p with normal . p = offset; the normal points from us to it. is_straight: not
    near its end, nor a corner."""

    normal_rad: float
    offset_m: float
    is_line: bool
    is_straight: bool

    def distance_m(self, pose: Pose2) -> float:
        return self.offset_m - math.cos(self.normal_rad) * pose.x - math.sin(self.normal_rad) * pose.y


class WallFollower:
    """Holds which wall it follows, and whether it turns. Distances and speeds from the mission's configuration."""

    def __init__(self, config: CompanionConfig) -> None:
        cfg = config.navigator
        self._cfg = cfg
        self._turn_rate = math.radians(cfg.turn_rate_dps)
        self._lane_left = lane_m(config)
        self._beside_m = config.guard.stop_distance_m + 0.3
        self._left_m = math.inf
        self.mode = FollowMode.AHEAD
        self._wall: _MapWall | None = None
        self._front_m = math.inf

    def start(self, *, turning_to: Wall | None, pose: Pose2) -> None:
        """Begin anew: already along a wall, or (turning_to) facing one."""
        self._wall = _in_map(turning_to, pose) if turning_to is not None else None
        self.mode = FollowMode.TURN if turning_to is not None else FollowMode.AHEAD
        self._front_m = math.inf

    def see(self, view: ScanView, pose: Pose2) -> None:
        """Take in a new scan and the pose it was taken at."""
        # Eq. 4, as wide as the vehicle's lane.
        self._front_m, front_rad = view.ahead(0.0, self._lane_left, LANE_RIGHT_M, self._beside_m)
        left = view.nearest(*WINDOW_LEFT)
        self._left_m = left[0] if left is not None else math.inf
        if self.mode is FollowMode.TURN:
            self._track(view, pose)
            return
        wall = view.wall(*WINDOW_RIGHT)  # eq. 5, perpendicular to the wall
        self._wall = _in_map(wall, pose) if wall is not None else None
        if self._front_m <= self._cfg.wall_distance_m + TURN_MARGIN_M:
            self._turn_to(view.wall(front_rad - FRONT_RAD, front_rad + FRONT_RAD), pose)
        elif wall is not None and wall.distance_m < self._cfg.wall_distance_m + TURN_MARGIN_M:
            off_parallel = wrap_angle(RIGHT - wall.normal_rad)
            if off_parallel < STEEP_RAD:
                self._turn_to(wall, pose)

    def step(self, pose: Pose2, speed_mps: float) -> Steering:
        """What to do now at most at this speed."""
        if self.mode is FollowMode.TURN and self._wall is not None:
            left_to_turn = wrap_angle(self._wall.normal_rad - RIGHT - pose.yaw)
            if abs(left_to_turn) > ALIGNED_RAD:
                return self._turn(left_to_turn, pose)
        self.mode = FollowMode.AHEAD
        return self._ahead(pose, speed_mps)

    def _ahead(self, pose: Pose2, speed_mps: float) -> Steering:
        cfg = self._cfg
        speed = min(speed_mps, max(0.05, BRAKE_GAIN_PER_S * (self._front_m - cfg.wall_distance_m)))
        if self._wall is None:  # nothing on the right: look for it there, on a wide circle
            return Steering(0.7 * speed, 0.0, -0.7 * speed / cfg.wall_distance_m, False, None, self._front_m)
        distance = self._wall.distance_m(pose)
        error = cfg.wall_distance_m - distance  # > 0: too near
        # In a narrow place not nearer to what is on the left than a lane; in a narrower one in the middle.
        error = min(error, max(self._left_m - self._lane_left, 0.5 * (self._left_m - distance)))
        off_parallel = wrap_angle(pose.yaw - (self._wall.normal_rad - RIGHT))  # > 0: heading away from the wall
        damping = cfg.kd_per_m * max(speed, MIN_DAMPING_MPS)
        steepest = damping * MAX_SIN_APPROACH if damping > 0 else self._turn_rate
        # PD on d_r: kp (D - d_r) - kd d(d_r)/dt, with d(d_r)/dt = speed sin(off_parallel).
        yaw_rate = _clamp(cfg.kp_per_m * error, steepest) - damping * math.sin(off_parallel)
        forward = speed * (1.0 if abs(off_parallel) < math.radians(25) else 0.4)
        side = _clamp(SIDE_GAIN_PER_S * error, min(MAX_SIDE_MPS, 0.5 * speed_mps))
        straight = self._wall.is_straight and abs(off_parallel) < math.radians(10)
        rate = _clamp(yaw_rate, self._turn_rate)
        return Steering(forward, side, rate, straight, distance, self._front_m, self._wall.is_line)

    def _turn(self, left_to_turn: float, pose: Pose2) -> Steering:
        """On the spot, but for the drift that keeps D to the wall that is turned to."""
        assert self._wall is not None
        distance = self._wall.distance_m(pose)
        off = self._wall.normal_rad - pose.yaw
        creep = _clamp(0.4 * (distance - self._cfg.wall_distance_m), MAX_SIDE_MPS)
        rate = _clamp(YAW_GAIN_PER_S * left_to_turn, self._turn_rate)
        return Steering(creep * math.cos(off), creep * math.sin(off), rate, False, None, self._front_m)

    def _turn_to(self, wall: Wall | None, pose: Pose2) -> None:
        if wall is not None:
            self._wall = _in_map(wall, pose)
            self.mode = FollowMode.TURN

    def _track(self, view: ScanView, pose: Pose2) -> None:
        assert self._wall is not None
        expected = wrap_angle(self._wall.normal_rad - pose.yaw)
        wall = view.wall(expected - TRACK_RAD, expected + TRACK_RAD)
        if wall is not None:
            self._wall = _in_map(wall, pose)


def _in_map(wall: Wall, pose: Pose2) -> _MapWall:
    normal = wrap_angle(wall.normal_rad + pose.yaw)
    offset = math.cos(normal) * pose.x + math.sin(normal) * pose.y + wall.distance_m
    return _MapWall(normal, offset, wall.is_line, wall.is_line and min(wall.ends_m) > STRAIGHT_M)


def _clamp(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))
