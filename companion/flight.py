"""All of the companion that flies, without tasks, sockets or clocks: bytes and times in, bytes out.

The app on the vehicle, the lockstep runner and replay call the same methods; they differ only in who carries the bytes.
A scan is processed in three steps, so that the heavy one can run off the event loop: `on_lidar_packet` hands out whole
scans, `begin_scan` freezes what is known and gives the heavy step to run (one at a time, anywhere), `accept_scan` takes
its result in. Every call that changes anything is told to `record` first, in order: replay makes the same calls again.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field

from companion import topics
from companion.config import CompanionConfig
from companion.lidar.ouster import OusterDecoder
from companion.mapping import Mapper
from companion.mavlink.arming import in_words
from companion.mavlink.checks import Facts, check_computer
from companion.mavlink.computer import ComputerStatus
from companion.mavlink.session import MavlinkSession
from companion.mavlink.signing import Signer
from companion.messages import (
    AttitudeSample,
    Event,
    LidarScan,
    OdometryEstimate,
    OperatorCommand,
    OperatorCommandKind,
    PointMap,
    RangefinderSample,
    Setpoint,
    SetpointKind,
    Severity,
    VehicleState,
    VolumeReport,
    WallRanges,
)
from companion.navigator import Navigator, NavigatorInput, NavigatorOutput
from companion.navigator.guard import Guard, GuardInput
from companion.odometry import Odometry, ScanResult
from companion.odometry.tilt import LEANS_EVENT, MOST_TILT_RAD, mount_warnings
from companion.odometry.turned import NOT_KNOWN, TurnedBy

Tap = Callable[[topics.Topic, int, object], None]
Source = tuple[str, int] | None
Record = Callable[[str, int, bytes, Source], None]  # kind: lidar, mavlink, operator, poll, begin, accept


def _no_tap(topic: topics.Topic, t_ns: int, message: object) -> None:
    """Nobody listens."""


def _no_record(kind: str, t_ns: int, payload: bytes, source: Source) -> None:
    """Nothing is recorded."""


@dataclass(slots=True)
class _Beat:
    """A deadline that comes again each period, without drift; late beats are not made up for."""

    period_ns: int
    next_ns: int = 0

    def due(self, t_ns: int) -> bool:
        if t_ns < self.next_ns:
            return False
        self.next_ns += self.period_ns
        if self.next_ns <= t_ns:
            self.next_ns = t_ns + self.period_ns
        return True


@dataclass(slots=True)
class Flight:
    """One flight of one vehicle. Raises nothing on bad input: it is dropped and counted where it arrives."""

    config: CompanionConfig
    lidar_metadata_json: str | None = None
    tap: Tap = _no_tap
    record: Record = _no_record
    signer: Signer | None = None
    decoder: OusterDecoder = field(init=False)
    session: MavlinkSession = field(init=False)
    odometry: Odometry = field(init=False)
    navigator: Navigator = field(init=False)
    guard: Guard = field(init=False)
    mapper: Mapper = field(init=False)
    walls: WallRanges | None = field(init=False, default=None)
    estimate: OdometryEstimate | None = field(init=False, default=None)
    navigation: NavigatorOutput | None = field(init=False, default=None)
    keyframes: list[OdometryEstimate] = field(init=False, default_factory=list)
    events: list[Event] = field(init=False, default_factory=list)
    scans: int = field(init=False, default=0)
    odometry_max_gap_s: float = field(init=False, default=0.0)
    _commands: list[OperatorCommand] = field(init=False, default_factory=list)
    lidar_turned_by: TurnedBy = field(init=False, default=NOT_KNOWN)
    _has_told_turned: bool = field(init=False, default=False)
    _leans: bool = field(init=False, default=False)  # by more than can be corrected, at some time
    _mapped_ns: int | None = field(init=False, default=None)
    _judged: OdometryEstimate | None = field(init=False, default=None)
    _below_m: float | None = field(init=False, default=None)
    _sent: Setpoint | None = field(init=False, default=None)
    _computer_not_ready: tuple[str, ...] = field(init=False, default=())
    _sent_odometry_ns: int | None = field(init=False, default=None)
    _resets_at_loss: int | None = field(init=False, default=None)
    _odometry_beat: _Beat = field(init=False)
    _setpoint_beat: _Beat = field(init=False)

    def __post_init__(self) -> None:
        config = self.config
        if self.lidar_metadata_json is not None:
            self.decoder = OusterDecoder(self.lidar_metadata_json)
        else:
            self.decoder = OusterDecoder.from_config(config.lidar)
        self.session = MavlinkSession(config.mavlink, signer=self.signer)
        self.odometry = Odometry(config)
        self.navigator = Navigator(config)
        self.guard = Guard(config)
        self.mapper = Mapper(config)
        self._odometry_beat = _Beat(round(1e9 / config.mavlink.odometry_rate_hz))
        self._setpoint_beat = _Beat(round(1e9 / config.mavlink.setpoint_rate_hz))

    # ---- in ---------------------------------------------------------------------------------------------------------

    def on_lidar_packet(self, data: bytes, t_ns: int, source: Source = None) -> list[LidarScan]:
        """Scans that this packet completed, in order: each goes to `begin_scan`."""
        self.record("lidar", t_ns, data, source)
        return self.decoder.receive(data, t_ns, source)

    def on_mavlink(self, data: bytes, t_ns: int, source: Source = None) -> None:
        self.record("mavlink", t_ns, data, source)
        for message in self.session.receive(data, t_ns, source):
            if isinstance(message, AttitudeSample):
                self.odometry.on_attitude(message)
                self.tap(topics.ATTITUDE, t_ns, message)
            elif isinstance(message, RangefinderSample):
                self._below_m = message.distance_m
                self.odometry.on_rangefinder(message)
                self.tap(topics.RANGEFINDER, t_ns, message)
            elif isinstance(message, Event):
                self.tell(message)
            elif isinstance(message, OperatorCommand):
                self.on_operator(message)

    def on_operator(self, command: OperatorCommand) -> None:
        self.record("operator", command.t_ns, f"{command.kind.value} {command.source}".encode(), None)
        self._commands.append(command)
        if command.kind is OperatorCommandKind.RESUME:
            self.session.resume_control()
        self.tap(topics.OPERATOR, command.t_ns, command)

    def begin_scan(self, scan: LidarScan, t_ns: int) -> Callable[[], ScanResult | None]:
        """The heavy step: level, deskew, register. May run in a thread; one scan at a time. None: nothing to use."""
        self.record("begin", t_ns, b"", None)
        return self.odometry.begin(scan)

    def accept_scan(self, result: ScanResult | None, t_ns: int) -> bool:
        """Take a registered scan in. True if it belongs in the map: then `mapper.add` it, where it holds up nothing."""
        self.record("accept", t_ns, b"", None)
        self.scans += 1
        self.odometry.publish()
        if result is None:
            return False
        estimate = result.estimate
        self._note_quality(estimate)
        self._note_mount(result)
        self.estimate = estimate
        self.walls = result.wall_ranges
        self.session.send_wall_ranges(result.wall_ranges)
        self.tap(topics.WALLS, t_ns, result.wall_ranges)
        self.tap(topics.LEVELLED, t_ns, result.levelled)
        if estimate.is_keyframe:
            self.keyframes.append(estimate)
            self.tap(topics.KEYFRAME, t_ns, estimate)
        return self.belongs_in_map(estimate)

    def poll(self, t_ns: int) -> None:
        """Do what is due: estimates, setpoints, heartbeats. Call at `next_deadline_ns`, or more often."""
        self.record("poll", t_ns, b"", None)
        self.session.poll(t_ns)
        for event in self.session.take_events():
            self.tell(event)
        if self._odometry_beat.due(t_ns):
            estimate = self.odometry.predict(t_ns)
            if estimate is not None:
                self.estimate = estimate
                if not self.guard.is_silent and not self._is_jump_in_blind_landing(estimate):
                    self._send_odometry(estimate, t_ns)
                self.tap(topics.ESTIMATE, t_ns, estimate)
        if self._setpoint_beat.due(t_ns):
            self._navigate(t_ns)

    def on_event(self, event: Event) -> None:
        """An event from outside the core: the recorder's disk is full, a task failed, a beat came late."""
        told = {"severity": int(event.severity), "name": event.name, "text": event.text}
        self.record("told", event.t_ns, json.dumps(told).encode(), None)
        self.tell(event)

    def on_computer(self, status: ComputerStatus) -> None:
        """How the companion's computer fares: the ground station hears it."""
        self.record("told", status.t_ns, json.dumps(dataclasses.asdict(status)).encode(), None)
        self.session.send_computer_status(status)
        free_gib = (status.disk_total_mib - status.disk_used_mib) / 1024
        reserve_gib = self.config.recording.reserve_gib if self.config.recording.enabled else -1.0
        checks = check_computer(Facts(autopilot=None, disk_free_gib=free_gib, disk_reserve_gib=reserve_gib))
        self._computer_not_ready = in_words(checks)

    def on_told(self, payload: bytes, t_ns: int) -> None:
        """What `on_event` or `on_computer` recorded, again."""
        told = json.loads(payload)
        if "name" in told:
            self.on_event(Event(t_ns=t_ns, severity=Severity(told["severity"]), name=told["name"], text=told["text"]))
        else:
            self.on_computer(ComputerStatus(**{**told, "cpu_core_ratios": tuple(told["cpu_core_ratios"])}))

    # ---- out --------------------------------------------------------------------------------------------------------

    def take_output(self) -> list[bytes]:
        """MAVLink frames to send to the flight controller, in order."""
        return self.session.data_to_send()

    def next_deadline_ns(self) -> int:
        return min(self._odometry_beat.next_ns, self._setpoint_beat.next_ns, self.session.next_deadline_ns())

    @property
    def is_finished(self) -> bool:
        return self.navigation is not None and self.navigation.finished

    def measure(self, point_map: PointMap | None = None) -> VolumeReport:
        """The volume from the map so far: seconds of work. point_map: where the caller has it already."""
        from companion.volume import estimate_volume  # not before: what it needs of scipy takes a second to load

        cut_short = self.navigation is not None and not self.navigation.lap_closed
        if point_map is None:
            point_map = self.mapper.point_map()
        report = estimate_volume(point_map, self.config.volume, is_cut_short=cut_short)
        said = mount_warnings(self.lidar_turned_by, leans=self._leans)
        return dataclasses.replace(report, warnings=(*report.warnings, *said))

    # ---- within -----------------------------------------------------------------------------------------------------

    def _send_odometry(self, estimate: OdometryEstimate, t_ns: int) -> None:
        if not self.session.send_odometry(estimate):
            return
        if self._sent_odometry_ns is not None and self.session.is_armed:
            self.odometry_max_gap_s = max(self.odometry_max_gap_s, (t_ns - self._sent_odometry_ns) * 1e-9)
        self._sent_odometry_ns = t_ns

    def _is_jump_in_blind_landing(self, estimate: OdometryEstimate) -> bool:
        """Whether a place was found anew after the landing for want of one had begun. It is not told: if it is false, the
        flight controller flies after it (in a hall of 120 m, at 18 m/s into the end wall); without vision it comes down."""
        if self.navigation is None or not self.navigation.lands_blind:
            self._resets_at_loss = None
            return False
        if self._resets_at_loss is None:
            self._resets_at_loss = estimate.reset_counter
        return estimate.reset_counter != self._resets_at_loss

    def _navigate(self, t_ns: int) -> None:
        state: VehicleState = self.session.vehicle_state(t_ns)
        self.tap(topics.VEHICLE, t_ns, state)
        commands, self._commands = tuple(self._commands), []
        output = self.navigator.step(
            t_ns,
            NavigatorInput(
                estimate=self.estimate,
                walls=self.walls,
                vehicle=state,
                commands=commands,
                time_synced=self.session.time_synced,
                not_ready_because=self._computer_not_ready,
                sent=self._sent,
            ),
        )
        self.navigation = output
        verdict = self.guard.check(
            output.setpoint, t_ns,
            GuardInput(
                estimate=self.estimate, walls=self.walls, vehicle=state, commands=commands, below_m=self._below_m
            ),
        )  # fmt: skip
        for request in (*output.requests, *verdict.requests):
            self.session.request(request)
            self.tap(topics.REQUEST, t_ns, request)
        for event in (*output.events, *verdict.events):
            self.tell(event)
        if output.setpoint is not None:
            self.tap(topics.WANTED, t_ns, output.setpoint)
        setpoint, self._sent = verdict.setpoint, None
        if setpoint is not None and setpoint.kind is not SetpointKind.SILENT:
            self._sent = setpoint if self.session.send_setpoint(setpoint) else None
            self.tap(topics.SETPOINT, t_ns, setpoint)

    def _note_quality(self, estimate: OdometryEstimate) -> None:
        """Tell when odometry fails, comes back, jumps, or begins or ceases to be degenerate."""
        before, t_ns = self._judged, estimate.t_scan_ns
        self._judged = estimate
        if before is None:
            return
        if (estimate.quality < 0) != (before.quality < 0):
            failed = estimate.quality < 0
            text = "Odometry lost: scans no longer fit the map" if failed else "Odometry is back"
            severity = Severity.CRITICAL if failed else Severity.NOTICE
            self.tell(
                Event(t_ns=t_ns, severity=severity, name="odometry_lost" if failed else "odometry_back", text=text)
            )
        if estimate.reset_counter != before.reset_counter:
            text = "Odometry found its place in the map again: the estimate jumps"
            self.tell(Event(t_ns=t_ns, severity=Severity.WARNING, name="odometry_reset", text=text))
        if estimate.is_degenerate != before.is_degenerate:
            weak = estimate.is_degenerate
            text = (
                "Geometry is degenerate: position is weak along one axis"
                if weak
                else "Geometry holds in all axes again"
            )
            name = "degenerate" if weak else "no_longer_degenerate"
            self.tell(Event(t_ns=t_ns, severity=Severity.WARNING if weak else Severity.INFO, name=name, text=text))

    def _note_mount(self, result: ScanResult) -> None:
        """Tell, once, that the LiDAR does not sit as its mount says."""
        turned_by, t_ns = result.lidar_turned_by, result.estimate.t_scan_ns
        self.lidar_turned_by = turned_by
        if max(map(abs, result.tilt_offset_rad)) >= MOST_TILT_RAD and not self._leans:
            self._leans = True
            text = f"LiDAR leans {math.degrees(MOST_TILT_RAD):g} deg or more: check its mount"
            self.tell(Event(t_ns=t_ns, severity=Severity.CRITICAL, name=LEANS_EVENT, text=text))
        if turned_by.is_sure and not self._has_told_turned:
            self._has_told_turned = True
            text = f"LiDAR is turned by {math.degrees(turned_by.angle_rad):+.1f} deg about the vertical"
            self.tell(Event(t_ns=t_ns, severity=Severity.WARNING, name="lidar_turned", text=text))

    def belongs_in_map(self, estimate: OdometryEstimate) -> bool:
        """Whether the scan of an estimate goes into the map; asked once of each, in order."""
        if estimate.quality <= 0 or not estimate.converged:
            return False
        period_ns = round(self.config.mapping.scan_period_s * 1e9)
        due = self._mapped_ns is None or estimate.t_scan_ns - self._mapped_ns >= period_ns
        if due or estimate.is_keyframe:
            self._mapped_ns = estimate.t_scan_ns
            return True
        return False

    def tell(self, event: Event) -> None:
        """Say it to whoever listens: ground station, recorder, telemetry."""
        self.events.append(event)
        self.session.send_event(event)
        self.tap(topics.EVENT, event.t_ns, event)
