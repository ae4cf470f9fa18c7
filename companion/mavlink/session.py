"""The companion's end of the MAVLink conversation, sans-IO: bytes and times in, messages and bytes out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable

from companion.config import MavlinkConfig
from companion.mavlink import wire
from companion.mavlink.arming import reasons_not_to_arm
from companion.mavlink.codec import Decoder
from companion.mavlink.commands import Commands, Outcome
from companion.mavlink.computer import ComputerStatus, pack_computer_status
from companion.mavlink.hearing import Hearing
from companion.mavlink.heartbeats import Heartbeats, SignsOfLife
from companion.mavlink.journal import Journal
from companion.mavlink.origin import Origin, OriginAction, OriginState
from companion.mavlink.outbox import Outbox
from companion.mavlink.parameters import Parameters
from companion.mavlink.px4 import PX4
from companion.mavlink.setpoints import pack_obstacles, pack_setpoint
from companion.mavlink.signing import Signer
from companion.mavlink.sources import Sources
from companion.mavlink.takeoff import Takeoff
from companion.mavlink.texts import pack_text
from companion.mavlink.vision import Vision
from companion.messages import (
    AttitudeSample,
    Event,
    FlightMode,
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

_MODE_OF_REQUEST = {
    RequestKind.OFFBOARD: FlightMode.OFFBOARD,
    RequestKind.LAND: FlightMode.LAND,
    RequestKind.HOLD: FlightMode.HOLD,
}
_NEEDS_CONTROL = (RequestKind.ARM, RequestKind.OFFBOARD)
_POSITION_AGE_NS = 1_000_000_000
_MAX_SENDERS = 16


class MavlinkSession:
    """One autopilot, heard and spoken to: `receive` what the link brings, `poll` at `next_deadline_ns`, put
    `data_to_send` on the link after each. Events of any call come out of the next `receive` or `take_events`.

    Args:
        signer: signs what leaves and checks what comes; None: unsigned.
    """

    def __init__(self, cfg: MavlinkConfig, *, signer: Signer | None = None) -> None:
        self._system = cfg.system_id
        self._frames_dropped: Counter[str] = Counter()
        self._decoders: dict[Hashable | None, Decoder] = {}
        self._signer = signer
        self._outbox = Outbox(cfg.system_id, signer)
        self._sources = Sources(cfg.system_id)
        self._journal = Journal()
        self._heartbeats = Heartbeats()
        self._signs = SignsOfLife()
        self._commands = Commands(self._send_command, cfg.system_id)
        self._takeoff = Takeoff(self._commands)
        self._parameters = Parameters(self._ask_parameter, cfg.system_id)
        self._vision = Vision()
        self._hearing = Hearing(
            self._outbox,
            self._commands,
            Origin(round(cfg.origin_latitude_deg * 1e7), round(cfg.origin_longitude_deg * 1e7)),
            self._journal,
            self._parameters,
            on_begin=self._on_begin,
            dropped=self._sources.drop,
        )
        self._text_id = 0
        self.setpoints_sent = 0

    def _on_begin(self) -> None:
        self._vision.restart()
        self._takeoff.restart()

    # ---- in ---------------------------------------------------------------------------------------------------------

    def receive(self, data: bytes, t_ns: int, source: Hashable | None = None) -> list[Received]:
        """Take in bytes that came at `t_ns` from `source` (an address; None where the link has only one end)."""
        self._journal.t_ns = t_ns
        out: list[Received] = []
        changed = False
        for frame in self._decoder(source).receive(data):
            reason = self._signer.refusal(frame, t_ns) if self._signer is not None else None
            reason = reason or self._sources.judge(frame, source)
            if reason is not None:
                self._journal.add(self._sources.refuse(reason, frame, source, t_ns))
                continue
            sample = self._hearing.hear(frame, t_ns)
            if sample is not None:
                out.append(sample)
            changed = changed or frame.msg_id == wire.HEARTBEAT
        events = self._journal.take()
        out.extend(events)
        if changed or events:
            out.append(self.vehicle_state(t_ns))
        return out

    def _decoder(self, source: Hashable | None) -> Decoder:
        """One for each sender: half a frame of a stranger must not hold up the autopilot's."""
        decoder = self._decoders.get(source)
        if decoder is None:
            if len(self._decoders) >= _MAX_SENDERS:
                self._decoders.clear()
            decoder = self._decoders[source] = Decoder(self._frames_dropped)
        return decoder

    def poll(self, t_ns: int) -> None:
        """Do what is due: heartbeats, time sync, origin, retries, the watch over the link."""
        self._journal.t_ns = t_ns
        vehicle, timesync = self._hearing.vehicle, self._hearing.timesync
        self._signs.is_flying_offboard = vehicle.is_armed and vehicle.mode is FlightMode.OFFBOARD
        for component, payload in self._heartbeats.poll(self._signs, t_ns):
            self._outbox.put(wire.HEARTBEAT, payload, t_ns, component)
        self._journal.add(vehicle.link_events(t_ns))
        if vehicle.t_heartbeat_ns is not None and not vehicle.is_connected(t_ns):
            self._sources.release()
        if self._hearing.dialect is None:
            return
        if t_ns >= timesync.t_next_ns:
            self._outbox.put(wire.TIMESYNC, wire.pack(wire.TIMESYNC, *timesync.ask(t_ns)), t_ns)
        self._poll_origin(t_ns)
        self._commands.poll(t_ns)
        self._parameters.poll(t_ns)

    def _poll_origin(self, t_ns: int) -> None:
        vehicle, dialect, origin = self._hearing.vehicle, self._hearing.dialect, self._hearing.origin
        if dialect is None or vehicle.t_heartbeat_ns is None:
            return
        flags = vehicle.estimator_flags
        may_set = not vehicle.is_armed and flags is not None
        if dialect is PX4 and flags is not None and dialect.is_position_valid(flags):
            may_set = False  # an origin set while vision is fused throws the local position away (PX4.md, 6)
        action = origin.poll(t_ns, may_set=may_set)
        if action is OriginAction.ASK:
            params = (float(wire.GPS_GLOBAL_ORIGIN), *(0.0,) * 6)
            fields = (wire.CMD_REQUEST_MESSAGE, self._system, wire.COMP_AUTOPILOT, 0)
            self._send_command(wire.pack(wire.COMMAND_LONG, *params, *fields))
        elif action is OriginAction.SET:
            self._outbox.put(wire.SET_GPS_GLOBAL_ORIGIN, origin.payload(self._system, t_ns), t_ns)

    def next_deadline_ns(self) -> int:
        """When `poll` has something to do next."""
        hearing = self._hearing
        deadline = self._heartbeats.t_next_ns
        if hearing.dialect is None:
            return deadline
        deadline = min(deadline, hearing.timesync.t_next_ns)
        if hearing.origin.state is not OriginState.CONFIRMED:
            deadline = min(deadline, hearing.origin.t_next_ns)
        retry = self._commands.next_deadline_ns()
        if retry is not None:
            deadline = min(deadline, retry)
        again = self._parameters.next_deadline_ns(self._journal.t_ns)
        return deadline if again is None else min(deadline, again)

    def take_events(self) -> list[Event]:
        """Events that no `receive` has brought out yet: when the link is silent there is none."""
        return self._journal.take()

    # ---- out --------------------------------------------------------------------------------------------------------

    def data_to_send(self) -> list[bytes]:
        """All that should go out now, one whole frame each, in order."""
        return self._outbox.take()

    def send_odometry(self, estimate: OdometryEstimate) -> bool:
        """Put the estimate on the link as ODOMETRY. False when it was held back, by a reason in `counts`."""
        self._signs.note_estimate(estimate)
        if self._hearing.vehicle.joined_in_flight:
            self._vision.refused["joined_in_flight"] += 1
            return False
        confirmed = self._hearing.origin.state is OriginState.CONFIRMED
        payload = self._vision.payload(estimate, self._hearing.dialect, origin_confirmed=confirmed)
        if payload is None:
            return False
        self._outbox.put(wire.ODOMETRY, payload, estimate.t_ns, wire.COMP_ESTIMATOR)
        return True

    def send_setpoint(self, setpoint: Setpoint) -> bool:
        """Put the setpoint on the link. False when nothing was sent: SILENT, the pilot flies, no autopilot yet."""
        self._signs.t_setpoint_ns = setpoint.t_ns
        dialect = self._hearing.dialect
        if setpoint.kind is SetpointKind.SILENT or dialect is None or self.is_passive:
            return False
        if dialect.needs_takeoff and self._takeoff.holds_back(self._hearing.vehicle, setpoint):
            return False
        payload = pack_setpoint(setpoint, self._system, setpoint.t_ns // 1_000_000)
        if payload is None:
            self._journal.tell(Severity.ERROR, "setpoint_not_finite", f"A setpoint was not finite: {setpoint.reason}")
            return False
        self.setpoints_sent += 1
        self._outbox.put(wire.SET_POSITION_TARGET_LOCAL_NED, payload, setpoint.t_ns)
        return True

    def request(self, request: VehicleRequest) -> None:
        """Ask the autopilot; how it ended comes as an event `<kind>_accepted` or `<kind>_refused`. Arming must pass
        the gate; arming and offboard are refused while passive."""
        t_ns, kind = request.t_ns, request.kind
        self._journal.t_ns = max(self._journal.t_ns, t_ns)
        dialect = self._hearing.dialect
        if dialect is None:
            self._refuse(kind, "no autopilot known yet")
            return
        if kind in _NEEDS_CONTROL and self.is_passive:
            self._refuse(kind, "the companion is passive until the operator hands control back")
            return
        reasons = self._reasons(t_ns) if kind is RequestKind.ARM else ()
        if reasons:
            self._refuse(kind, "; ".join(reasons))
            return
        command, params = wire.CMD_COMPONENT_ARM_DISARM, (float(kind is RequestKind.ARM), 0.0, 0.0)
        mode = _MODE_OF_REQUEST.get(kind)
        if mode is not None:
            command, params = wire.CMD_DO_SET_MODE, dialect.mode_params[mode]
            self._hearing.vehicle.wanted_mode = mode
        if not self._commands.is_waiting(command, kind.value):
            self._commands.request(command, params, t_ns, label=kind.value, then=self._on_outcome)

    def _on_outcome(self, outcome: Outcome, t_ns: int) -> None:
        if outcome.accepted:
            self._journal.tell(Severity.INFO, f"{outcome.label}_accepted", f"{outcome.label}: accepted")
        else:
            self._journal.tell(Severity.WARNING, f"{outcome.label}_refused", f"{outcome.label}: {outcome.word}")

    def _refuse(self, kind: RequestKind, why: str) -> None:
        self._journal.tell(Severity.WARNING, f"{kind.value}_refused", f"{kind.value}: {why}")

    def resume_control(self) -> None:
        """The operator hands control back after a takeover, or over a vehicle that was joined in flight."""
        self._hearing.vehicle.pilot_has_control = False
        self._hearing.vehicle.joined_in_flight = False

    def send_event(self, event: Event) -> None:
        """STATUSTEXT, in chunks where it is long. What the autopilot said itself is not sent back to it."""
        if event.name in ("autopilot_text", "autopilot_event"):
            return
        self._text_id = self._text_id % 65535 + 1
        for payload in pack_text(event, self._text_id):
            self._outbox.put(wire.STATUSTEXT, payload, event.t_ns)

    def send_wall_ranges(self, ranges: WallRanges, *, min_range_m: float = 0.5, max_range_m: float = 50.0) -> None:
        """OBSTACLE_DISTANCE. Also a sign of life of the scan it came from."""
        self._signs.note_scan(ranges.t_ns)
        payload = pack_obstacles(ranges, min_range_m=min_range_m, max_range_m=max_range_m)
        self._outbox.put(wire.OBSTACLE_DISTANCE, payload, ranges.t_ns)

    def send_computer_status(self, status: ComputerStatus) -> None:
        """ONBOARD_COMPUTER_STATUS."""
        self._outbox.put(wire.ONBOARD_COMPUTER_STATUS, pack_computer_status(status), status.t_ns)

    # ---- what is known ----------------------------------------------------------------------------------------------

    @property
    def autopilot(self) -> str | None:
        """'px4', 'ardupilot', or None before its first heartbeat."""
        return self._hearing.dialect.name if self._hearing.dialect is not None else None

    @property
    def time_synced(self) -> bool:
        dialect = self._hearing.dialect
        return dialect is not None and self._hearing.timesync.missing(dialect.timesync_answers) is None

    @property
    def is_armed(self) -> bool:
        return self._hearing.vehicle.is_armed

    @property
    def is_passive(self) -> bool:
        """The pilot has taken over, or the vehicle was already flying when we came."""
        return self._hearing.vehicle.joined_in_flight or self._hearing.vehicle.pilot_has_control

    @property
    def peer(self) -> Hashable | None:
        """The address that the autopilot was first heard from."""
        return self._sources.address

    @property
    def counts(self) -> dict[str, int]:
        """What was dropped, refused and held back since the start, by reason."""
        parts = (("frame", self._frames_dropped), ("refused", self._sources.refused), ("vision", self._vision.refused))
        return {f"{part}.{reason}": n for part, counter in parts for reason, n in sorted(counter.items()) if n}

    def vehicle_state(self, t_ns: int) -> VehicleState:
        vehicle, dialect = self._hearing.vehicle, self._hearing.dialect
        reasons = self._reasons(t_ns)
        flags = vehicle.estimator_flags
        is_recent = vehicle.t_position_ns is not None and t_ns - vehicle.t_position_ns <= _POSITION_AGE_NS
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
            is_position_valid=is_recent
            and dialect is not None
            and flags is not None
            and dialect.is_position_valid(flags),
            is_ready_to_arm=not reasons,
            not_ready_because=reasons,
            is_vision_fused=dialect is None or flags is None or dialect.is_vision_fused(flags),
        )

    def _reasons(self, t_ns: int) -> tuple[str, ...]:
        return reasons_not_to_arm(
            dialect=self._hearing.dialect,
            vehicle=self._hearing.vehicle,
            origin=self._hearing.origin,
            timesync=self._hearing.timesync,
            vision=self._vision,
            attitude=self._hearing.attitude,
            parameters=self._parameters,
            t_ns=t_ns,
        )

    def _ask_parameter(self, payload: bytes) -> None:
        self._outbox.put(wire.PARAM_REQUEST_READ, payload, self._journal.t_ns)

    def _send_command(self, payload: bytes) -> None:
        self._outbox.put(wire.COMMAND_LONG, payload, self._journal.t_ns)
