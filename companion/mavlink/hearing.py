"""What the autopilot's messages mean: each is taken in by the small machine it belongs to."""

from __future__ import annotations

import math
from collections.abc import Callable

from companion.mavlink import frames, wire
from companion.mavlink.ardupilot import ARDUPILOT
from companion.mavlink.codec import Frame
from companion.mavlink.commands import Commands, Outcome
from companion.mavlink.dialect import Dialect
from companion.mavlink.journal import Journal
from companion.mavlink.origin import Origin
from companion.mavlink.outbox import Outbox
from companion.mavlink.parameters import Parameters
from companion.mavlink.px4 import PX4
from companion.mavlink.px4_events import FAILSAFE_EVENTS
from companion.mavlink.texts import Texts
from companion.mavlink.timesync import Timesync
from companion.mavlink.vehicle import Vehicle
from companion.messages import AttitudeSample, LandedState, RangefinderSample, Severity

_DIALECTS = {wire.AUTOPILOT_PX4: PX4, wire.AUTOPILOT_ARDUPILOT: ARDUPILOT}
_DOWNWARD = 25  # MAV_SENSOR_ROTATION_PITCH_270
_PREARM = 1 << 28  # MAV_SYS_STATUS_PREARM_CHECK
_MAV_STATE_BOOT = 1
_ARMED = 128  # MAV_MODE_FLAG_SAFETY_ARMED
_MAX_RATE_RADPS = 100.0
_FIRST_BATTERY = 0


class Hearing:
    """The state of the conversation. on_begin: called when the handshake begins, at first and after each restart of
    the autopilot. dropped: called with the reason when a message's content cannot be used."""

    def __init__(
        self,
        outbox: Outbox,
        commands: Commands,
        origin: Origin,
        journal: Journal,
        parameters: Parameters,
        *,
        on_begin: Callable[[], None],
        dropped: Callable[[str], None],
    ) -> None:
        self.dialect: Dialect | None = None
        self.vehicle = Vehicle()
        self.timesync = Timesync()
        self.origin = origin
        self.attitude: AttitudeSample | None = None
        self._outbox = outbox
        self._commands = commands
        self._journal = journal
        self._parameters = parameters
        self._on_begin = on_begin
        self._dropped = dropped
        self._texts = Texts()
        self._handlers: dict[int, Callable[[bytes, int], AttitudeSample | RangefinderSample | None]] = {
            wire.HEARTBEAT: self._on_heartbeat,
            wire.SYS_STATUS: self._on_sys_status,
            wire.ATTITUDE_QUATERNION: self._on_attitude,
            wire.LOCAL_POSITION_NED: self._on_position,
            wire.GPS_GLOBAL_ORIGIN: self._on_origin,
            wire.COMMAND_ACK: self._on_ack,
            wire.TIMESYNC: self._on_timesync,
            wire.DISTANCE_SENSOR: self._on_distance,
            wire.BATTERY_STATUS: self._on_battery,
            wire.EKF_STATUS_REPORT: self._on_ekf_report,
            wire.ESTIMATOR_STATUS: self._on_estimator_status,
            wire.EXTENDED_SYS_STATE: self._on_extended_state,
            wire.STATUSTEXT: self._on_text,
            wire.EVENT: self._on_event,
            wire.CURRENT_MODE: self._on_current_mode,
            wire.PARAM_VALUE: self._on_parameter,
            wire.PARAM_ERROR: self._on_parameter_error,
        }

    def hear(self, frame: Frame, t_ns: int) -> AttitudeSample | RangefinderSample | None:
        """Take in one frame of the autopilot; a sample, when it carried one."""
        self.vehicle.t_heard_ns = t_ns
        handler = self._handlers.get(frame.msg_id)
        return handler(frame.payload, t_ns) if handler is not None else None

    # ---- who it is, and its restarts --------------------------------------------------------------------------------

    def _on_heartbeat(self, payload: bytes, t_ns: int) -> None:
        custom_mode, _, autopilot, base_mode, system_status, _ = wire.unpack(wire.HEARTBEAT, payload)
        dialect = _DIALECTS.get(autopilot)
        if dialect is None:
            self._dropped("not_an_autopilot")
            return
        is_first = self.vehicle.t_heartbeat_ns is None
        if dialect is not self.dialect:
            self._begin(dialect, t_ns)
        elif system_status == _MAV_STATE_BOOT and self.vehicle.system_status > _MAV_STATE_BOOT:
            self._begin_anew("it says that it boots", None, t_ns)  # ArduPilot: nothing with its clock streams then
        elif self._was_lost(t_ns) and not self.vehicle.is_armed and not base_mode & _ARMED:
            self._begin(dialect, t_ns)  # it may have restarted: streams, origin and parameters are asked for again
        self._journal.add(self.vehicle.on_heartbeat(dialect, custom_mode, base_mode, system_status, t_ns))
        if is_first and self.vehicle.is_armed:
            self.vehicle.joined_in_flight = True
            self._journal.tell(
                Severity.WARNING,
                "joined_in_flight",
                "The vehicle is already armed: staying passive (no vision, no setpoints, no commands but hold and "
                "land) until the operator hands over",
            )
        if not self.vehicle.is_armed:
            self.vehicle.joined_in_flight = False

    def _begin(self, dialect: Dialect, t_ns: int) -> None:
        """The handshake, with an autopilot met for the first time or anew after its restart."""
        self.dialect = dialect
        self._commands.clear()
        self.timesync.max_round_trip_ns = dialect.max_round_trip_ns
        self.timesync.restart()
        self.origin.restart(t_ns)
        self._parameters.restart(dialect.name, is_bytewise=dialect.has_bytewise_parameters)
        self.attitude = None
        self._on_begin()
        for msg_id, rate_hz in dialect.streams_hz:
            interval_us = 1e6 / rate_hz if rate_hz > 0 else -1.0
            label = f"{wire.message_name(msg_id)} at {rate_hz:g} Hz" if rate_hz > 0 else ""
            params = (float(msg_id), interval_us)
            self._commands.request(
                wire.CMD_SET_MESSAGE_INTERVAL, params, t_ns, label=label, then=self._on_interval_outcome
            )
        self._journal.tell(Severity.INFO, "autopilot_found", f"The autopilot is {dialect.name}")

    def _on_interval_outcome(self, outcome: Outcome, t_ns: int) -> None:
        if not outcome.accepted and outcome.label:
            self._journal.tell(Severity.WARNING, "stream_refused", f"Stream {outcome.label}: {outcome.word}")

    def _note_boot_time(self, boot_ms: int, t_ns: int) -> None:
        if self.vehicle.on_boot_time(boot_ms):
            self._begin_anew(f"its clock fell to {boot_ms / 1e3:.1f} s", boot_ms, t_ns)

    def _begin_anew(self, why: str, boot_ms: int | None, t_ns: int) -> None:
        if self.dialect is None:
            return
        self.vehicle = Vehicle(t_heard_ns=t_ns, boot_ms=boot_ms)
        self._begin(self.dialect, t_ns)
        self._journal.tell(
            Severity.CRITICAL,
            "autopilot_rebooted",
            f"The autopilot has restarted ({why}): offboard dropped, the handshake begins anew, nothing is armed",
        )

    def _was_lost(self, t_ns: int) -> bool:
        return self.vehicle.t_heartbeat_ns is not None and not self.vehicle.is_connected(t_ns)

    # ---- samples ----------------------------------------------------------------------------------------------------

    def _on_attitude(self, payload: bytes, t_ns: int) -> AttitudeSample | None:
        boot_ms, w, x, y, z, p, q, r, *_ = wire.unpack(wire.ATTITUDE_QUATERNION, payload)
        self._note_boot_time(boot_ms, t_ns)
        rotation = frames.quaternion_from_ned_frd(w, x, y, z)
        if rotation is None or not max(abs(p), abs(q), abs(r)) < _MAX_RATE_RADPS or math.isnan(p + q + r):
            self._dropped("attitude_unusable")
            return None
        stamp = self.timesync.to_companion(boot_ms * 1_000_000, t_ns)
        if self.attitude is not None and stamp <= self.attitude.t_ns:
            self._dropped("attitude_out_of_order")
            return None
        self.vehicle.t_attitude_ns = t_ns
        self.attitude = AttitudeSample(
            t_ns=stamp, q_ref_body_wxyz=rotation, rate_body_radps=frames.vector_from_frd(p, q, r)
        )
        return self.attitude

    def _on_distance(self, payload: bytes, t_ns: int) -> RangefinderSample | None:
        fields = wire.unpack(wire.DISTANCE_SENSOR, payload)
        boot_ms, low, high, now, _, _, orientation = fields[:7]
        signal_quality = fields[-1]  # 1: invalid; 0: unknown
        if orientation != _DOWNWARD or not low <= now <= high or signal_quality == 1:
            self._dropped("distance_unusable")
            return None
        stamp = self.timesync.to_companion(boot_ms * 1_000_000, t_ns)
        return RangefinderSample(t_ns=stamp, distance_m=now / 100.0)

    # ---- state ------------------------------------------------------------------------------------------------------

    def _on_position(self, payload: bytes, t_ns: int) -> None:
        boot_ms, x, y, z, vx, vy, vz = wire.unpack(wire.LOCAL_POSITION_NED, payload)
        self._note_boot_time(boot_ms, t_ns)
        if not math.isfinite(x + y + z + vx + vy + vz):
            self._dropped("position_unusable")
            return
        self.vehicle.position_map_m = frames.vector_from_frd(x, y, z)
        self.vehicle.velocity_map_mps = frames.vector_from_frd(vx, vy, vz)
        self.vehicle.t_position_ns = t_ns

    def _on_sys_status(self, payload: bytes, t_ns: int) -> None:
        fields = wire.unpack(wire.SYS_STATUS, payload)
        present, _, health = fields[:3]
        self.vehicle.sensors_present, self.vehicle.sensors_health = present, health
        self.vehicle.prearm_ok = bool(health & _PREARM) if present & _PREARM else None
        self._note_battery(fields[12])

    def _on_battery(self, payload: bytes, t_ns: int) -> None:
        fields = wire.unpack(wire.BATTERY_STATUS, payload)
        if fields[14] == _FIRST_BATTERY:
            self._note_battery(fields[17])

    def _note_battery(self, percent: int) -> None:
        if 0 <= percent <= 100:  # -1: not known
            self.vehicle.battery_ratio = percent / 100.0

    def _on_ekf_report(self, payload: bytes, t_ns: int) -> None:
        self._note_flags(wire.EKF_STATUS_REPORT, wire.unpack(wire.EKF_STATUS_REPORT, payload)[5], t_ns)

    def _on_estimator_status(self, payload: bytes, t_ns: int) -> None:
        self._note_flags(wire.ESTIMATOR_STATUS, wire.unpack(wire.ESTIMATOR_STATUS, payload)[9], t_ns)

    def _note_flags(self, msg_id: int, flags: int, t_ns: int) -> None:
        dialect, vehicle = self.dialect, self.vehicle
        if dialect is None or msg_id != dialect.estimator_message:
            return
        before, vehicle.estimator_flags = vehicle.estimator_flags, flags
        vehicle.t_estimator_ns = t_ns
        is_fused = dialect.is_vision_fused(flags)
        if before is None or dialect.is_vision_fused(before) == is_fused:
            return
        if is_fused:
            self._journal.tell(Severity.INFO, "vision_fused", f"The autopilot uses the vision (flags 0x{flags:03x})")
        else:
            severity = Severity.CRITICAL if vehicle.is_armed else Severity.WARNING
            text = f"The autopilot no longer uses the vision (flags 0x{flags:03x})"
            self._journal.tell(severity, "vision_not_fused", text)

    def _on_extended_state(self, payload: bytes, t_ns: int) -> None:
        _, landed = wire.unpack(wire.EXTENDED_SYS_STATE, payload)
        self.vehicle.landed_state = LandedState(landed) if landed <= LandedState.LANDING else LandedState.UNDEFINED
        self.vehicle.t_landed_ns = t_ns
        self._update_mode(t_ns)

    def _on_current_mode(self, payload: bytes, t_ns: int) -> None:
        custom_mode, _, standard_mode = wire.unpack(wire.CURRENT_MODE, payload)
        self.vehicle.standard_mode = (custom_mode, standard_mode)
        self.vehicle.note_custom_mode(custom_mode, t_ns)  # sooner than the heartbeat, which comes once a second
        self._update_mode(t_ns)

    def _update_mode(self, t_ns: int) -> None:
        if self.dialect is not None and self.vehicle.t_heartbeat_ns is not None:
            self._journal.add(self.vehicle.update_mode(self.dialect, t_ns))

    # ---- services ---------------------------------------------------------------------------------------------------

    def _on_origin(self, payload: bytes, t_ns: int) -> None:
        latitude, longitude, altitude_mm, _ = wire.unpack(wire.GPS_GLOBAL_ORIGIN, payload)
        if not self.origin.on_origin(latitude, longitude, altitude_mm):
            return
        whose = "as sent" if self.origin.sent else "it had one already"
        place = f"{latitude / 1e7:.5f}, {longitude / 1e7:.5f}, {altitude_mm / 1e3:.1f} m"
        self._journal.tell(Severity.INFO, "origin_confirmed", f"Origin {place} ({whose})")
        if altitude_mm and self.dialect is PX4:
            self._journal.tell(
                Severity.WARNING,
                "origin_altitude",
                f"The origin's altitude is {altitude_mm / 1e3:.1f} m, not 0: with vision as height reference the "
                "autopilot's local height is off by that much; restart it and let the companion set the origin",
            )

    def _on_ack(self, payload: bytes, t_ns: int) -> None:
        command, result, _, _, system, component = wire.unpack(wire.COMMAND_ACK, payload)
        if system in (0, self._commands.target_system) and component in (0, wire.COMP_COMPANION):
            self._commands.on_ack(command, result, t_ns)

    def _on_timesync(self, payload: bytes, t_ns: int) -> None:
        tc1, ts1 = wire.unpack(wire.TIMESYNC, payload)
        answer = self.timesync.on_message(tc1, ts1, t_ns)
        if answer is not None:
            self._outbox.put(wire.TIMESYNC, wire.pack(wire.TIMESYNC, *answer), t_ns)

    def _on_parameter(self, payload: bytes, t_ns: int) -> None:
        self._parameters.on_value(payload)

    def _on_parameter_error(self, payload: bytes, t_ns: int) -> None:
        self._parameters.on_error(payload)

    def _on_text(self, payload: bytes, t_ns: int) -> None:
        self._journal.add(self._texts.on_text(payload, t_ns))

    def _on_event(self, payload: bytes, t_ns: int) -> None:
        if wire.unpack(wire.EVENT, payload)[0] in FAILSAFE_EVENTS:
            self.vehicle.t_failsafe_event_ns = t_ns
            self.vehicle.is_failsafe_told = True
        self._journal.add(self._texts.on_event(payload, t_ns))
