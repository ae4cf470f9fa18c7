"""The last word on every setpoint: what passes here is sent, and nothing else. No flag disables it.

Each check looks only at what it is given and at its own memory: it does not trust the navigator, whose mistakes it is
there to catch. From mild to hard: the velocity is clamped; zero velocity (hold); silence, so that the flight
controller's own failsafe acts; a request to land. Bounds: docs/safety.md.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from companion.config import CompanionConfig
from companion.geometry import yaw_from_quat
from companion.messages import (
    Array,
    Event,
    FlightMode,
    OdometryEstimate,
    OperatorCommand,
    OperatorCommandKind,
    RequestKind,
    Setpoint,
    SetpointKind,
    Severity,
    VehicleRequest,
    VehicleState,
    WallRanges,
)
from companion.navigator.obstacles import Surroundings, allowed_speed

SETPOINT_HOLD_NS = 300_000_000  # an older wish is no wish any more
SETPOINT_SILENT_NS = 500_000_000
LINK_LOST_NS = 3_000_000_000
HEARTBEAT_NS = 1_000_000_000  # its period: age counts from when it was due
ABORT_LAND_NS = 800_000_000  # the navigator asks sooner; this is for when it does not
REQUEST_EVERY_NS = 1_000_000_000
BREACH_M = 0.5  # beyond a limit by this: not a matter of clamping any more
FLOOR_M = 0.3  # above the place of take-off: lower only in the flight controller's land mode
NEAR_GROUND_M = 1.0  # measured below: do not sink further
ROOM_BELOW_M = 1.0  # by which the rangefinder may read more than the height above the start, and
ROOM_BELOW_SLOPE = 0.03  # more for each metre from there: the floor may fall away
DEGENERATE_SPEED_RATIO = 0.5
LANDING_MODES = frozenset({FlightMode.LAND, FlightMode.DESCEND})
TELL_AGAIN_NS = 10_000_000_000
NEVER = -(10**18)


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardInput:
    """The newest of everything. `commands`: those that arrived since the last check. below_m: rangefinder, if any."""

    estimate: OdometryEstimate | None
    walls: WallRanges | None
    vehicle: VehicleState | None
    commands: tuple[OperatorCommand, ...] = ()
    below_m: float | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardVerdict:
    """setpoint: what may be sent; kind SILENT: nothing, although the navigator wants to; None: it wants nothing."""

    setpoint: Setpoint | None
    requests: tuple[VehicleRequest, ...] = ()
    events: tuple[Event, ...] = ()


class Guard:
    """One for each flight: it remembers the abort, the place of take-off, and what was seen."""

    def __init__(self, config: CompanionConfig) -> None:
        self._cfg = config.guard
        self._surroundings = Surroundings(config.guard.stop_distance_m, config.guard.deceleration_mps2)
        self._poses: deque[tuple[int, Array, float]] = deque(maxlen=40)
        self._start: Array = np.zeros(3)
        self._was_armed = False
        self._abort_ns: int | None = None
        self._scan_ns = NEVER  # of the newest scan that differs from the one before
        self._walls: WallRanges | None = None
        self._estimate: OdometryEstimate | None = None  # the newest good one
        self._first_ns: int | None = None
        self._breach_ns: int | None = None
        self._asked_ns = NEVER
        self._told: dict[str, int] = {}
        self.is_silent = True  # estimates too: vision is too old to be sent

    @property
    def is_aborted(self) -> bool:
        return self._abort_ns is not None

    def check(self, setpoint: Setpoint | None, t_ns: int, inputs: GuardInput) -> GuardVerdict:
        """What of this setpoint may be sent now. Never raises; bad numbers end in zero velocity."""
        events: list[Event] = []
        self._first_ns = t_ns if self._first_ns is None else self._first_ns
        self._obey(inputs.commands, t_ns, events)
        self._note(inputs, t_ns)
        vision_s = self._vision_age_s(t_ns)
        self.is_silent = vision_s > self._cfg.silent_after_s
        breach = self._breach(t_ns, inputs.below_m)
        requests = self._requests(t_ns, inputs.vehicle, vision_s, events)
        if setpoint is None:
            return GuardVerdict(setpoint=None, requests=requests, events=tuple(events))
        silent = self._why_silent(setpoint, t_ns, inputs.vehicle, vision_s)
        if silent:
            self._tell(events, t_ns, Severity.CRITICAL, "guard_silent", silent)
            return GuardVerdict(
                setpoint=_still(t_ns, SetpointKind.SILENT, silent), requests=requests, events=tuple(events)
            )
        hold = self._why_hold(setpoint, t_ns, inputs, vision_s) or breach
        if hold:
            self._tell(events, t_ns, Severity.WARNING, "guard_hold", hold)
            return GuardVerdict(
                setpoint=_still(t_ns, SetpointKind.VELOCITY, hold), requests=requests, events=tuple(events)
            )
        limited, why = self._limit(setpoint, t_ns, inputs.below_m)
        self._tell(events, t_ns, Severity.NOTICE, "guard_limit", why)
        return GuardVerdict(setpoint=limited, requests=requests, events=tuple(events))

    # ---- what is known ----------------------------------------------------------------------------------------------

    def _obey(self, commands: tuple[OperatorCommand, ...], t_ns: int, events: list[Event]) -> None:
        for command in commands:
            if command.kind is OperatorCommandKind.ABORT and self._abort_ns is None:
                self._abort_ns = t_ns
                text = f"abort from {command.source} is latched"
                events.append(Event(t_ns=t_ns, severity=Severity.CRITICAL, name="guard_abort", text=text))

    def _note(self, inputs: GuardInput, t_ns: int) -> None:
        estimate = inputs.estimate
        if estimate is not None and _is_good(estimate, t_ns):
            self._estimate = estimate
            if not self._poses or estimate.t_ns > self._poses[-1][0]:
                yaw = yaw_from_quat(estimate.q_map_body_wxyz)
                self._poses.append((estimate.t_ns, estimate.position_map_m, yaw))
        armed = inputs.vehicle is not None and inputs.vehicle.is_armed
        if armed and not self._was_armed and self._estimate is not None:
            self._start = self._estimate.position_map_m
            self._surroundings.take_off(float(self._start[0]), float(self._start[1]))
        self._was_armed = armed
        walls = inputs.walls
        if walls is None or not self._poses or not _is_new(walls, self._walls, t_ns):
            return
        stuck = (
            self._walls is not None and self._height_m() > 0.5 and np.array_equal(walls.ranges_m, self._walls.ranges_m)
        )
        self._walls = walls
        if not stuck:  # range noise never repeats 360 values
            self._scan_ns = walls.t_ns
            _, position, yaw = _nearest_in_time(self._poses, walls.t_ns)
            self._surroundings.see(walls, float(position[0]), float(position[1]), yaw)

    def _height_m(self) -> float:
        return float(self._estimate.position_map_m[2] - self._start[2]) if self._estimate is not None else 0.0

    def _vision_age_s(self, t_ns: int) -> float:
        """Of the oldest of: the scan, the good estimate, the scan within it."""
        if self._estimate is None or self._scan_ns == NEVER:
            return math.inf
        return (t_ns - min(self._scan_ns, self._estimate.t_ns, self._estimate.t_scan_ns)) / 1e9

    # ---- silence and hold -------------------------------------------------------------------------------------------

    def _why_silent(self, setpoint: Setpoint, t_ns: int, vehicle: VehicleState | None, vision_s: float) -> str:
        if setpoint.kind is SetpointKind.SILENT:
            return setpoint.reason or "silence was asked for"
        if vision_s > self._cfg.silent_after_s:
            return "vision is lost"
        if t_ns - setpoint.t_ns > SETPOINT_SILENT_NS:
            return "the navigator stands still"
        if vehicle is None or not vehicle.is_connected or t_ns - vehicle.t_heartbeat_ns > LINK_LOST_NS:
            return "the flight controller is not heard"
        return ""

    def _why_hold(self, setpoint: Setpoint, t_ns: int, inputs: GuardInput, vision_s: float) -> str:
        cfg, estimate, vehicle = self._cfg, self._estimate, inputs.vehicle
        if self._abort_ns is not None:
            return "abort"
        if t_ns - setpoint.t_ns > SETPOINT_HOLD_NS:
            return "the setpoint is old"
        if estimate is None or vehicle is None or vision_s > cfg.max_scan_age_s:
            return "vision is old"
        if inputs.estimate is not None and inputs.estimate.quality < 0:
            return "registration failed"
        if t_ns - vehicle.t_heartbeat_ns > cfg.max_state_age_s * 1e9 + HEARTBEAT_NS:
            return "the vehicle's state is old"
        if not (_is_finite(setpoint.velocity_map_mps) and math.isfinite(setpoint.yaw_rate_radps)):
            return "the setpoint is not a number"
        if _sigma_m(estimate) > cfg.max_position_sigma_m:
            return "the position is uncertain"
        return ""

    def _breach(self, t_ns: int, below_m: float | None) -> str:
        """Outside the box although every setpoint was clamped, or higher than the estimate knows: something is wrong."""
        if self._estimate is None or not self._was_armed:
            self._breach_ns = None
            return ""
        off = self._estimate.position_map_m - self._start
        high = off[2] > self._cfg.max_height_m + BREACH_M
        from_start_m = math.hypot(off[0], off[1])
        far = from_start_m > self._cfg.max_distance_m + BREACH_M
        room_m = ROOM_BELOW_M + ROOM_BELOW_SLOPE * from_start_m
        deep = below_m is not None and math.isfinite(below_m) and below_m - max(float(off[2]), 0.0) > room_m
        if not (high or far or deep):
            self._breach_ns = None
            return ""
        self._breach_ns = t_ns if self._breach_ns is None else self._breach_ns
        if deep and not (high or far):
            return "the rangefinder reads more height than the estimate has"
        return "above the height limit" if high else "beyond the fence"

    def _requests(
        self, t_ns: int, vehicle: VehicleState | None, vision_s: float, events: list[Event]
    ) -> tuple[VehicleRequest, ...]:
        """To land, when holding has lasted long enough; only of a vehicle that is ours to command."""
        if vehicle is None or not vehicle.is_armed or vehicle.mode in LANDING_MODES:
            return ()
        after_ns = self._cfg.land_after_s * 1e9
        unseen_ns = min(vision_s * 1e9, float(t_ns - (self._first_ns or t_ns)))
        why = ""
        if self._abort_ns is not None and t_ns - self._abort_ns >= ABORT_LAND_NS:
            why = "" if vehicle.mode is FlightMode.MANUAL else "abort"
        elif vehicle.mode is FlightMode.OFFBOARD:
            if unseen_ns > after_ns:
                why = "vision is lost"
            elif self._breach_ns is not None and t_ns - self._breach_ns > after_ns:
                why = "outside the box, or its height is wrong"
        if not why or t_ns - self._asked_ns < REQUEST_EVERY_NS:
            return ()
        self._asked_ns = t_ns
        text = f"land: {why}"
        events.append(Event(t_ns=t_ns, severity=Severity.CRITICAL, name="guard_land", text=text))
        return (VehicleRequest(t_ns=t_ns, kind=RequestKind.LAND),)

    # ---- limits -----------------------------------------------------------------------------------------------------

    def _limit(self, setpoint: Setpoint, t_ns: int, below_m: float | None) -> tuple[Setpoint, str]:
        assert self._estimate is not None
        cfg, here = self._cfg, self._estimate.position_map_m
        whys = []
        vx, vy, z = (float(v) for v in setpoint.velocity_map_mps)
        xy = np.array([vx, vy])
        top = cfg.max_speed_mps * (DEGENERATE_SPEED_RATIO if self._estimate.is_degenerate else 1.0)
        speed = math.hypot(vx, vy)
        if speed > top:
            xy = xy * (top / speed)
            whys.append("too fast")
        z = max(-cfg.max_climb_speed_mps, min(cfg.max_climb_speed_mps, z))
        fenced, why = self._fence(xy)
        whys.append(why)
        safe, why = self._surroundings.limit(fenced, float(here[0]), float(here[1]), t_ns)
        whys.append(why)
        height = self._height_m()
        high = min(z, float(allowed_speed(cfg.max_height_m - height, cfg.deceleration_mps2)))
        low = max(high, -float(allowed_speed(height - FLOOR_M, cfg.deceleration_mps2)))
        if below_m is not None and math.isfinite(below_m) and below_m < NEAR_GROUND_M and height > NEAR_GROUND_M:
            low = max(low, 0.0)
        whys.append("at the height limit" if low != z else "")
        rate = math.radians(cfg.max_yaw_rate_dps)
        limited = Setpoint(
            t_ns=t_ns, kind=SetpointKind.VELOCITY, velocity_map_mps=np.array([safe[0], safe[1], low]),
            yaw_rate_radps=max(-rate, min(rate, setpoint.yaw_rate_radps)), reason=setpoint.reason,
        )  # fmt: skip
        return limited, next((why for why in whys if why), "")

    def _fence(self, xy: Array) -> tuple[Array, str]:
        """Without what leads out of the circle about the start faster than it could stop inside."""
        assert self._estimate is not None
        off = self._estimate.position_map_m[:2] - self._start[:2]
        distance = math.hypot(off[0], off[1])
        if distance < 1e-6:
            return xy, ""
        outward = off / distance
        limit = float(allowed_speed(self._cfg.max_distance_m - distance, self._cfg.deceleration_mps2))
        excess = float(outward @ xy) - limit
        return (xy - excess * outward, "at the fence") if excess > 0 else (xy, "")

    def _tell(self, events: list[Event], t_ns: int, severity: Severity, name: str, why: str) -> None:
        """When something begins to be wrong; what comes and goes is told once in TELL_AGAIN_NS."""
        if why and t_ns - self._told.get(why, NEVER) > TELL_AGAIN_NS:
            events.append(Event(t_ns=t_ns, severity=severity, name=name, text=why))
        if why:
            self._told[why] = t_ns


def _nearest_in_time(poses: deque[tuple[int, Array, float]], t_ns: int) -> tuple[int, Array, float]:
    """The pose nearest in time, looked for from the newest back."""
    best = poses[-1]
    for pose in reversed(poses):
        if abs(pose[0] - t_ns) > abs(best[0] - t_ns):
            break
        best = pose
    return best


def _still(t_ns: int, kind: SetpointKind, reason: str) -> Setpoint:
    return Setpoint(t_ns=t_ns, kind=kind, velocity_map_mps=np.zeros(3), yaw_rate_radps=0.0, reason=reason)


def _sigma_m(estimate: OdometryEstimate) -> float:
    x, y = float(estimate.pose_covariance[0, 0]), float(estimate.pose_covariance[1, 1])
    return math.sqrt(max(x, y)) if x >= 0 and y >= 0 and math.isfinite(x + y) else math.inf  # NaN is not >= 0


def _is_good(estimate: OdometryEstimate, t_ns: int) -> bool:
    """Finite, a unit quaternion, not called failed, not from the future."""
    if not (_is_finite(estimate.position_map_m) and _is_finite(estimate.q_map_body_wxyz)):
        return False
    norm = sum(v * v for v in estimate.q_map_body_wxyz.tolist())
    return abs(norm - 1.0) < 1e-2 and estimate.quality >= 0 and estimate.t_ns <= t_ns


def _is_finite(vector: Array) -> bool:
    return all(map(math.isfinite, vector.tolist()))


def _is_new(walls: WallRanges, before: WallRanges | None, t_ns: int) -> bool:
    return walls.t_ns <= t_ns and (before is None or walls.t_ns > before.t_ns)
