"""The companion's end of the MAVLink conversation, sans-IO: bytes and times in, messages and bytes out."""

from __future__ import annotations

from collections.abc import Callable, Hashable

from companion.config import MavlinkConfig
from companion.mavlink import frames, wire
from companion.mavlink.ardupilot import ARDUPILOT
from companion.mavlink.arming import reasons_not_to_arm
from companion.mavlink.codec import Decoder, Frame
from companion.mavlink.commands import Commands, Outcome
from companion.mavlink.computer import ComputerStatus, pack_computer_status
from companion.mavlink.dialect import Dialect
from companion.mavlink.heartbeats import Heartbeats, SignsOfLife
from companion.mavlink.origin import Origin, OriginAction, OriginState
from companion.mavlink.outbox import Outbox
from companion.mavlink.px4 import PX4
from companion.mavlink.setpoints import pack_obstacles, pack_setpoint
from companion.mavlink.signing import Signer
from companion.mavlink.sources import Sources
from companion.mavlink.texts import Texts, decode_event, pack_text
from companion.mavlink.timesync import Timesync
from companion.mavlink.vehicle import Vehicle
from companion.mavlink.vision import Vision
from companion.messages import (
    AttitudeSample,
    Event,
    FlightMode,
    LandedState,
    OdometryEstimate,
    RangefinderSample,
    RequestKind,
    Setpoint,
    SetpointKind,
    Severity,
    VehicleRequest,
    VehicleState,
    WallRanges,
)

Received = AttitudeSample | RangefinderSample | VehicleState | Event

_DIALECTS = {wire.AUTOPILOT_PX4: PX4, wire.AUTOPILOT_ARDUPILOT: ARDUPILOT}
_MODE_OF_REQUEST = {
    RequestKind.OFFBOARD: FlightMode.OFFBOARD,
    RequestKind.LAND: FlightMode.LAND,
    RequestKind.HOLD: FlightMode.HOLD,
}
_DOWNWARD = 25  # MAV_SENSOR_ROTATION_PITCH_270
_PREARM = 1 << 28  # MAV_SYS_STATUS_PREARM_CHECK
_POSITION_AGE_NS = 1_000_000_000
_TAKEOFF_HEIGHT_M = 1.5
_CLIMB_MPS = 0.05


class MavlinkSession:
    """One autopilot, heard and spoken to.

    Args:
        signer: signs and checks; None: unsigned.

    `receive` what the link brings, `poll` at `next_deadline_ns`, and put `data_to_send` on the link after each call.
    """

    def __init__(self, cfg: MavlinkConfig, *, signer: Signer | None = None) -> None:
        self._cfg = cfg
        self._system = cfg.system_id
        self._decoder = Decoder()
        self._signer = signer
        self._outbox = Outbox(cfg.system_id, signer)
        self._sources = Sources(cfg.system_id)
        self._timesync = Timesync()
        self._heartbeats = Heartbeats()
        self._signs = SignsOfLife()
        self._commands = Commands(self._send_command, cfg.system_id)
        self._origin = Origin(round(cfg.origin_latitude_deg * 1e7), round(cfg.origin_longitude_deg * 1e7))
        self._vision = Vision()
        self._vehicle = Vehicle()
        self._texts = Texts()
        self._dialect: Dialect | None = None
        self._attitude: AttitudeSample | None = None
        self._events: list[Event] = []
        self._t_ns = 0
        self._text_id = 0
        self._event_sequence: int | None = None
        self._joined_in_flight = False
        self._taking_off = False
        self.setpoints_sent = 0
        self._handlers: dict[int, Callable[[Frame, int, list[Received]], None]] = {
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
        }

    # ------------------------------------------------------------------ what the link brings

    def receive(self, data: bytes, t_ns: int, source: Hashable | None = None) -> list[Received]:
        """Take in bytes that came at `t_ns` from `source` (an address; None where the link has only one end)."""
        self._t_ns = t_ns
        out: list[Received] = []
        for frame in self._decoder.receive(data):
            reason = self._signer.refusal(frame, t_ns) if self._signer is not None else None
            reason = reason or self._sources.judge(frame, source)
            if reason is not None:
                out.extend(self._sources.refuse(reason, frame, source, t_ns))
                continue
            self._vehicle.t_heard_ns = t_ns
            handler = self._handlers.get(frame.msg_id)
            if handler is not None:
                handler(frame, t_ns, out)
        out.extend(self._take_events())
        return out

    def _on_heartbeat(self, frame: Frame, t_ns: int, out: list[Received]) -> None:
        custom_mode, _, autopilot, base_mode, system_status, _ = wire.unpack(wire.HEARTBEAT, frame.payload)
        dialect = _DIALECTS.get(autopilot)
        if dialect is None:
            self._sources.refused["not_an_autopilot"] += 1
            return
        is_first = self._vehicle.t_heartbeat_ns is None
        if dialect is not self._dialect:
            self._begin(dialect, t_ns)
        out.extend(self._vehicle.on_heartbeat(dialect, custom_mode, base_mode, system_status, t_ns))
        if is_first and self._vehicle.is_armed:
            self._joined_in_flight = True
            self._tell(
                Severity.WARNING,
                "joined_in_flight",
                "The vehicle is already armed: staying passive (no vision, no setpoints, no commands but hold and "
                "land) until the operator hands over",
            )
        if not self._vehicle.is_armed:
            self._joined_in_flight = False
            self._taking_off = False
        out.append(self.vehicle_state(t_ns))

    def _begin(self, dialect: Dialect, t_ns: int) -> None:
        """The handshake, with an autopilot met for the first time or anew after its restart."""
        self._dialect = dialect
        self._commands.clear()
        self._timesync.restart()
        self._origin.restart(t_ns)
        self._vision.restart()
        self._event_sequence = None
        self._taking_off = False
        for msg_id, rate_hz in dialect.streams_hz:
            interval_us = 1e6 / rate_hz if rate_hz > 0 else -1.0
            label = f"{wire.message_name(msg_id)} at {rate_hz:g} Hz" if rate_hz > 0 else ""
            params = (float(msg_id), interval_us)
            self._commands.request(
                wire.CMD_SET_MESSAGE_INTERVAL, params, t_ns, label=label, then=self._on_interval_outcome
            )
        self._tell(Severity.INFO, "autopilot_found", f"The autopilot is {dialect.name}")

    def _on_interval_outcome(self, outcome: Outcome, t_ns: int) -> None:
        if not outcome.accepted and outcome.label:
            self._tell(Severity.WARNING, "stream_refused", f"Stream {outcome.label}: {outcome.word}")

    def _note_boot_time(self, boot_ms: int, t_ns: int) -> None:
        if not self._vehicle.on_boot_time(boot_ms) or self._dialect is None:
            return
        dialect = self._dialect
        self._vehicle = Vehicle(t_heard_ns=t_ns, boot_ms=boot_ms)
        self._attitude = None
        self._begin(dialect, t_ns)
        self._tell(
            Severity.CRITICAL,
            "autopilot_rebooted",
            f"The autopilot has restarted (its clock fell to {boot_ms / 1e3:.1f} s): offboard dropped, the handshake "
            "begins anew, nothing is armed",
        )

    def _on_attitude(self, frame: Frame, t_ns: int, out: list[Received]) -> None:
        boot_ms, w, x, y, z, p, q, r, *_ = wire.unpack(wire.ATTITUDE_QUATERNION, frame.payload)
        self._note_boot_time(boot_ms, t_ns)
        rotation = frames.quaternion_from_ned_frd(w, x, y, z)
        total = p + q + r
        if rotation is None or total != total or abs(total) > 1e3:
            self._sources.refused["bad_attitude"] += 1
            return
        stamp = self._timesync.to_companion(boot_ms * 1_000_000, t_ns)
        if self._attitude is not None and stamp <= self._attitude.t_ns:
            self._sources.refused["attitude_out_of_order"] += 1
            return
        self._vehicle.t_attitude_ns = t_ns
        self._attitude = AttitudeSample(
            t_ns=stamp, q_ref_body_wxyz=rotation, rate_body_radps=frames.vector_from_frd(p, q, r)
        )
        out.append(self._attitude)

    def _on_position(self, frame: Frame, t_ns: int, out: list[Received]) -> None:
        boot_ms, x, y, z, vx, vy, vz = wire.unpack(wire.LOCAL_POSITION_NED, frame.payload)
        self._note_boot_time(boot_ms, t_ns)
        vehicle = self._vehicle
        vehicle.position_map_m = frames.vector_from_frd(x, y, z)
        vehicle.velocity_map_mps = frames.vector_from_frd(vx, vy, vz)
        vehicle.t_position_ns = t_ns

    def _on_origin(self, frame: Frame, t_ns: int, out: list[Received]) -> None:
        latitude, longitude, altitude, _ = wire.unpack(wire.GPS_GLOBAL_ORIGIN, frame.payload)
        if self._origin.on_origin(latitude, longitude, altitude):
            whose = "as sent" if self._origin.sent else "it had one already"
            self._tell(
                Severity.INFO,
                "origin_confirmed",
                f"Origin {latitude / 1e7:.5f}, {longitude / 1e7:.5f}, {altitude / 1e3:.1f} m ({whose})",
            )
            if altitude and self._dialect is PX4:
                self._tell(
                    Severity.WARNING,
                    "origin_altitude",
                    f"The origin's altitude is {altitude / 1e3:.1f} m, not 0: with vision as height reference the "
                    "local height will be off by that much",
                )

    def _on_ack(self, frame: Frame, t_ns: int, out: list[Received]) -> None:
        command, result, _, _, system, component = wire.unpack(wire.COMMAND_ACK, frame.payload)
        if system in (0, self._system) and component in (0, wire.COMP_COMPANION):
            self._commands.on_ack(command, result, t_ns)

    def _on_timesync(self, frame: Frame, t_ns: int, out: list[Received]) -> None:
        tc1, ts1 = wire.unpack(wire.TIMESYNC, frame.payload)
        answer = self._timesync.on_message(tc1, ts1, t_ns)
        if answer is not None:
            self._outbox.put(wire.TIMESYNC, wire.pack(wire.TIMESYNC, *answer), t_ns)

    def _on_distance(self, frame: Frame, t_ns: int, out: list[Received]) -> None:
        fields = wire.unpack(wire.DISTANCE_SENSOR, frame.payload)
        boot_ms, low, high, now, _, _, orientation = fields[:7]
        signal_quality = fields[-1]  # 1: invalid; 0: unknown
        if orientation != _DOWNWARD or not low <= now <= high or signal_quality == 1:
            self._sources.refused["distance_unusable"] += 1
            return
        stamp = self._timesync.to_companion(boot_ms * 1_000_000, t_ns)
        out.append(RangefinderSample(t_ns=stamp, distance_m=now / 100.0))

    def _on_sys_status(self, frame: Frame, t_ns: int, out: list[Received]) -> None:
        fields = wire.unpack(wire.SYS_STATUS, frame.payload)
        present, _, health = fields[:3]
        self._vehicle.prearm_ok = bool(health & _PREARM) if present & _PREARM else None
        self._note_battery(fields[12])

    def _on_battery(self, frame: Frame, t_ns: int, out: list[Received]) -> None:
        fields = wire.unpack(wire.BATTERY_STATUS, frame.payload)
        if fields[14] == 0:  # id: the first battery; remaining is in percent
            self._note_battery(fields[17])

    def _note_battery(self, percent: int) -> None:
        if 0 <= percent <= 100:
            self._vehicle.battery_ratio = percent / 100.0

    def _on_ekf_report(self, frame: Frame, t_ns: int, out: list[Received]) -> None:
        self._note_flags(wire.EKF_STATUS_REPORT, wire.unpack(wire.EKF_STATUS_REPORT, frame.payload)[5], t_ns)

    def _on_estimator_status(self, frame: Frame, t_ns: int, out: list[Received]) -> None:
        self._note_flags(wire.ESTIMATOR_STATUS, wire.unpack(wire.ESTIMATOR_STATUS, frame.payload)[9], t_ns)

    def _note_flags(self, msg_id: int, flags: int, t_ns: int) -> None:
        dialect, vehicle = self._dialect, self._vehicle
        if dialect is None or msg_id != dialect.estimator_message:
            return
        before, vehicle.estimator_flags = vehicle.estimator_flags, flags
        vehicle.t_estimator_ns = t_ns
        if before is None or dialect.is_vision_fused(before) == dialect.is_vision_fused(flags):
            return
        if dialect.is_vision_fused(flags):
            self._tell(Severity.INFO, "vision_fused", f"The autopilot uses the vision (flags 0x{flags:03x})")
        else:
            text = f"The autopilot no longer uses the vision (flags 0x{flags:03x})"
            self._tell(Severity.CRITICAL if vehicle.is_armed else Severity.WARNING, "vision_not_fused", text)

    def _on_extended_state(self, frame: Frame, t_ns: int, out: list[Received]) -> None:
        _, landed = wire.unpack(wire.EXTENDED_SYS_STATE, frame.payload)
        self._vehicle.landed_state = LandedState(landed) if landed <= 4 else LandedState.UNDEFINED
        if self._vehicle.landed_state is LandedState.IN_AIR:
            self._taking_off = False
        self._update_mode(t_ns, out)

    def _on_current_mode(self, frame: Frame, t_ns: int, out: list[Received]) -> None:
        custom_mode, _, standard_mode = wire.unpack(wire.CURRENT_MODE, frame.payload)
        self._vehicle.standard_mode = (custom_mode, standard_mode)
        self._vehicle.custom_mode = custom_mode  # sooner than the heartbeat, which comes once a second
        self._update_mode(t_ns, out)

    def _update_mode(self, t_ns: int, out: list[Received]) -> None:
        if self._dialect is None or self._vehicle.t_heartbeat_ns is None:
            return
        events = self._vehicle.update_mode(self._dialect, t_ns)
        out.extend(events)
        if events:
            out.append(self.vehicle_state(t_ns))

    def _on_text(self, frame: Frame, t_ns: int, out: list[Received]) -> None:
        out.extend(self._texts.on_text(frame.payload, t_ns))

    def _on_event(self, frame: Frame, t_ns: int, out: list[Received]) -> None:
        event, sequence = decode_event(frame.payload, t_ns)
        if sequence != self._event_sequence:  # each is sent again until its sequence was asked about
            out.append(event)
        self._event_sequence = sequence

    # ------------------------------------------------------------------ what time brings

    def poll(self, t_ns: int) -> list[Event]:
        """Do what is due: heartbeats, time sync, origin, retries. Returns what happened."""
        self._t_ns = t_ns
        for component, payload in self._heartbeats.poll(self._signs, t_ns):
            self._outbox.put(wire.HEARTBEAT, payload, t_ns, component)
        self._events.extend(self._vehicle.link_events(t_ns))
        if not self._vehicle.is_connected(t_ns) and self._vehicle.t_heartbeat_ns is not None:
            self._sources.release()
        if self._dialect is not None:
            if t_ns >= self._timesync.t_next_ns:
                self._outbox.put(wire.TIMESYNC, wire.pack(wire.TIMESYNC, *self._timesync.ask(t_ns)), t_ns)
            self._poll_origin(t_ns)
            self._commands.poll(t_ns)
        return self._take_events()

    def _poll_origin(self, t_ns: int) -> None:
        vehicle, dialect = self._vehicle, self._dialect
        if dialect is None or vehicle.t_heartbeat_ns is None:
            return
        flags = vehicle.estimator_flags
        may_set = not vehicle.is_armed and flags is not None
        if dialect is PX4 and flags is not None and dialect.is_position_valid(flags):
            may_set = False  # an origin set while vision is fused throws the local position away (PX4.md, 6)
        action = self._origin.poll(t_ns, may_set=may_set)
        if action is OriginAction.ASK:
            params = (float(wire.GPS_GLOBAL_ORIGIN), *(0.0,) * 6)
            self._send_command(
                wire.pack(wire.COMMAND_LONG, *params, wire.CMD_REQUEST_MESSAGE, self._system, wire.COMP_AUTOPILOT, 0)
            )
        elif action is OriginAction.SET:
            payload = self._origin.payload(self._system, t_ns)
            self._outbox.put(wire.SET_GPS_GLOBAL_ORIGIN, payload, t_ns)

    def next_deadline_ns(self) -> int:
        """When `poll` has something to do next."""
        deadlines = [self._heartbeats.t_next_ns]
        if self._dialect is not None:
            deadlines.append(self._timesync.t_next_ns)
            if self._origin.state is not OriginState.CONFIRMED:
                deadlines.append(self._origin.t_next_ns)
            retry = self._commands.next_deadline_ns()
            if retry is not None:
                deadlines.append(retry)
        return min(deadlines)

    def data_to_send(self) -> list[bytes]:
        """All that should go out now, one whole frame each, in order."""
        return self._outbox.take()

    # ------------------------------------------------------------------ what we say

    def send_odometry(self, estimate: OdometryEstimate) -> bool:
        """Put the estimate on the link as ODOMETRY. False when it was held back (see `held_back`)."""
        signs = self._signs
        signs.t_estimate_ns, signs.t_scan_ns = estimate.t_ns, estimate.t_scan_ns
        signs.quality, signs.is_degenerate = estimate.quality, estimate.is_degenerate
        if self._joined_in_flight:
            self._vision.refused["joined_in_flight"] += 1
            return False
        confirmed = self._origin.state is OriginState.CONFIRMED
        payload = self._vision.payload(estimate, self._dialect, origin_confirmed=confirmed)
        if payload is None:
            return False
        self._outbox.put(wire.ODOMETRY, payload, estimate.t_ns, wire.COMP_ESTIMATOR)
        return True

    def send_setpoint(self, setpoint: Setpoint) -> bool:
        """Put the setpoint on the link. False when nothing was sent: SILENT, the pilot flies, no autopilot yet."""
        self._signs.t_setpoint_ns = setpoint.t_ns
        if setpoint.kind is SetpointKind.SILENT or self._dialect is None:
            return False
        if self._vehicle.pilot_has_control or self._joined_in_flight:
            return False
        if self._dialect.needs_takeoff and self._waits_for_takeoff(self._dialect, setpoint):
            return False
        payload = pack_setpoint(setpoint, self._system, setpoint.t_ns // 1_000_000)
        if payload is None:
            self._tell(Severity.ERROR, "setpoint_not_finite", f"A setpoint was not finite: {setpoint.reason}")
            return False
        self.setpoints_sent += 1
        self._outbox.put(wire.SET_POSITION_TARGET_LOCAL_NED, payload, setpoint.t_ns)
        return True

    def _waits_for_takeoff(self, dialect: Dialect, setpoint: Setpoint) -> bool:
        """ArduCopter leaves the ground in GUIDED only by NAV_TAKEOFF, and a velocity would break that off: the first
        upward setpoint becomes the command, and setpoints wait until it says that it flies."""
        vehicle = self._vehicle
        on_ground = vehicle.landed_state in (LandedState.ON_GROUND, LandedState.TAKEOFF)
        if not (vehicle.is_armed and vehicle.mode is FlightMode.OFFBOARD and on_ground):
            return self._taking_off
        if not self._taking_off and float(setpoint.velocity_map_mps[2]) > _CLIMB_MPS:
            self._taking_off = True
            params = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, _TAKEOFF_HEIGHT_M)
            self._commands.request(
                wire.CMD_NAV_TAKEOFF, params, setpoint.t_ns, label="take off", then=self._on_takeoff_outcome
            )
        return self._taking_off

    def _on_takeoff_outcome(self, outcome: Outcome, t_ns: int) -> None:
        self._taking_off = outcome.accepted and self._taking_off
        self._on_request_outcome(outcome, t_ns)

    def request(self, request: VehicleRequest) -> None:
        """Ask the autopilot; how it ended comes as an Event. Arming and offboard are refused to a companion that is
        passive: the pilot took over, or it joined a vehicle in flight."""
        t_ns, kind = request.t_ns, request.kind
        dialect = self._dialect
        if dialect is None:
            self._tell(Severity.WARNING, f"{kind.value}_refused", f"{kind.value}: no autopilot known yet")
            return
        if kind in (RequestKind.ARM, RequestKind.OFFBOARD) and (
            self._joined_in_flight or self._vehicle.pilot_has_control
        ):
            self._tell(
                Severity.WARNING,
                f"{kind.value}_refused",
                f"{kind.value}: the companion is passive until the operator hands control back",
            )
            return
        if kind is RequestKind.ARM and not self._may_arm(t_ns):
            return
        command, params = wire.CMD_COMPONENT_ARM_DISARM, (float(kind is RequestKind.ARM), 0.0, 0.0)
        if kind in _MODE_OF_REQUEST:
            mode = _MODE_OF_REQUEST[kind]
            command, params = wire.CMD_DO_SET_MODE, dialect.mode_params[mode]
            self._vehicle.wanted_mode = mode
        self._commands.request(command, params, t_ns, label=kind.value, then=self._on_request_outcome)

    def _may_arm(self, t_ns: int) -> bool:
        reasons = self._reasons(t_ns)
        if not reasons:
            return True
        self._tell(Severity.WARNING, "arm_refused", "Not armed: " + "; ".join(reasons))
        return False

    def _on_request_outcome(self, outcome: Outcome, t_ns: int) -> None:
        name = outcome.label.replace(" ", "_")
        if outcome.accepted:
            self._tell(Severity.INFO, f"{name}_accepted", f"{outcome.label}: accepted")
        else:
            self._tell(Severity.WARNING, f"{name}_refused", f"{outcome.label}: {outcome.word}")

    def resume_control(self) -> None:
        """The operator hands control back after a takeover, or over a vehicle that was joined in flight."""
        self._vehicle.pilot_has_control = False
        self._joined_in_flight = False

    def send_event(self, event: Event) -> None:
        """STATUSTEXT, in chunks where it is long."""
        self._text_id = self._text_id % 65535 + 1
        for payload in pack_text(event, self._text_id):
            self._outbox.put(wire.STATUSTEXT, payload, event.t_ns)

    def send_wall_ranges(self, ranges: WallRanges, *, min_range_m: float = 0.5, max_range_m: float = 50.0) -> None:
        """OBSTACLE_DISTANCE."""
        payload = pack_obstacles(ranges, min_range_m=min_range_m, max_range_m=max_range_m)
        self._outbox.put(wire.OBSTACLE_DISTANCE, payload, ranges.t_ns)

    def send_computer_status(self, status: ComputerStatus) -> None:
        """ONBOARD_COMPUTER_STATUS."""
        self._outbox.put(wire.ONBOARD_COMPUTER_STATUS, pack_computer_status(status), status.t_ns)

    def report_scan(self, t_ns: int) -> None:
        """A scan came from the LiDAR: a sign of life, also while registration has no estimate to give."""
        self._signs.t_scan_ns = max(t_ns, self._signs.t_scan_ns or 0)

    # ------------------------------------------------------------------ what is known

    @property
    def autopilot(self) -> str | None:
        """'px4', 'ardupilot', or None before its first heartbeat."""
        return self._dialect.name if self._dialect is not None else None

    @property
    def time_synced(self) -> bool:
        return self._dialect is not None and self._timesync.missing(self._dialect.timesync_answers) is None

    @property
    def is_passive(self) -> bool:
        """The pilot has taken over, or the vehicle was already flying when we came."""
        return self._joined_in_flight or self._vehicle.pilot_has_control

    @property
    def peer(self) -> Hashable | None:
        """The address that the autopilot was first heard from."""
        return self._sources.address

    @property
    def counts(self) -> dict[str, int]:
        """What was dropped, refused and held back, by reason, since the start."""
        parts = (("frame", self._decoder.dropped), ("refused", self._sources.refused), ("vision", self._vision.refused))
        return {f"{part}.{reason}": n for part, counter in parts for reason, n in sorted(counter.items()) if n}

    def vehicle_state(self, t_ns: int) -> VehicleState:
        vehicle, dialect = self._vehicle, self._dialect
        reasons = self._reasons(t_ns)
        flags = vehicle.estimator_flags
        is_recent = vehicle.t_position_ns is not None and t_ns - vehicle.t_position_ns <= _POSITION_AGE_NS
        is_valid = is_recent and dialect is not None and flags is not None and dialect.is_position_valid(flags)
        return VehicleState(
            t_ns=t_ns,
            t_heartbeat_ns=vehicle.t_heartbeat_ns or 0,
            is_connected=vehicle.is_connected(t_ns),
            is_armed=vehicle.is_armed,
            mode=vehicle.mode,
            is_failsafe=vehicle.is_failsafe,
            landed_state=vehicle.landed_state,
            position_map_m=vehicle.position_map_m,
            velocity_map_mps=vehicle.velocity_map_mps,
            battery_ratio=vehicle.battery_ratio,
            is_position_valid=is_valid,
            is_ready_to_arm=not reasons,
            not_ready_because=reasons,
        )

    def _reasons(self, t_ns: int) -> tuple[str, ...]:
        return reasons_not_to_arm(
            dialect=self._dialect,
            vehicle=self._vehicle,
            origin=self._origin,
            timesync=self._timesync,
            vision=self._vision,
            attitude=self._attitude,
            t_ns=t_ns,
        )

    # ------------------------------------------------------------------ inside

    def _send_command(self, payload: bytes) -> None:
        self._outbox.put(wire.COMMAND_LONG, payload, self._t_ns)

    def _tell(self, severity: Severity, name: str, text: str) -> None:
        self._events.append(Event(t_ns=self._t_ns, severity=severity, name=name, text=text))

    def _take_events(self) -> list[Event]:
        events, self._events = self._events, []
        return events
