"""The mission's state machine: from waiting on the ground to landed at the start, and what to do when all is not well.

One handler for each state returns the motion wanted now, or None to stream nothing. What can happen in any state
(abort, takeover, lost vision, battery) is looked at first, in the order of who wins.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from companion.config import CompanionConfig
from companion.geometry import wrap_angle, yaw_from_quat
from companion.messages import (
    Array,
    Event,
    FlightMode,
    LandedState,
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
from companion.navigator.find_wall import Island, Phase, WallFinder
from companion.navigator.handshake import Handshake, Progress
from companion.navigator.interface import FINISHED, IN_FLIGHT, NavigatorInput, NavigatorOutput, NavigatorState
from companion.navigator.lap import Lap, LapTracker
from companion.navigator.route import Path, Route
from companion.navigator.scan_view import ScanView
from companion.navigator.wall_follower import Pose2, Steering, WallFollower
from companion.navigator.watch import Battery, BatteryWatch, Vision, VisionWatch

S = NavigatorState

READY_FOR_NS = 1_000_000_000  # ready and seeing for so long before arming
VISION_BACK_NS = 1_000_000_000  # good again for so long before going on
HOLD_AT_MOST_NS = 20_000_000_000  # on poor vision; then land here
DEGENERATE_TURN_BACK_S = 20.0
LAND_AGAIN_NS = 2_000_000_000
DISARM_AFTER_NS = 8_000_000_000  # on the ground in land mode and still armed
LINK_LOST_NS = 3_000_000_000
STUCK_NS = 45_000_000_000  # no place reached that is a metre away
HEIGHT_GAIN_PER_S = 0.8
PLACE_GAIN_PER_S = 0.5
SLOW_CLIMB_MPS = 0.4  # height keeping while following
AT_HEIGHT_M = 0.15
HANDOVER_M = 1.5  # above the start: from here down the flight controller's own land mode
AT_HOME_M = 0.2
LANDING_MODES = frozenset({FlightMode.LAND, FlightMode.DESCEND})


@dataclass(frozen=True, slots=True)
class Motion:
    """Wanted velocity in map (3,) and yaw rate."""

    velocity_mps: Array
    yaw_rate_radps: float = 0.0


STILL = Motion(np.zeros(3))


class Navigator:
    """Flies one mission. Call `step` at the setpoint rate; it decides, the guard then checks."""

    def __init__(self, config: CompanionConfig) -> None:
        self._cfg = config.navigator
        self._watch = VisionWatch(config.guard, config.lidar)
        self._battery = BatteryWatch()
        self._follower = WallFollower(config.navigator, config.guard)
        self._finder = WallFinder(config.navigator, self._follower.lane_m)
        self._lane_home = config.guard.stop_distance_m + 0.5
        self._lap = LapTracker()
        self._path = Path()
        self._route: Route | None = None
        self._islands: tuple[Island, ...] = ()
        self._laps_closed = 0
        self._handlers = {
            S.WAIT_READY: self._wait_ready,
            S.ARMING: self._arming,
            S.CLIMB: self._climb,
            S.FIND_WALL: self._find_wall,
            S.FOLLOW: self._follow,
            S.RETURN: self._return,
            S.LAND: self._land,
            S.HOLDING: self._holding,
            S.ABORTING: self._aborting,
        }
        self.state = S.WAIT_READY
        self._before = S.WAIT_READY  # what HOLDING and INTERRUPTED came from
        self._operator_holds = False
        self._outcome = "completed"
        self._reason = ""
        self._waits_for: tuple[str, ...] = ()
        self._handshake: Handshake | None = None
        self._start: tuple[float, float, float] | None = None  # where the mission was armed, map
        # Of this step.
        self._t = 0
        self._vehicle: VehicleState | None = None
        self._vision = Vision(False, "nothing came yet", 1.0, 0.0, False)
        self._pose = Pose2(0.0, 0.0, 0.0)
        self._z = 0.0
        self._poses: deque[tuple[int, Pose2]] = deque(maxlen=40)
        self._view: ScanView | None = None  # of a scan not seen before
        self._view_pose = self._pose
        self._walls_t = -1
        self._requests: list[VehicleRequest] = []
        self._events: list[Event] = []
        self._steering: Steering | None = None
        # Since when.
        self._state_since = 0
        self._took_off_ns: int | None = None
        self._ready_since: int | None = None
        self._good_since: int | None = None
        self._land_asked_ns: int | None = None
        self._on_ground_since: int | None = None
        self._disarmed_since: int | None = None
        self._anchor: tuple[float, float, int] | None = None
        self._home_best: tuple[float, int] = (math.inf, 0)
        self._home_s: tuple[float, int] = (0.0, -1)

    def step(self, t_ns: int, inputs: NavigatorInput) -> NavigatorOutput:
        """Take in the newest and decide. Never raises on bad measurements."""
        self._t, self._vehicle = t_ns, inputs.vehicle
        self._requests, self._events, self._steering = [], [], None
        self._vision = self._watch.step(t_ns, inputs.estimate, inputs.walls)
        self._see(inputs.estimate, inputs.walls)
        self._obey(inputs.commands)
        self._look_out(inputs)
        handler = self._handlers.get(self.state)
        motion = handler() if handler is not None else self._passive()
        return self._output(motion)

    # ---- what is known now ------------------------------------------------------------------------------------------

    def _see(self, estimate: OdometryEstimate | None, walls: WallRanges | None) -> None:
        self._view = None
        if estimate is None or not self._vision.is_good:
            return
        x, y, z = (float(v) for v in estimate.position_map_m)
        self._pose, self._z = Pose2(x, y, yaw_from_quat(estimate.q_map_body_wxyz)), z
        if not self._poses or estimate.t_ns > self._poses[-1][0]:
            self._poses.append((estimate.t_ns, self._pose))
        if walls is not None and walls.t_ns > self._walls_t:
            self._walls_t = walls.t_ns
            self._view = ScanView.of(walls)
            self._view_pose = _pose_at(self._poses, walls.t_ns)

    @property
    def _height_m(self) -> float:
        return self._z - (self._start[2] if self._start is not None else 0.0)

    def _since_s(self, since_ns: int | None) -> float:
        return (self._t - since_ns) / 1e9 if since_ns is not None else 0.0

    # ---- what wins over the plan ------------------------------------------------------------------------------------

    def _obey(self, commands: tuple[OperatorCommand, ...]) -> None:
        for command in commands:
            if self.state in FINISHED:
                continue
            if command.kind is OperatorCommandKind.ABORT:
                self._abort(command.source)
            elif self.state is S.ABORTING:
                self._tell(Severity.NOTICE, "command_refused", f"{command.kind.value} refused: the mission is aborting")
            elif command.kind is OperatorCommandKind.LAND and self.state in IN_FLIGHT:
                self._land_here("operator", f"{command.source} asked to land")
            elif command.kind is OperatorCommandKind.HOLD and self.state in IN_FLIGHT and self.state is not S.LAND:
                self._operator_holds = True
                self._hold(f"{command.source} asked to hold")
            elif command.kind is OperatorCommandKind.RESUME:
                self._resume(command.source)

    def _abort(self, source: str) -> None:
        if self.state is S.ABORTING:
            return
        vehicle = self._vehicle
        armed = vehicle is not None and vehicle.is_armed
        self._tell(Severity.CRITICAL, "abort", f"abort from {source}")
        if self.state is S.INTERRUPTED and vehicle is not None and armed and vehicle.mode is FlightMode.MANUAL:
            self._tell(
                Severity.NOTICE, "abort_noted", "the pilot flies: abort is noted, nothing is asked of the vehicle"
            )
        elif not armed:
            self._finish(S.ABORTED, "aborted", f"abort from {source} on the ground")
        else:
            self._outcome, self._reason = "aborted", f"abort from {source}"
            self._land_asked_ns = None
            self._go(S.ABORTING, self._reason)

    def _resume(self, source: str) -> None:
        if self.state is S.HOLDING:
            self._operator_holds = False
        elif self.state is S.INTERRUPTED:
            vehicle = self._vehicle
            if vehicle is None or not vehicle.is_connected or not vehicle.is_armed or not self._vision.is_good:
                why = "the vehicle is not armed, not heard, or does not see"
                self._tell(Severity.WARNING, "command_refused", f"resume refused: {why}")
                return
            self._handshake = Handshake(self._t, may_arm=False)
            self._outcome, self._reason, self._land_asked_ns = "completed", "", None
            self._go(S.ARMING, f"{source} asked to go on")

    def _look_out(self, inputs: NavigatorInput) -> None:
        if self.state is S.WAIT_READY:
            self._note_readiness(inputs)
        if self.state not in IN_FLIGHT:
            return
        self._check_takeover()
        if self.state not in IN_FLIGHT or self.state is S.ABORTING:
            return
        if self._vision.has_jumped:
            self._land_here("odometry_reset", "odometry began anew far from where it was: the way home is not known")
        self._check_battery()
        limit = self._cfg.max_flight_time_s
        if self.state in (S.CLIMB, S.FIND_WALL, S.FOLLOW) and self._since_s(self._took_off_ns) > limit:
            self._go_home("time_limit", f"flown for {limit:g} s", only_flown=False)
        if self.state in (S.FIND_WALL, S.FOLLOW) and self._vision.lasting_degenerate_s > DEGENERATE_TURN_BACK_S:
            self._go_home("degenerate", "the geometry has not held the position for 20 s", only_flown=True)
        if not self._vision.is_good and self.state not in (S.HOLDING, S.LAND):
            self._hold(self._vision.why)

    def _check_takeover(self) -> None:
        vehicle = self._vehicle
        if vehicle is None or not vehicle.is_connected or self._t - vehicle.t_heartbeat_ns > LINK_LOST_NS:
            self._interrupt("link_lost", "the flight controller is not heard")
        elif not vehicle.is_armed:
            if self._land_asked_ns is not None:
                self._finish(S.ABORTED if self.state is S.ABORTING else S.DONE, self._outcome, self._reason)
            elif self.state is S.CLIMB and vehicle.landed_state is LandedState.ON_GROUND:
                self._finish(S.FAILED, "disarmed", "the flight controller disarmed before take-off")
            else:
                self._interrupt("disarmed", "the flight controller disarmed or rebooted in flight")
        elif vehicle.mode is not FlightMode.OFFBOARD:
            landing = self._land_asked_ns is not None and vehicle.mode in LANDING_MODES
            aborting = self.state is S.ABORTING and vehicle.mode is not FlightMode.MANUAL
            if not landing and not aborting:
                who = "the flight controller's failsafe" if vehicle.is_failsafe else "the pilot or the ground station"
                self._interrupt("taken_over", f"{who} chose {vehicle.mode.value}")

    def _check_battery(self) -> None:
        if self._t - self._home_s[1] > 1_000_000_000:
            way = self._path.home_m() / self._cfg.forward_speed_mps + self._height_m / self._cfg.climb_speed_mps + 20.0
            self._home_s = (way, self._t)
        ratio = self._vehicle.battery_ratio if self._vehicle is not None else None
        battery = self._battery.step(self._t, ratio, self._home_s[0])
        if battery is Battery.CRITICAL and self.state is not S.LAND:
            self._land_here("battery_critical", "the battery is nearly empty")
        elif battery is Battery.LOW and self.state in (S.CLIMB, S.FIND_WALL, S.FOLLOW):
            self._go_home("battery_low", "the battery is needed for the way home", only_flown=True)

    # ---- states ------------------------------------------------------------------------------------------------------

    def _note_readiness(self, inputs: NavigatorInput) -> None:
        vehicle, why = self._vehicle, list(inputs.not_ready_because)
        if vehicle is None or not vehicle.is_connected:
            why.append("the flight controller is not heard")
        elif not vehicle.is_ready_to_arm:
            why += vehicle.not_ready_because or ("the flight controller is not ready",)
        if not inputs.time_synced:
            why.append("the clocks are not synchronised")
        if not self._vision.is_good:
            why.append(self._vision.why)
        if tuple(why) != self._waits_for:
            self._waits_for = tuple(why)
            if why:
                self._tell(Severity.NOTICE, "not_ready", "not ready: " + "; ".join(why))
        if why:
            self._ready_since = None
        elif self._ready_since is None:
            self._ready_since = self._t

    def _wait_ready(self) -> Motion | None:
        vehicle = self._vehicle
        if vehicle is not None and vehicle.is_connected and vehicle.is_armed:
            self._before = S.CLIMB
            self._interrupt("found_armed", "the vehicle was armed already: the companion stays passive")
        elif self._ready_since is not None and self._t - self._ready_since >= READY_FOR_NS:
            self._handshake = Handshake(self._t, may_arm=True)
            self._go(S.ARMING, "all is ready")
            return STILL
        return None

    def _arming(self) -> Motion | None:
        vehicle = self._vehicle
        if vehicle is None or not vehicle.is_connected or not self._vision.is_good or self._handshake is None:
            if vehicle is None or not vehicle.is_armed:
                self._ready_since = None
                self._go(S.WAIT_READY, "no longer ready")
                return None
            self._interrupt("not_ready", "lost sight while taking control")
            return None
        request, progress = self._handshake.step(self._t, vehicle)
        if request is not None:
            self._ask(request)
        if progress is Progress.GIVEN_UP:
            self._finish(S.FAILED, "not_armed", "the flight controller did not take OFFBOARD or did not arm")
        elif progress is Progress.READY:
            self._took_off()
        return STILL

    def _took_off(self) -> None:
        if self._start is None:
            self._start = (self._pose.x, self._pose.y, self._z)
            self._took_off_ns = self._t
            self._go(S.CLIMB, f"climbing to {self._cfg.height_m:g} m")
        else:
            self._go(self._before, "going on")

    def _climb(self) -> Motion | None:
        assert self._start is not None
        off = self._cfg.height_m - self._height_m
        if abs(off) < AT_HEIGHT_M:
            self._path.add(self._pose)
            self._finder = WallFinder(self._cfg, self._follower.lane_m)
            self._go(S.FIND_WALL, "at height")
            return STILL
        expected_s = 30.0 + 3.0 * self._cfg.height_m / self._cfg.climb_speed_mps
        if self._since_s(self._state_since) > expected_s:
            self._land_here("no_climb", "the height was not reached")
        climb = self._cfg.climb_speed_mps
        return self._to(self._start[0], self._start[1], 0.3, max(-climb, min(climb, HEIGHT_GAIN_PER_S * off)))

    def _find_wall(self) -> Motion | None:
        if self._view is not None:
            self._finder.see(self._view, self._view_pose, self._islands)
        self._path.add(self._pose)
        if self._finder.phase is Phase.FOUND:
            self._follower.start(turning_to=self._finder.wall, pose=self._view_pose)
            self._lap = LapTracker()
            self._go(S.FOLLOW, "at the wall")
        elif self._is_stuck():
            self._go_home("no_wall", "no way to a wall was found", only_flown=False)
        return self._steered(self._finder.step(self._pose, self._speed()))

    def _follow(self) -> Motion | None:
        self._path.add(self._pose)
        if self._view is not None:
            self._follower.see(self._view, self._view_pose)
        self._count_lap()
        if self.state is S.FOLLOW and self._is_stuck():
            self._go_home("stuck", "the wall follower did not get on", only_flown=False)
        return self._steered(self._follower.step(self._pose, self._speed()))

    def _count_lap(self) -> None:
        lap = self._lap.add(self._pose)
        if lap is Lap.CLOSED:
            self._laps_closed += 1
            self._tell(Severity.INFO, "lap_closed", f"lap {self._laps_closed} closed")
            self._lap = LapTracker()
            if self._laps_closed >= self._cfg.laps:
                self._go_home("completed", "all laps flown", only_flown=False)
        elif lap is Lap.ISLAND:
            places = self._lap.loop_places()
            centre = places.mean(axis=0)
            radius = float(np.hypot(*(places - centre).T).max())
            self._islands = (*self._islands, Island(float(centre[0]), float(centre[1]), radius))
            self._tell(Severity.INFO, "island", "went round something that stands free: looking for the hall's wall")
            self._finder = WallFinder(self._cfg, self._follower.lane_m)
            if len(self._islands) > 3:
                self._go_home("no_wall", "only free-standing things were found", only_flown=False)
            else:
                self._go(S.FIND_WALL, "round an island")

    def _return(self) -> Motion | None:
        assert self._route is not None
        self._path.add(self._pose)
        if self._view is not None:
            self._route.see(self._view, self._view_pose)
        self._route.step(self._pose)
        x, y = self._route.target
        distance = math.hypot(x - self._pose.x, y - self._pose.y)
        if self._route.is_last and self._is_home(distance):
            self._go(S.LAND, "above the start")
        elif self._is_stuck():
            self._land_here("no_way_home", "no way home was found")
        motion = self._to(x, y, self._speed() if distance > 0.5 or self._route.is_last else 0.7 * self._speed())
        if distance > 1.5:
            off = wrap_angle(math.atan2(y - self._pose.y, x - self._pose.x) - self._pose.yaw)
            rate = math.radians(self._cfg.turn_rate_dps)
            return Motion(motion.velocity_mps, max(-rate, min(rate, off)))
        return motion

    def _is_home(self, distance_m: float) -> bool:
        """There, or as near as the guard lets us come."""
        if distance_m < self._home_best[0] - 0.05:
            self._home_best = (distance_m, self._t)
        return distance_m < AT_HOME_M or (distance_m < 0.9 and self._since_s(self._home_best[1]) > 6.0)

    def _land(self) -> Motion | None:
        vehicle = self._vehicle
        at_home = self._land_asked_ns is None and self._start is not None
        if at_home and self._start is not None and self._vision.is_good and self._height_m > HANDOVER_M:
            x, y, _ = self._start
            off = math.hypot(x - self._pose.x, y - self._pose.y)
            down = min(self._cfg.climb_speed_mps, 0.2 + 0.5 * (self._height_m - HANDOVER_M)) if off < 1.0 else 0.0
            return self._to(x, y, 0.3, -down)
        self._ask_to_land()
        if vehicle is not None and vehicle.landed_state is LandedState.ON_GROUND and vehicle.mode in LANDING_MODES:
            self._on_ground_since = self._t if self._on_ground_since is None else self._on_ground_since
            if self._t - self._on_ground_since > DISARM_AFTER_NS:
                self._ask(RequestKind.DISARM)
                self._on_ground_since = self._t
        return None if vehicle is not None and vehicle.mode in LANDING_MODES else STILL

    def _holding(self) -> Motion | None:
        if not self._vision.is_good:
            self._good_since = None
            if self._t - self._state_since > HOLD_AT_MOST_NS:
                self._land_here("vision_lost", f"held for 20 s: {self._vision.why}")
        elif self._good_since is None:
            self._good_since = self._t
        elif self._t - self._good_since >= VISION_BACK_NS and not self._operator_holds:
            self._go(self._before, "going on")
        return STILL

    def _aborting(self) -> Motion | None:
        if self._since_s(self._state_since) >= 0.5:
            self._ask_to_land()
        return STILL if self._vehicle is None or self._vehicle.mode not in LANDING_MODES else None

    def _passive(self) -> Motion | None:
        """Over, or taken over: nothing is streamed, nothing asked."""
        if self.state is S.INTERRUPTED:
            disarmed = self._vehicle is not None and self._vehicle.is_connected and not self._vehicle.is_armed
            if not disarmed:
                self._disarmed_since = None
            elif self._disarmed_since is None:
                self._disarmed_since = self._t
        return None

    # ---- motion ------------------------------------------------------------------------------------------------------

    def _speed(self) -> float:
        return self._cfg.forward_speed_mps * self._vision.speed_ratio

    def _steered(self, steering: Steering) -> Motion:
        self._steering = steering
        c, s = math.cos(self._pose.yaw), math.sin(self._pose.yaw)
        forward, left = steering.forward_mps, steering.left_mps
        velocity = np.array([c * forward - s * left, s * forward + c * left, self._keep_height()])
        return Motion(velocity, steering.yaw_rate_radps)

    def _to(self, x: float, y: float, speed_mps: float, up_mps: float | None = None) -> Motion:
        """Towards a place, slower as it comes near."""
        dx, dy = x - self._pose.x, y - self._pose.y
        distance = math.hypot(dx, dy)
        ratio = min(speed_mps, PLACE_GAIN_PER_S * distance) / max(distance, 1e-6)
        return Motion(np.array([ratio * dx, ratio * dy, self._keep_height() if up_mps is None else up_mps]))

    def _keep_height(self) -> float:
        off = self._cfg.height_m - self._height_m
        return max(-SLOW_CLIMB_MPS, min(SLOW_CLIMB_MPS, HEIGHT_GAIN_PER_S * off))

    def _is_stuck(self) -> bool:
        """No place reached that is a metre from where we were a while ago."""
        x, y = self._pose.x, self._pose.y
        if self._anchor is None or math.hypot(x - self._anchor[0], y - self._anchor[1]) > 1.0:
            self._anchor = (x, y, self._t)
        return self._t - self._anchor[2] > STUCK_NS + 3e9 / self._cfg.forward_speed_mps

    # ---- changes of state --------------------------------------------------------------------------------------------

    def _go(self, state: NavigatorState, why: str) -> None:
        self.state, self._state_since = state, self._t
        self._good_since, self._anchor = None, None
        self._tell(Severity.INFO, "navigator_state", f"{state.value}: {why}")

    def _hold(self, why: str) -> None:
        if self.state is S.HOLDING:
            return
        self._before = self.state
        self._go(S.HOLDING, why)

    def _interrupt(self, outcome: str, why: str) -> None:
        if self.state in IN_FLIGHT - {S.HOLDING, S.ABORTING}:
            self._before = self.state
        self._outcome, self._reason, self._operator_holds = outcome, why, False
        self._disarmed_since = None
        self._tell(Severity.CRITICAL, outcome, why)
        self._go(S.INTERRUPTED, why)

    def _finish(self, state: NavigatorState, outcome: str, why: str) -> None:
        self._outcome, self._reason = outcome, why
        self._go(state, why or outcome)

    def _land_here(self, outcome: str, why: str) -> None:
        if self.state is S.LAND and self._land_asked_ns is not None:
            return
        self._outcome, self._reason = outcome, why
        self._tell(Severity.CRITICAL, outcome, why)
        self._go(S.LAND, why)
        self._land_asked_ns = self._t - LAND_AGAIN_NS
        self._ask_to_land()

    def _go_home(self, outcome: str, why: str, *, only_flown: bool) -> None:
        assert self._start is not None
        self._outcome, self._reason = outcome, "" if outcome == "completed" else why
        self._tell(Severity.INFO if outcome == "completed" else Severity.WARNING, outcome, why)
        home = (self._start[0], self._start[1])
        self._route = Route(self._path, home, self._lane_home, only_flown=only_flown)
        self._home_best = (math.inf, self._t)
        self._go(S.RETURN, why)

    def _ask_to_land(self) -> None:
        landing = self._vehicle is not None and self._vehicle.mode in LANDING_MODES
        due = self._land_asked_ns is None or self._t - self._land_asked_ns >= LAND_AGAIN_NS
        if due and not (landing and self._land_asked_ns is not None):
            self._land_asked_ns = self._t
            self._ask(RequestKind.LAND)

    def _ask(self, kind: RequestKind) -> None:
        self._requests.append(VehicleRequest(t_ns=self._t, kind=kind))

    def _tell(self, severity: Severity, name: str, text: str) -> None:
        self._events.append(Event(t_ns=self._t, severity=severity, name=name, text=text))

    def _output(self, motion: Motion | None) -> NavigatorOutput:
        setpoint = None
        if motion is not None:
            setpoint = Setpoint(
                t_ns=self._t, kind=SetpointKind.VELOCITY, velocity_map_mps=motion.velocity_mps,
                yaw_rate_radps=motion.yaw_rate_radps, reason=self.state.value,
            )  # fmt: skip
        over = self.state in FINISHED or (self.state is S.INTERRUPTED and self._since_s(self._disarmed_since) > 5.0)
        turned = self._lap.turned_rad if self.state is S.FOLLOW else 0.0
        progress = (self._laps_closed + max(0.0, min(0.99, turned / (2 * math.pi)))) / self._cfg.laps
        return NavigatorOutput(
            setpoint=setpoint, requests=tuple(self._requests), events=tuple(self._events), state=self.state,
            lap_closed=self._laps_closed >= self._cfg.laps, finished=over,
            is_straight=self.state is S.FOLLOW and self._steering is not None and self._steering.is_straight,
            progress_ratio=min(1.0, progress), path_length_m=self._path.length_m,
            outcome=self._outcome if over else "", reason=self._reason,
        )  # fmt: skip


def _pose_at(poses: deque[tuple[int, Pose2]], t_ns: int) -> Pose2:
    """The pose nearest in time, looked for from the newest back."""
    best = poses[-1]
    for known in reversed(poses):
        if abs(known[0] - t_ns) > abs(best[0] - t_ns):
            break
        best = known
    return best[1]
