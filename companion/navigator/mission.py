"""The mission's state machine: from waiting on the ground to landed at the start, and what to do when all is not well.

One handler for each state returns the motion wanted now, or None to stream nothing. What can happen in any state
(abort, takeover, lost vision, battery) is looked at first, in the order of who wins.
"""

from __future__ import annotations

import math

from companion.config import CompanionConfig
from companion.messages import (
    FlightMode,
    LandedState,
    OperatorCommand,
    OperatorCommandKind,
    RequestKind,
    Setpoint,
    SetpointKind,
    Severity,
)
from companion.navigator.find_wall import Island
from companion.navigator.handshake import Handshake, Progress
from companion.navigator.interface import FINISHED, IN_FLIGHT, NavigatorInput, NavigatorOutput, NavigatorState
from companion.navigator.legs import Climb, Descent, Ending, Homeward, Round, Search, Start
from companion.navigator.motion import STILL, Motion
from companion.navigator.notes import Notes
from companion.navigator.route import Path
from companion.navigator.situation import NOTHING_YET, Lookout
from companion.navigator.takeover import LANDING_MODES, Loss, Readiness, control_lost
from companion.navigator.wall_follower import lane_m
from companion.navigator.watch import Battery, BatteryWatch

S = NavigatorState

VISION_BACK_NS = 1_000_000_000  # good again for so long before going on
HOLD_AT_MOST_S = 20.0  # on an uncertain position; then land here
DEGENERATE_TURN_BACK_S = 20.0
ABORT_STILL_S = 0.5  # zero velocity before land mode is asked for
LAND_AGAIN_NS = 2_000_000_000  # the mode shows in the heartbeat, once a second
DISARM_AFTER_NS = 8_000_000_000  # on the ground in land mode and still armed
OVER_AFTER_S = 5.0  # disarmed for so long after an interruption
MAX_ISLANDS = 3
OUTWARD = frozenset({S.CLIMB, S.FIND_WALL, S.FOLLOW})


class Navigator:
    """Flies one mission. Call `step` at the setpoint rate; it decides, the guard then checks."""

    def __init__(self, config: CompanionConfig) -> None:
        self._config, self._cfg = config, config.navigator
        self._lookout = Lookout(config)
        self._battery = BatteryWatch()
        self._path = Path()
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
        self._before = S.CLIMB  # what HOLDING and INTERRUPTED came from
        self._now = NOTHING_YET
        self._notes = Notes(0)
        self._outcome, self._reason = "completed", ""
        self._operator_holds = False
        self._was_found_armed = False
        self._readiness = Readiness()
        self._islands: tuple[Island, ...] = ()
        self._laps_closed = 0
        # Built when they begin.
        self._handshake: Handshake | None = None
        self._start: Start | None = None
        self._leg: Climb | Search | Round | Homeward | Descent | None = None
        self._round: Round | None = None
        # Since when.
        self._state_ns = 0
        self._armed_ns: int | None = None
        self._good_ns: int | None = None
        self._land_asked_ns: int | None = None
        self._ground_ns: int | None = None
        self._disarmed_ns: int | None = None

    def step(self, t_ns: int, inputs: NavigatorInput) -> NavigatorOutput:
        """Take in the newest and decide. Never raises on bad measurements."""
        self._notes = Notes(t_ns)
        self._now = self._lookout.look(t_ns, inputs)
        self._obey(inputs.commands)
        if self.state is S.WAIT_READY:
            news = self._readiness.note(self._now, inputs)
            if news:
                self._notes.tell(Severity.NOTICE, "not_ready", news)
        elif self.state in IN_FLIGHT:
            self._look_out()
        handler = self._handlers.get(self.state)
        return self._output(handler() if handler is not None else self._passive())

    # ---- what wins over the plan ------------------------------------------------------------------------------------

    def _obey(self, commands: tuple[OperatorCommand, ...]) -> None:
        for command in commands:
            kind, source = command.kind, command.source
            if self.state in FINISHED:
                continue
            if kind is OperatorCommandKind.ABORT:
                self._abort(source)
            elif self.state is S.ABORTING:
                self._notes.refuse(kind, "the mission is aborting")
            elif kind is OperatorCommandKind.RESUME:
                self._resume(source)
            elif self.state not in IN_FLIGHT:
                self._notes.refuse(kind, "it is not flying this mission")
            elif kind is OperatorCommandKind.LAND:
                self._land_here("operator", f"{source} asked to land")
            elif self.state is not S.LAND:
                self._operator_holds = True
                self._hold(f"{source} asked to hold")

    def _abort(self, source: str) -> None:
        if self.state is S.ABORTING:
            return
        vehicle = self._now.vehicle
        self._notes.tell(Severity.CRITICAL, "abort", f"abort from {source}")
        if vehicle is None or not vehicle.is_armed:
            self._finish(S.ABORTED, "aborted", f"abort from {source} on the ground")
        elif self.state is S.INTERRUPTED and vehicle.mode is FlightMode.MANUAL:
            self._notes.tell(Severity.NOTICE, "abort_noted", "the pilot flies: noted, nothing is asked of the vehicle")
        else:
            self._outcome, self._reason, self._land_asked_ns = "aborted", f"abort from {source}", None
            self._go(S.ABORTING, self._reason)

    def _resume(self, source: str) -> None:
        vehicle = self._now.vehicle
        if self.state is S.HOLDING:
            self._operator_holds = False
        elif self.state is not S.INTERRUPTED:
            self._notes.refuse(OperatorCommandKind.RESUME, "nothing is held")
        elif vehicle is None or not (vehicle.is_connected and vehicle.is_armed and self._now.vision.is_good):
            self._notes.refuse(OperatorCommandKind.RESUME, "the vehicle is not armed, not heard, or does not see")
        else:
            self._handshake = Handshake(self._now.t_ns, may_arm=False)
            self._outcome, self._reason, self._land_asked_ns = "completed", "", None
            self._go(S.ARMING, f"{source} asked to go on")

    def _look_out(self) -> None:
        """In flight: who else commands the vehicle, then where we are, energy, time, what we see."""
        now = self._now
        loss = control_lost(now, self.state, land_asked=self._land_asked_ns is not None)
        if loss is not None:
            self._lose(loss)
        if self.state not in IN_FLIGHT or self.state is S.ABORTING:
            return
        if now.vision.has_jumped:
            self._land_here("odometry_reset", "odometry began anew far from where it was: the way home is not known")
        if now.unfollowed:
            self._land_here("not_followed", f"the vehicle does not follow its setpoints: {now.unfollowed}")
        self._check_battery()
        if self.state in OUTWARD and now.since_s(self._armed_ns) > self._cfg.max_flight_time_s:
            self._go_home("time_limit", f"flown for {self._cfg.max_flight_time_s:g} s", only_flown=False)
        if self.state in OUTWARD and self._start is not None and self._start.is_far(now.pose, self._cfg):
            self._go_home("too_far", "the way leads farther from the start than the mission allows", only_flown=True)
        if self.state in OUTWARD and now.vision.lasting_degenerate_s > DEGENERATE_TURN_BACK_S:
            self._go_home("degenerate", "the geometry has not held the position for 20 s", only_flown=True)
        if not now.vision.is_good and self.state not in (S.HOLDING, S.LAND):
            self._hold(now.vision.why)

    def _lose(self, loss: Loss) -> None:
        if loss.is_landed:
            self._finish(S.ABORTED if self.state is S.ABORTING else S.DONE, self._outcome, self._reason)
        elif loss.is_failure:
            self._finish(S.FAILED, loss.outcome, loss.why)
        else:
            self._interrupt(loss.outcome, loss.why)

    def _check_battery(self) -> None:
        now = self._now
        if self._start is None or now.vehicle is None:
            return
        down_s = max(0.0, now.z_m - self._start.z) / self._cfg.climb_speed_mps + 20.0
        home_s = self._path.home_m() / self._cfg.forward_speed_mps + down_s
        battery = self._battery.step(now.t_ns, now.vehicle.battery_ratio, home_s)
        if battery is Battery.CRITICAL and self.state is not S.LAND:
            self._land_here("battery_critical", "the battery is nearly empty")
        elif battery is Battery.LOW and (self.state in OUTWARD or (self.state is S.HOLDING and now.vision.is_good)):
            self._go_home("battery_low", "the battery is needed for the way home", only_flown=True)

    # ---- on the ground ----------------------------------------------------------------------------------------------

    def _wait_ready(self) -> Motion | None:
        vehicle = self._now.vehicle
        if vehicle is not None and vehicle.is_connected and vehicle.is_armed:
            self._was_found_armed = True
            self._interrupt("found_armed", "the vehicle was armed already: the companion stays passive")
        elif self._readiness.is_ready(self._now):
            self._handshake = Handshake(self._now.t_ns, may_arm=True)
            self._go(S.ARMING, "all is ready")
            return STILL
        return None

    def _arming(self) -> Motion | None:
        now = self._now
        assert self._handshake is not None
        if now.vehicle is None or not now.vehicle.is_connected or not now.vision.is_good:
            if now.vehicle is not None and now.vehicle.is_armed:
                self._interrupt("not_ready", "lost sight or the link while taking control")
            else:
                self._readiness = Readiness()
                self._go(S.WAIT_READY, "no longer ready")
            return None
        request, progress = self._handshake.step(now.t_ns, now.vehicle)
        if request is not None:
            self._notes.ask(request)
        if progress is Progress.GIVEN_UP:
            self._finish(S.FAILED, "not_armed", "the flight controller did not take OFFBOARD or did not arm")
        elif progress is Progress.READY:
            self._in_control()
        return STILL

    def _in_control(self) -> None:
        now = self._now
        if self._was_found_armed:
            self._land_here("found_armed", "taken over in the air: where it started is not known")
            return
        if self._start is None:
            self._start, self._armed_ns = Start(now.pose.x, now.pose.y, now.z_m), now.t_ns
            self._leg = Climb(self._cfg, self._start, now.t_ns)
        self._go(self._before, "in control")

    # ---- in the air -------------------------------------------------------------------------------------------------

    def _climb(self) -> Motion | None:
        assert isinstance(self._leg, Climb)
        motion, ending = self._leg.step(self._now)
        if ending is Ending.ARRIVED:
            self._search("at height")
        elif ending is Ending.FAILED:
            self._land_here("no_climb", "the height was not reached")
        return motion

    def _search(self, why: str) -> None:
        assert self._start is not None
        self._leg = Search(self._cfg, self._start, lane_m(self._config), self._islands)
        self._go(S.FIND_WALL, why)

    def _find_wall(self) -> Motion | None:
        assert isinstance(self._leg, Search)
        assert self._start is not None
        self._path.add(self._now.pose)
        motion, ending = self._leg.step(self._now)
        if ending is Ending.ARRIVED:
            wall = self._leg.wall
            self._leg = self._round = Round(self._config, self._start)
            self._leg.begin(wall, self._now)
            self._go(S.FOLLOW, "at the wall")
        elif ending is Ending.FAILED:
            self._go_home("no_wall", "no way to a wall was found", only_flown=False)
        return motion

    def _follow(self) -> Motion | None:
        assert isinstance(self._leg, Round)
        self._path.add(self._now.pose)
        motion, ending = self._leg.step(self._now)
        if ending is Ending.ARRIVED:
            self._laps_closed += 1
            self._notes.tell(Severity.INFO, "lap_closed", f"lap {self._laps_closed} closed")
            self._leg.again()
            if self._laps_closed >= self._cfg.laps:
                self._go_home("completed", "all laps flown", only_flown=False)
        elif ending is Ending.ISLAND:
            self._islands = (*self._islands, self._leg.island())
            self._notes.tell(Severity.INFO, "island", "went round a thing that stands free: looking for the wall")
            if len(self._islands) > MAX_ISLANDS:
                self._go_home("no_wall", "only free-standing things were found", only_flown=False)
            else:
                self._search("round an island")
        elif ending is Ending.FAILED:
            self._go_home("stuck", "the wall follower did not get on", only_flown=False)
        return motion

    def _return(self) -> Motion | None:
        assert isinstance(self._leg, Homeward)
        assert self._start is not None
        self._path.add(self._now.pose)
        motion, ending = self._leg.step(self._now)
        if ending is Ending.ARRIVED:
            self._leg = Descent(self._cfg, self._start)
            self._go(S.LAND, "above the start")
        elif ending is Ending.FAILED:
            self._land_here("no_way_home", "no way home was found")
        return motion

    def _land(self) -> Motion | None:
        if isinstance(self._leg, Descent) and self._land_asked_ns is None:
            motion, ending = self._leg.step(self._now)
            if ending is None:
                return motion
        self._ask_to_land()
        vehicle = self._now.vehicle
        if vehicle is None or vehicle.mode not in LANDING_MODES:
            return STILL
        if vehicle.landed_state is LandedState.ON_GROUND:
            self._ground_ns = self._now.t_ns if self._ground_ns is None else self._ground_ns
            if self._now.t_ns - self._ground_ns > DISARM_AFTER_NS:
                self._notes.ask(RequestKind.DISARM)
                self._ground_ns = self._now.t_ns
        return None

    def _holding(self) -> Motion | None:
        now = self._now
        if not now.vision.is_good:
            self._good_ns = None
            long_lost = now.vision.lost_s + self._config.guard.max_scan_age_s >= self._config.guard.land_after_s
            if long_lost or now.since_s(self._state_ns) > HOLD_AT_MOST_S:
                self._land_here("vision_lost", now.vision.why)
        elif self._good_ns is None:
            self._good_ns = now.t_ns
        elif now.t_ns - self._good_ns >= VISION_BACK_NS and not self._operator_holds:
            self._go(self._before, "going on")
        return STILL

    def _aborting(self) -> Motion | None:
        if self._now.since_s(self._state_ns) >= ABORT_STILL_S:
            self._ask_to_land()
        vehicle = self._now.vehicle
        return None if vehicle is not None and vehicle.mode in LANDING_MODES else STILL

    def _passive(self) -> Motion | None:
        """Over, or taken over: nothing is streamed, nothing asked."""
        vehicle = self._now.vehicle
        if vehicle is None or not vehicle.is_connected or vehicle.is_armed:
            self._disarmed_ns = None
        elif self._disarmed_ns is None:
            self._disarmed_ns = self._now.t_ns
        return None

    # ---- changes of state -------------------------------------------------------------------------------------------

    def _go(self, state: NavigatorState, why: str) -> None:
        self.state, self._state_ns, self._good_ns = state, self._now.t_ns, None
        self._notes.tell(Severity.INFO, "navigator_state", f"{state.value}: {why}")

    def _hold(self, why: str) -> None:
        if self.state is not S.HOLDING:
            self._before = self.state
            self._go(S.HOLDING, why)

    def _interrupt(self, outcome: str, why: str) -> None:
        if self.state in OUTWARD | {S.RETURN, S.LAND}:
            self._before = self.state
        self._outcome, self._reason, self._operator_holds, self._disarmed_ns = outcome, why, False, None
        self._notes.tell(Severity.CRITICAL, outcome, why)
        self._go(S.INTERRUPTED, why)

    def _finish(self, state: NavigatorState, outcome: str, why: str) -> None:
        self._outcome, self._reason = outcome, why
        self._go(state, why or outcome)

    def _land_here(self, outcome: str, why: str) -> None:
        if self.state is S.LAND and self._land_asked_ns is not None:
            return
        self._outcome, self._reason = outcome, why
        self._notes.tell(Severity.CRITICAL, outcome, why)
        self._go(S.LAND, why)
        self._ask_to_land()

    def _go_home(self, outcome: str, why: str, *, only_flown: bool) -> None:
        assert self._start is not None
        self._outcome, self._reason = outcome, "" if outcome == "completed" else why
        if outcome != "completed":
            self._notes.tell(Severity.WARNING, outcome, why)
        self._leg, self._operator_holds = Homeward(self._config, self._start, self._path, only_flown=only_flown), False
        self._go(S.RETURN, why)

    def _ask_to_land(self) -> None:
        vehicle, t_ns = self._now.vehicle, self._now.t_ns
        landing = vehicle is not None and vehicle.mode in LANDING_MODES
        if self._land_asked_ns is None or (not landing and t_ns - self._land_asked_ns >= LAND_AGAIN_NS):
            self._land_asked_ns = t_ns
            self._notes.ask(RequestKind.LAND)

    def _output(self, motion: Motion | None) -> NavigatorOutput:
        setpoint = None
        if motion is not None:
            setpoint = Setpoint(
                t_ns=self._now.t_ns, kind=SetpointKind.VELOCITY, velocity_map_mps=motion.velocity_mps,
                yaw_rate_radps=motion.yaw_rate_radps, reason=self.state.value,
            )  # fmt: skip
        over = self.state in FINISHED or self._now.since_s(self._disarmed_ns) > OVER_AFTER_S
        turning = self._round if self.state is S.FOLLOW else None
        share = max(0.0, min(0.99, turning.turned_rad / (2 * math.pi))) if turning is not None else 0.0
        return NavigatorOutput(
            setpoint=setpoint, requests=tuple(self._notes.requests), events=tuple(self._notes.events), state=self.state,
            lap_closed=self._laps_closed >= self._cfg.laps, finished=over,
            is_straight=turning is not None and turning.is_straight,
            progress_ratio=min(1.0, (self._laps_closed + share) / self._cfg.laps),
            path_length_m=self._path.length_m, outcome=self._outcome if over else "", reason=self._reason,
            lands_blind=self.state is S.LAND and self._outcome == "vision_lost",
        )  # fmt: skip
