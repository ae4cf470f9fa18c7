"""What the guard knows of the air about the vehicle: the newest return each way, and where nobody looked."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from companion.messages import Array, WallRanges

SECTORS = 360
REMEMBERED_NS = 350_000_000  # a sector of a lost packet is known from the scans before, so long
NEAR_REMEMBERED_NS = 500_000_000  # a near thing that vanishes may be nearer than the sensor can see
REACTION_S = 0.5  # age of the scan and the lag of the vehicle's velocity
WAY_SECTORS = 12  # to each side of the motion: as wide as the vehicle at 2.5 m
BLIND_SECTORS = 5  # so many in a row unknown in the way: something could hide there
LONG_AGO_NS = -(10**15)
MIN_SEEN = 18  # returns all round: with fewer nothing is seen at all
HOME_MARGIN_M = 0.2  # error of the position since: may come so much nearer to a thing than the place of take-off is
AIRFRAME_M = 0.6  # never nearer to anything than the tips of the rotors reach, and a little


def allowed_speed(room_m: Array | float, deceleration_mps2: float) -> Array:
    """Greatest speed v with v * reaction + v^2 / 2a <= room; 0 where there is no room."""
    room = np.maximum(np.asarray(room_m, dtype=np.float64), 0.0)
    a = deceleration_mps2
    return np.asarray(a * (np.sqrt(REACTION_S**2 + 2.0 * room / a) - REACTION_S))


class Surroundings:
    """Nearest return by map bearing, as places in map, so that they stay where they are while the vehicle moves."""

    def __init__(self, stop_distance_m: float, deceleration_mps2: float) -> None:
        self._stop = stop_distance_m
        self._deceleration = deceleration_mps2
        self._places = np.full((SECTORS, 2), np.inf)
        self._place_ns = np.full(SECTORS, LONG_AGO_NS, dtype=np.int64)  # when the place was measured
        self._looked_ns = np.full(SECTORS, LONG_AGO_NS, dtype=np.int64)  # when anybody looked there
        self._home: Array | None = None  # (2,) where it took off, map
        self._home_stop = stop_distance_m

    def take_off(self, x: float, y: float) -> None:
        """From here: it stood there and will land there, however near things are to that place."""
        self._home = np.array([x, y])
        nearest = float(np.hypot(self._places[:, 0] - x, self._places[:, 1] - y).min()) - HOME_MARGIN_M
        self._home_stop = min(self._stop, max(nearest, AIRFRAME_M))

    def see(self, walls: WallRanges, x: float, y: float, yaw: float) -> None:
        """Take in a scan and the pose it was taken at."""
        ranges = np.asarray(walls.ranges_m, dtype=np.float64)
        body = (np.arange(SECTORS) - round(math.degrees(yaw))) % SECTORS
        ranges = ranges[body]
        bearing = np.radians(body) + yaw
        hit = np.isfinite(ranges) & (ranges > 0.0)
        free = np.isposinf(ranges) & np.asarray(walls.is_seen)[body]
        self._looked_ns[hit | free] = walls.t_ns
        reach = np.where(hit, ranges, 0.0)
        places = np.column_stack([x + reach * np.cos(bearing), y + reach * np.sin(bearing)])
        was_near = np.hypot(self._places[:, 0] - x, self._places[:, 1] - y) < self._stop + 0.5
        forgotten = free & ~(was_near & (walls.t_ns - self._place_ns < NEAR_REMEMBERED_NS))
        self._places[forgotten] = np.inf
        self._place_ns[forgotten] = LONG_AGO_NS
        self._places[hit] = places[hit]
        self._place_ns[hit] = walls.t_ns

    def limit(self, velocity_xy: Array, x: float, y: float, t_ns: int) -> tuple[Array, str]:
        """The velocity with what leads too near to something taken off, and why; never faster than it came."""
        speed = float(np.hypot(*velocity_xy))
        if speed == 0.0:
            return np.zeros(2), ""
        fresh = t_ns - self._place_ns <= NEAR_REMEMBERED_NS
        if int(np.count_nonzero(fresh)) < MIN_SEEN:
            return np.zeros(2), "nothing is seen"
        reach = self._stop + speed * REACTION_S + speed**2 / (2.0 * self._deceleration)
        off = self._places - np.array([x, y])
        distance = np.hypot(off[:, 0], off[:, 1])
        near = fresh & (distance < reach)  # only what is so near can limit this speed
        direction = off[near] / np.maximum(distance[near], 1e-9)[:, None]
        limit = allowed_speed(distance[near] - self._stop_at(self._places[near]), self._deceleration)
        velocity, why = _slide(velocity_xy, direction, limit)
        if velocity.any() and self._is_blind(velocity, t_ns):
            return np.zeros(2), "nobody looked that way"
        return velocity, why

    def _stop_at(self, places: Array) -> Array | float:
        """How near each place (N, 2) may come: the stop distance, or as near as it is to where we took off.

        So a start by a wall can be left and come back to, and nothing else is passed any nearer. What came to stand
        there meanwhile may come no nearer than the nearest thing was at take-off.
        """
        if self._home is None or self._home_stop >= self._stop:
            return self._stop
        from_home = np.hypot(places[:, 0] - self._home[0], places[:, 1] - self._home[1])
        return np.asarray(np.clip(from_home - HOME_MARGIN_M, self._home_stop, self._stop))

    def _is_blind(self, velocity: Array, t_ns: int) -> bool:
        centre = round(math.degrees(math.atan2(float(velocity[1]), float(velocity[0]))))
        way = np.arange(centre - WAY_SECTORS, centre + WAY_SECTORS + 1) % SECTORS
        unknown: NDArray[np.bool_] = t_ns - self._looked_ns[way] > REMEMBERED_NS
        if not unknown.any():
            return False
        run = longest = 0
        for flag in unknown:
            run = run + 1 if flag else 0
            longest = max(longest, run)
        return longest > BLIND_SECTORS


def _slide(velocity: Array, direction: Array, limit: Array) -> tuple[Array, str]:
    """Take off, worst first, what closes in faster than allowed; stop if that does not end."""
    v = np.array(velocity, dtype=np.float64)
    if len(limit) == 0:
        return v, ""
    touched = False
    for _ in range(12):
        excess = direction @ v - limit
        worst = int(np.argmax(excess))
        if excess[worst] <= 1e-9:
            return v, "an obstacle is near" if touched else ""
        touched = True
        v = v - excess[worst] * direction[worst]
    return np.zeros(2), "an obstacle is near"
