"""Arming, modes and failsafes as PX4's commander decides them, ten times a second.

Source: PX4 Commander.cpp, UserModeIntention.cpp, HealthAndArmingChecks, failsafe/framework.cpp; PX4.md sections 4 and 6.
"""

from __future__ import annotations

from typing import Protocol

from simbridge.autopilot import events
from simbridge.autopilot.battery import Battery
from simbridge.autopilot.estimator import Estimator
from simbridge.autopilot.landing import LandDetector
from simbridge.autopilot.modes import Mode, by_number
from simbridge.autopilot.params import ParamStore

ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED, FAILED = range(5)
CRITICAL, WARNING, INFO = 2, 4, 6  # MAV_SEVERITY
STANDBY, UNINIT, ACTIVE, CRITICAL_STATE = 3, 0, 4, 5  # MAV_STATE
FORCE = 21196.0  # param2 of COMPONENT_ARM_DISARM
PERIOD_NS = 100_000_000
DENIED_TEXT = "Arming denied: Resolve system health failures first\t"

_LADDER = (Mode.LOITER, Mode.RTL, Mode.LAND, Mode.DESCEND)
_OFFBOARD_LOSS = {0: Mode.POSCTL, 1: Mode.ALTCTL, 2: Mode.STABILIZED, 3: Mode.RTL, 4: Mode.LAND, 5: Mode.LOITER}
_LINK_LOSS = {1: Mode.LOITER, 2: Mode.RTL, 3: Mode.LAND, 7: Mode.LOITER}
_ACTION = {Mode.LOITER: 5, Mode.RTL: 6, Mode.LAND: 7, Mode.DESCEND: 8}
_TEXT_LOW = {1: "Low battery level\t", 2: "Critical battery level\t", 3: "Emergency battery level\t"}


class Tell(Protocol):
    """Says a text to ground stations and an event to every link."""

    def __call__(self, severity: int, text: str, event: events.Event | None = None) -> None: ...


class OffboardSignal:
    """The companion's stream of setpoints: when the last one came and what it asked for."""

    def __init__(self) -> None:
        self.last_ns = -(10**18)
        self.needs_position = False
        self.needs_velocity = False
        self.ever = False

    def note(self, t_ns: int, *, position: bool, velocity: bool) -> None:
        self.last_ns, self.needs_position, self.needs_velocity, self.ever = t_ns, position, velocity, True


class Commander:
    """Holds the armed state, the mode asked for (`intended`) and the mode in force (`mode`)."""

    def __init__(self, params: ParamStore, ekf: Estimator, land: LandDetector, battery: Battery, tell: Tell) -> None:
        self._params, self._ekf, self._land, self._battery, self._tell = params, ekf, land, battery, tell
        self.is_armed = False
        self.mode = self.intended = Mode.LOITER
        self._before_landing = Mode.LOITER
        self.in_failsafe = False
        self.signal = OffboardSignal()
        self.ground_station_ns = -(10**18)
        self.now_ns = 0
        self._next_ns = 0
        self._armed_ns = 0
        self._landed_since_ns = -1
        self._has_flown = False
        self._override: Mode | None = None
        self._override_since_ns = -1
        self._warned = 0
        self._was_landed = True
        self._told: set[str] = set()

    # what may be

    def offboard_available(self) -> bool:
        s = self.signal
        if self.now_ns - s.last_ns > self._loss_ns:
            return False
        return not ((s.needs_position or s.needs_velocity) and not self._ekf.xy_valid)

    @property
    def _loss_ns(self) -> float:
        return self._params.real("COM_OF_LOSS_T") * 1e9

    def can_run(self, mode: Mode) -> bool:
        """The mode's requirements are met now. There is no manual control, so manual modes never can."""
        info = mode.value
        if info.is_manual or not self._ekf.attitude_valid:
            return mode is Mode.DESCEND
        if mode is Mode.OFFBOARD:
            return self.offboard_available()
        if info.needs_global:
            return self._ekf.global_valid
        if info.needs_local:
            return self._ekf.xy_valid and (
                mode is Mode.LAND or self._ekf.eph_m < 2.5 * self._params.real("COM_POS_FS_EPH")
            )
        return True

    def can_arm(self) -> bool:
        """Preflight checks for the mode asked for: what system_status STANDBY says."""
        if not self.can_run(self.intended):
            return False
        if self._ekf.xy_valid and not self._ekf.vision.stable(self.now_ns):
            return False
        if self._params.integer("COM_ARM_WO_GPS") == 0 and not self._ekf.global_valid:
            return False
        has_ground = self.now_ns - self.ground_station_ns < self._params.integer("COM_DL_LOSS_T") * 10**9
        return has_ground or self._params.integer("NAV_DLL_ACT") == 0

    @property
    def system_status(self) -> int:
        if self.is_armed:
            return CRITICAL_STATE if self.in_failsafe else ACTIVE
        return STANDBY if self.can_arm() else UNINIT

    @property
    def base_mode(self) -> int:
        base: int = self.mode.value.base
        if self.mode is Mode.OFFBOARD and not self.signal.ever:
            base = 1
        return base | (128 if self.is_armed else 0)

    # what is asked

    def request_mode(self, mode: Mode) -> int:
        """Disarmed, every mode is taken; armed, only one that can run. Returns MAV_RESULT."""
        if self.is_armed and not self.can_run(mode):
            return TEMPORARILY_REJECTED
        if mode in (Mode.LAND, Mode.RTL) and self.intended not in (Mode.LAND, Mode.RTL):
            self._before_landing = self.intended
        self.intended = mode
        self._override, self._override_since_ns = None, -1
        self._decide()
        return ACCEPTED

    def request_mode_number(self, main: int, sub: int) -> int:
        """DO_SET_MODE by PX4's main and sub mode."""
        mode = by_number(main, sub)
        if isinstance(mode, str):
            self._tell(CRITICAL, mode, events.unsupported_main_mode())
            return TEMPORARILY_REJECTED
        return self.request_mode(mode)

    def request_arm(self, arm: bool, force: bool) -> int:
        """COMPONENT_ARM_DISARM."""
        if arm == self.is_armed:
            return ACCEPTED
        if arm:
            if not force and not self.can_arm():
                self._tell(CRITICAL, DENIED_TEXT, events.arming_denied())
                return TEMPORARILY_REJECTED
            self._arm()
            return ACCEPTED
        if not self._land.is_landed and not force:
            self._tell(CRITICAL, "Disarming denied: not landed\t")
            return TEMPORARILY_REJECTED
        self._disarm("Disarmed by external command\t")
        return ACCEPTED

    def _arm(self) -> None:
        self.is_armed = True
        self._armed_ns = self.now_ns
        self._has_flown = False
        self._landed_since_ns = -1
        self._warned = 0
        self._tell(INFO, "Armed by external command\t", events.armed())
        self._decide()

    def _disarm(self, text: str) -> None:
        self.is_armed = False
        self._tell(INFO, text, events.disarmed(by_landing=self._has_flown and self._land.is_landed))
        self._override, self._override_since_ns = None, -1
        if self.intended in (Mode.LAND, Mode.RTL, Mode.TAKEOFF):
            self.intended = self._before_landing
        self._decide()

    # what is decided

    def step(self, t_ns: int) -> bool:
        """Run when due. True if it ran."""
        self.now_ns = t_ns
        if t_ns < self._next_ns:
            return False
        self._next_ns = t_ns + PERIOD_NS
        self._watch_landing(t_ns)
        self._tell_preflight()
        self._watch_battery()
        self._watch_ground_station()
        self._decide()
        return True

    def takeoff_done(self) -> None:
        """AUTO.TAKEOFF has arrived: hold there."""
        if self.intended is Mode.TAKEOFF:
            self.intended = Mode.LOITER
            self._decide()

    def _decide(self) -> None:
        """The mode in force: the one asked for, or the first that can run below it."""
        if not self.is_armed:
            self.mode, self.in_failsafe = self.intended, False
            return
        wanted, is_failsafe = self.intended, False
        if self._override is not None:
            delay = self._params.real("COM_FAIL_ACT_T") * 1e9
            holding = self.now_ns - self._override_since_ns < delay and self.can_run(Mode.LOITER)
            wanted, is_failsafe = (Mode.LOITER if holding else self._override), True
        if not self.can_run(wanted):
            wanted, is_failsafe = self._fallback(wanted), True
        if is_failsafe and not self.in_failsafe:
            if self.intended is Mode.OFFBOARD and self.now_ns - self.signal.last_ns > self._loss_ns:
                self._tell(CRITICAL, "No offboard signal\t", events.no_offboard_signal())
            self._tell(CRITICAL, "Failsafe activated\t", events.failsafe(self.intended.custom_mode, _ACTION[wanted]))
        self.in_failsafe, self.mode = is_failsafe, wanted

    def _fallback(self, mode: Mode) -> Mode:
        """Down the ladder from the action that the parameters name."""
        action = mode
        if mode is Mode.OFFBOARD:
            action = _OFFBOARD_LOSS.get(self._params.integer("COM_OBL_RC_ACT"), Mode.DESCEND)
        if action.value.is_manual:  # and there is no manual control
            action = _LINK_LOSS.get(self._params.integer("NAV_RCL_ACT"), Mode.LOITER)
        first = _LADDER.index(action) if action in _LADDER else 0
        return next(m for m in _LADDER[first:] if self.can_run(m))

    def _tell_preflight(self) -> None:
        """The estimator's preflight complaints, each once after boot."""
        if self.is_armed or not self._ekf.attitude_valid:
            return
        for text, fails in (
            ("Preflight Fail: no heading reference", not self._ekf.vision.yaw_aligned),
            (
                "Preflight Fail: horizontal position unstable",
                self._ekf.xy_valid and not self._ekf.vision.stable(self.now_ns),
            ),
        ):
            if fails and text not in self._told:
                self._told.add(text)
                self._tell(CRITICAL, text)

    def _watch_landing(self, t_ns: int) -> None:
        landed = self._land.is_landed
        if landed != self._was_landed:
            self._was_landed = landed
            if self.is_armed:
                self._tell(INFO, "Landing detected\t" if landed else "Takeoff detected\t", events.landing(landed))
        if not self.is_armed:
            return
        if not landed:
            self._has_flown, self._landed_since_ns = True, -1
            return
        if self._landed_since_ns < 0:
            self._landed_since_ns = t_ns
        name = "COM_DISARM_LAND" if self._has_flown else "COM_DISARM_PRFLT"
        timeout = self._params.real(name)
        if timeout > 0.0 and t_ns - self._landed_since_ns >= timeout * 1e9:
            self._disarm("Disarmed by landing\t" if self._has_flown else "Disarmed by auto preflight disarming\t")

    def _watch_battery(self) -> None:
        level = self._battery.warning
        if level > self._warned and self.is_armed:
            self._tell(CRITICAL if level > 1 else WARNING, _TEXT_LOW[level])
            self._warned = level
            action = self._params.integer("COM_LOW_BAT_ACT")
            if level >= 2 and action == 2:
                self._force(Mode.LAND)
            elif level >= 2 and action == 3:
                self._force(Mode.RTL if level == 2 else Mode.LAND)

    def _watch_ground_station(self) -> None:
        action = _LINK_LOSS.get(self._params.integer("NAV_DLL_ACT"))
        if action is None or not self.is_armed or self.ground_station_ns < 0 or self._override is not None:
            return
        if self.mode is Mode.OFFBOARD and self._params.integer("COM_DLL_EXCEPT") & 4:
            return
        if self.now_ns - self.ground_station_ns > self._params.integer("COM_DL_LOSS_T") * 10**9:
            self._force(action)

    def _force(self, mode: Mode) -> None:
        self._override, self._override_since_ns = mode, self.now_ns
