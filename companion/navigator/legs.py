"""The legs of a mission: up, to the wall, round, home. Each flies until it ends, and says how it ended."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import numpy as np

from companion.config import CompanionConfig, NavigatorConfig
from companion.geometry import wrap_angle
from companion.navigator.find_wall import Island, Phase, WallFinder
from companion.navigator.lap import Lap, LapTracker
from companion.navigator.motion import STILL, Motion, climb_rate, steered, towards
from companion.navigator.route import Path, Route
from companion.navigator.scan_view import Wall
from companion.navigator.situation import Situation
from companion.navigator.wall_follower import Pose2, WallFollower

AT_HEIGHT_M = 0.15
HEIGHT_KEEPING_MPS = 0.4
STATION_MPS = 0.3  # at most, to stay above a place while climbing and sinking
STUCK_NS = 45_000_000_000
STUCK_M = 1.0
AT_HOME_M = 0.2
NEAR_HOME_M = 0.9  # near enough, when it comes no nearer: something stands by the start
NO_NEARER_S = 6.0
MIN_WALL_SHARE = 0.2  # of a lap, in time, along something that has a line; a silo's wall has one, columns have none
HANDOVER_M = 1.5  # above the start: from here down the flight controller's own land mode


class Ending(Enum):
    ARRIVED = "arrived"
    ISLAND = "island"  # went round something that is not the hall's wall
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class Start:
    """Where the mission was armed, map."""

    x: float
    y: float
    z: float

    @property
    def place(self) -> tuple[float, float]:
        return self.x, self.y

    def is_far(self, pose: Pose2, cfg: NavigatorConfig) -> bool:
        return math.hypot(pose.x - self.x, pose.y - self.y) > cfg.max_distance_from_start_m


Flown = tuple[Motion, Ending | None]


class StuckWatch:
    """Tells when no place was reached that is a metre from where we were a while ago."""

    def __init__(self, cfg: NavigatorConfig) -> None:
        self._limit_ns = STUCK_NS + round(3e9 * STUCK_M / cfg.forward_speed_mps)
        self._anchor: tuple[float, float, int] | None = None

    def step(self, now: Situation) -> bool:
        x, y = now.pose.x, now.pose.y
        if self._anchor is None or math.hypot(x - self._anchor[0], y - self._anchor[1]) > STUCK_M:
            self._anchor = (x, y, now.t_ns)
        return now.t_ns - self._anchor[2] > self._limit_ns


class Climb:
    """Straight up above the start."""

    def __init__(self, cfg: NavigatorConfig, start: Start, t_ns: int) -> None:
        self._cfg, self._start, self._since_ns = cfg, start, t_ns
        self._limit_s = 30.0 + 3.0 * cfg.height_m / cfg.climb_speed_mps

    def step(self, now: Situation) -> Flown:
        height = now.z_m - self._start.z
        if abs(self._cfg.height_m - height) < AT_HEIGHT_M:
            return STILL, Ending.ARRIVED
        up = climb_rate(height, self._cfg.height_m, self._cfg.climb_speed_mps)
        late = now.since_s(self._since_ns) > self._limit_s
        return towards(now.pose, self._start.place, STATION_MPS, up), Ending.FAILED if late else None


class Search:
    """To the wall. `wall` is then the one to turn to, seen from the scan's pose."""

    def __init__(self, cfg: NavigatorConfig, start: Start, lane_m: float, islands: tuple[Island, ...]) -> None:
        self._cfg, self._start, self._islands = cfg, start, islands
        self._finder = WallFinder(cfg, lane_m)
        self._stuck = StuckWatch(cfg)

    @property
    def wall(self) -> Wall | None:
        return self._finder.wall

    def step(self, now: Situation) -> Flown:
        if now.view is not None:
            self._finder.see(now.view, now.view_pose, self._islands)
        up = climb_rate(now.z_m - self._start.z, self._cfg.height_m, HEIGHT_KEEPING_MPS)
        motion = steered(self._finder.step(now.pose, _speed(self._cfg, now)), now.pose, up)
        if self._finder.phase is Phase.FOUND:
            return motion, Ending.ARRIVED
        return motion, Ending.FAILED if self._stuck.step(now) else None


class Round:
    """Along the wall until a lap has closed."""

    def __init__(self, config: CompanionConfig, start: Start) -> None:
        self._cfg, self._start = config.navigator, start
        self._follower = WallFollower(config)
        self._lap = LapTracker()
        self._stuck = StuckWatch(config.navigator)
        self._steps, self._steps_along_wall = 0, 0
        self.is_straight = False

    @property
    def turned_rad(self) -> float:
        """Net, counter-clockwise, in this lap."""
        return self._lap.turned_rad

    def begin(self, wall: Wall | None, now: Situation) -> None:
        self._follower.start(turning_to=wall, pose=now.view_pose)
        self.again()

    def again(self) -> None:
        """Count a new lap from here."""
        self._lap = LapTracker()
        self._stuck = StuckWatch(self._cfg)
        self._steps, self._steps_along_wall = 0, 0

    def island(self) -> Island:
        """What the path so far went round."""
        places = self._lap.loop_places()
        centre = places.mean(axis=0)
        return Island(float(centre[0]), float(centre[1]), float(np.hypot(*(places - centre).T).max()))

    def step(self, now: Situation) -> Flown:
        if now.view is not None:
            self._follower.see(now.view, now.view_pose)
        steering = self._follower.step(now.pose, _speed(self._cfg, now))
        self.is_straight = steering.is_straight
        self._steps += 1
        self._steps_along_wall += steering.is_along_wall
        up = climb_rate(now.z_m - self._start.z, self._cfg.height_m, HEIGHT_KEEPING_MPS)
        motion = steered(steering, now.pose, up)
        lap = self._lap.add(now.pose)
        if lap is Lap.CLOSED and self._steps_along_wall > MIN_WALL_SHARE * self._steps:
            return motion, Ending.ARRIVED
        if lap is not Lap.OPEN:  # round a column, or round and round among columns
            return motion, Ending.ISLAND
        return motion, Ending.FAILED if self._stuck.step(now) else None


class Homeward:
    """To above the start: straight where the scan shows the way free, else along the flown path."""

    def __init__(self, config: CompanionConfig, start: Start, path: Path, *, only_flown: bool) -> None:
        self._cfg, self._start = config.navigator, start
        self._route = Route(path, start.place, config.guard.stop_distance_m + 0.5, only_flown=only_flown)
        self._stuck = StuckWatch(config.navigator)
        self._nearest_m, self._nearest_ns = math.inf, 0

    def step(self, now: Situation) -> Flown:
        if now.view is not None:
            self._route.see(now.view, now.view_pose)
        self._route.step(now.pose)
        x, y = self._route.target
        dx, dy = x - now.pose.x, y - now.pose.y
        distance = math.hypot(dx, dy)
        rate = 0.0
        if distance > 1.5:
            limit = math.radians(self._cfg.turn_rate_dps)
            rate = max(-limit, min(limit, wrap_angle(math.atan2(dy, dx) - now.pose.yaw)))
        up = climb_rate(now.z_m - self._start.z, self._cfg.height_m, HEIGHT_KEEPING_MPS)
        motion = towards(now.pose, (x, y), _speed(self._cfg, now), up, rate)
        if self._route.is_last and self._is_home(distance, now):
            return motion, Ending.ARRIVED
        return motion, Ending.FAILED if self._stuck.step(now) else None

    def _is_home(self, distance_m: float, now: Situation) -> bool:
        """There, or as near as the guard lets us come."""
        if distance_m < self._nearest_m - 0.05:
            self._nearest_m, self._nearest_ns = distance_m, now.t_ns
        no_nearer = distance_m < NEAR_HOME_M and now.since_s(self._nearest_ns) > NO_NEARER_S
        return distance_m < AT_HOME_M or no_nearer


class Descent:
    """Down above the start until the flight controller's land mode may take over."""

    def __init__(self, cfg: NavigatorConfig, start: Start) -> None:
        self._cfg, self._start = cfg, start

    def step(self, now: Situation) -> Flown:
        height = now.z_m - self._start.z
        if height < HANDOVER_M or not now.vision.is_good:
            return STILL, Ending.ARRIVED
        off = math.hypot(self._start.x - now.pose.x, self._start.y - now.pose.y)
        down = min(self._cfg.climb_speed_mps, 0.2 + 0.5 * (height - HANDOVER_M)) if off < 1.0 else 0.0
        return towards(now.pose, self._start.place, STATION_MPS, -down), None


def _speed(cfg: NavigatorConfig, now: Situation) -> float:
    return cfg.forward_speed_mps * now.vision.speed_ratio
