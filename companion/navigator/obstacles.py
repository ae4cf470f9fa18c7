"""What the guard knows of the air about the vehicle: the newest return each way, and where nobody looked."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from companion.jit import kernel
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
MAX_SLIDES = 12
FREE, NEAR, UNSEEN, BLIND = range(4)
WHY = ("", "an obstacle is near", "nothing is seen", "nobody looked that way")


@kernel
def allowed_speed(room_m: Array | float, deceleration_mps2: float) -> Array:
    """Greatest speed v with v * reaction + v^2 / 2a <= room; 0 where there is no room."""
    room = np.maximum(room_m, 0.0)
    return deceleration_mps2 * (np.sqrt(REACTION_S**2 + 2.0 * room / deceleration_mps2) - REACTION_S)


class Surroundings:
    """Nearest return by map bearing, as places in map, so that they stay where they are while the vehicle moves."""

    def __init__(self, stop_distance_m: float, deceleration_mps2: float) -> None:
        self._stop = stop_distance_m
        self._deceleration = deceleration_mps2
        self._places = np.full((SECTORS, 2), np.inf)
        self._place_ns = np.full(SECTORS, LONG_AGO_NS, dtype=np.int64)  # when the place was measured
        self._looked_ns = np.full(SECTORS, LONG_AGO_NS, dtype=np.int64)  # when anybody looked there
        self._home = np.zeros(2)  # where it took off, map
        self._home_stop = stop_distance_m

    def take_off(self, x: float, y: float) -> None:
        """From here: it stood there and will land there, however near things are to that place."""
        self._home = np.array([x, y])
        nearest = float(np.hypot(self._places[:, 0] - x, self._places[:, 1] - y).min()) - HOME_MARGIN_M
        self._home_stop = min(self._stop, max(nearest, AIRFRAME_M))

    def see(self, walls: WallRanges, x: float, y: float, yaw: float) -> None:
        """Take in a scan and the pose it was taken at."""
        _take_in(
            np.asarray(walls.ranges_m, dtype=np.float64), np.asarray(walls.is_seen, dtype=np.bool_), walls.t_ns,
            x, y, yaw, self._stop + 0.5, self._places, self._place_ns, self._looked_ns,
        )  # fmt: skip

    def limit(self, velocity_xy: Array, x: float, y: float, t_ns: int) -> tuple[Array, str]:
        """The velocity with what leads too near to something taken off, and why; never faster than it came."""
        vx, vy, why = _slide(
            float(velocity_xy[0]), float(velocity_xy[1]), x, y, t_ns, self._stop, self._deceleration, self._places,
            self._place_ns, self._looked_ns, self._home, self._home_stop,
        )  # fmt: skip
        return np.array([vx, vy]), WHY[why]


@kernel
def _take_in(
    ranges: Array,
    is_seen: NDArray[np.bool_],
    t_ns: int,
    x: float,
    y: float,
    yaw: float,
    near_m: float,
    places: Array,
    place_ns: NDArray[np.int64],
    looked_ns: NDArray[np.int64],
) -> None:
    """Put a scan (360,) by body bearing into what is known by map bearing: places (360, 2), place_ns, looked_ns (360,)."""
    turned = round(math.degrees(yaw))
    for n in range(SECTORS):
        body = (n - turned) % SECTORS
        reach = ranges[body]
        is_hit = 0.0 < reach < np.inf
        is_free = reach == np.inf and is_seen[body]
        if is_hit or is_free:
            looked_ns[n] = t_ns
        if is_hit:
            bearing = math.radians(body) + yaw
            places[n, 0] = x + reach * math.cos(bearing)
            places[n, 1] = y + reach * math.sin(bearing)
            place_ns[n] = t_ns
        elif is_free:
            was_near = math.hypot(places[n, 0] - x, places[n, 1] - y) < near_m
            if not (was_near and t_ns - place_ns[n] < NEAR_REMEMBERED_NS):
                places[n] = np.inf
                place_ns[n] = LONG_AGO_NS


@kernel
def _slide(
    vx: float,
    vy: float,
    x: float,
    y: float,
    t_ns: int,
    stop_m: float,
    deceleration: float,
    places: Array,
    place_ns: NDArray[np.int64],
    looked_ns: NDArray[np.int64],
    home: Array,
    home_stop_m: float,
) -> tuple[float, float, int]:
    """Take off, worst first, what closes in faster than allowed; stop if that does not end. The last: which of WHY.

    Each place may come as near as stop_m, or as near as it is to home (where it took off): so a start by a wall can be
    left and come back to, and nothing else is passed any nearer. What came to stand there meanwhile may come no nearer
    than home_stop_m, as near as the nearest thing was at take-off.
    """
    speed = math.hypot(vx, vy)
    if speed == 0.0:
        return 0.0, 0.0, FREE
    reach = stop_m + speed * REACTION_S + speed**2 / (2.0 * deceleration)
    away, limit = np.empty((SECTORS, 2)), np.empty(SECTORS)
    known, near = 0, 0
    for n in range(SECTORS):
        if t_ns - place_ns[n] > NEAR_REMEMBERED_NS:
            continue
        known += 1
        dx, dy = places[n, 0] - x, places[n, 1] - y
        distance = math.hypot(dx, dy)
        if distance < reach:  # only what is so near can limit this speed
            away[near, 0] = dx / max(distance, 1e-9)
            away[near, 1] = dy / max(distance, 1e-9)
            from_home = math.hypot(places[n, 0] - home[0], places[n, 1] - home[1]) - HOME_MARGIN_M
            nearest = min(max(from_home, home_stop_m), stop_m)
            limit[near] = allowed_speed(distance - nearest, deceleration)
            near += 1
    if known < MIN_SEEN:
        return 0.0, 0.0, UNSEEN
    why = FREE
    for _ in range(MAX_SLIDES):
        worst, excess = -1, 1e-9
        for k in range(near):
            over = away[k, 0] * vx + away[k, 1] * vy - limit[k]
            if over > excess:
                worst, excess = k, over
        if worst < 0:
            is_moving = vx != 0.0 or vy != 0.0
            return (0.0, 0.0, BLIND) if is_moving and _is_blind(vx, vy, t_ns, looked_ns) else (vx, vy, why)
        why = NEAR
        vx -= excess * away[worst, 0]
        vy -= excess * away[worst, 1]
    return 0.0, 0.0, NEAR


@kernel
def _is_blind(vx: float, vy: float, t_ns: int, looked_ns: NDArray[np.int64]) -> bool:
    """Whether in the way so many sectors in a row are unknown that something could hide there."""
    centre = round(math.degrees(math.atan2(vy, vx)))
    run = 0
    for n in range(centre - WAY_SECTORS, centre + WAY_SECTORS + 1):
        run = run + 1 if t_ns - looked_ns[n % SECTORS] > REMEMBERED_NS else 0
        if run > BLIND_SECTORS:
            return True
    return False
