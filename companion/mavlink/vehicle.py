"""What the autopilot last said of itself, and what changed: modes, failsafe, takeover by the pilot, restarts."""

from __future__ import annotations

from dataclasses import dataclass

from companion.mavlink.dialect import Dialect, ModeReport
from companion.messages import Array, Event, FlightMode, LandedState, Severity

WARN_AGE_NS = 1_000_000_000
LOST_AGE_NS = 3_000_000_000
_ARMED = 128  # MAV_MODE_FLAG_SAFETY_ARMED
_FAILSAFE_STATES = (5, 6)  # MAV_STATE_CRITICAL, MAV_STATE_EMERGENCY
_REBOOT_FALL_MS = 1000
_HEARTBEAT_KNOWS_NS = 1_500_000_000  # it comes once a second


@dataclass(slots=True)
class Vehicle:
    """Newest values, and the mode that we ourselves asked for last."""

    t_heard_ns: int | None = None
    t_heartbeat_ns: int | None = None
    custom_mode: int = 0
    is_armed: bool = False
    system_status: int = 0
    mode: FlightMode = FlightMode.UNKNOWN
    t_custom_mode_ns: int = 0  # when custom_mode last changed
    landed_state: LandedState = LandedState.UNDEFINED
    t_landed_ns: int = 0
    standard_mode: tuple[int, int] | None = None  # (custom_mode, MAV_STANDARD_MODE)
    estimator_flags: int | None = None
    t_estimator_ns: int | None = None
    t_attitude_ns: int | None = None
    position_map_m: Array | None = None
    velocity_map_mps: Array | None = None
    t_position_ns: int | None = None
    battery_ratio: float | None = None
    prearm_ok: bool | None = None
    sensors_present: int | None = None  # MAV_SYS_STATUS_SENSOR
    sensors_health: int | None = None
    boot_ms: int | None = None
    wanted_mode: FlightMode | None = None
    pilot_has_control: bool = False
    joined_in_flight: bool = False
    is_failsafe_told: bool = False  # by an event, since the last heartbeat that could say it itself
    t_failsafe_event_ns: int = 0
    _link: str = "none"

    @property
    def is_failsafe(self) -> bool:
        return self.system_status in _FAILSAFE_STATES or self.mode is FlightMode.DESCEND or self.is_failsafe_told

    def on_heartbeat(
        self, dialect: Dialect, custom_mode: int, base_mode: int, system_status: int, t_ns: int
    ) -> list[Event]:
        self.t_heartbeat_ns = t_ns
        self.system_status = system_status
        if t_ns - self.t_failsafe_event_ns > _HEARTBEAT_KNOWS_NS:
            self.is_failsafe_told = False
        was_armed, self.is_armed = self.is_armed, bool(base_mode & _ARMED)
        events = self._arming_events(was_armed, t_ns)
        self.note_custom_mode(custom_mode, t_ns)
        return events + self.update_mode(dialect, t_ns)

    def note_custom_mode(self, custom_mode: int, t_ns: int) -> None:
        if custom_mode != self.custom_mode:
            self.custom_mode, self.t_custom_mode_ns = custom_mode, t_ns

    def _arming_events(self, was_armed: bool, t_ns: int) -> list[Event]:
        if was_armed == self.is_armed:
            return []
        if not self.is_armed:
            self.wanted_mode = None
            return [Event(t_ns=t_ns, severity=Severity.NOTICE, name="disarmed", text="The vehicle is disarmed")]
        return [Event(t_ns=t_ns, severity=Severity.NOTICE, name="armed", text="The vehicle is armed")]

    def update_mode(self, dialect: Dialect, t_ns: int) -> list[Event]:
        """Work the mode out again, after anything that it hangs on has changed."""
        standard = self.standard_mode
        is_landed_news = self.t_landed_ns > self.t_custom_mode_ns  # an older one is of the mode before
        report = ModeReport(
            custom_mode=self.custom_mode,
            landed_state=self.landed_state if is_landed_news else LandedState.UNDEFINED,
            standard_mode=standard[1] if standard is not None and standard[0] == self.custom_mode else None,
        )
        before, self.mode = self.mode, dialect.decode_mode(report)
        if before is self.mode or before is FlightMode.UNKNOWN:
            return []
        return self._mode_events(before, t_ns)

    def _mode_events(self, before: FlightMode, t_ns: int) -> list[Event]:
        change = f"{before.value} to {self.mode.value}"
        if self.is_armed and self.is_failsafe:
            return [
                Event(
                    t_ns=t_ns,
                    severity=Severity.CRITICAL,
                    name="autopilot_failsafe",
                    text=f"The autopilot's failsafe took over: {change}",
                )
            ]
        ours = self.mode is self.wanted_mode or (before is FlightMode.LAND and self.mode is FlightMode.DESCEND)
        if self.is_armed and before is FlightMode.OFFBOARD and not ours:
            self.pilot_has_control = True
            return [
                Event(
                    t_ns=t_ns,
                    severity=Severity.WARNING,
                    name="pilot_took_control",
                    text=f"Mode changed from {change}, not by us: setpoints stop until the operator hands back",
                )
            ]
        return [Event(t_ns=t_ns, severity=Severity.INFO, name="mode_changed", text=f"Mode changed from {change}")]

    def on_boot_time(self, boot_ms: int) -> bool:
        """Note time_boot_ms. True when it fell: the autopilot has restarted. (At 49.7 days it wraps; that is none.)"""
        last, self.boot_ms = self.boot_ms, boot_ms
        if last is None or boot_ms >= last:
            return False
        if last - boot_ms > 1 << 31:
            return False
        if last - boot_ms <= _REBOOT_FALL_MS:
            self.boot_ms = last  # merely late
            return False
        return True

    def is_connected(self, t_ns: int) -> bool:
        return self.t_heartbeat_ns is not None and t_ns - self.t_heartbeat_ns <= LOST_AGE_NS

    def link_events(self, t_ns: int) -> list[Event]:
        """Told once each: nothing heard for 1 s, heartbeat gone for 3 s, all back."""
        if self.t_heartbeat_ns is None or self.t_heard_ns is None:
            return []
        state = "good"
        if not self.is_connected(t_ns):
            state = "lost"
        elif t_ns - self.t_heard_ns > WARN_AGE_NS:
            state = "weak"
        before, self._link = self._link, state
        if state == before or (before == "none" and state == "good"):
            return []
        severity, text = {
            "weak": (Severity.WARNING, "Nothing heard from the autopilot for 1 s"),
            "lost": (Severity.CRITICAL, "Link to the autopilot lost: no heartbeat for 3 s"),
            "good": (Severity.NOTICE, "The autopilot is heard again"),
        }[state]
        return [Event(t_ns=t_ns, severity=severity, name=f"link_{state}", text=text)]
