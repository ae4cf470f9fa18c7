"""simbridge and companion in one process, step by step: only bytes cross between them, and one seed gives one result."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from companion.flight import Flight
from companion.geometry import yaw_from_quat
from companion.messages import LidarScan, OdometryEstimate, OperatorCommand, OperatorCommandKind
from companion.odometry import ScanResult
from simbridge.loop import Simulation
from stockpilot.score import TruthLog

# The companion's monotonic clock is not the flight controller's, nor the LiDAR's: keep them apart, as on a vehicle.
COMPANION_CLOCK_AHEAD_NS = 77_123_456_789
TRUTH_PERIOD_NS = 20_000_000
AFTER_FINISH_NS = 500_000_000
STRAIGHT_YAW_RATE_RADPS = np.radians(3.0)

Progress = Callable[["Lockstep"], None]


class Wire(Protocol):
    """Carries MAVLink frames between companion and flight controller; times are the simulation's."""

    def take(self, t_ns: int) -> list[bytes]:
        """Frames from the flight controller that have arrived."""

    def send(self, frames: list[bytes], t_ns: int) -> None:
        """Frames to the flight controller; called each step, also with none."""


@dataclass(slots=True)
class Outcome:
    """How a flight ended and what is needed to score it."""

    state: str
    reason: str
    truth: TruthLog
    flight_time_s: float
    wall_time_s: float
    simulated_s: float
    estimates: list[OdometryEstimate]
    keyframe_scans: list[tuple[LidarScan, ScanResult]]
    mapped_scans: list[ScanResult]
    crossed_sha256: str
    odometry_max_gap_s: float


@dataclass(slots=True)
class Lockstep:
    """Steps both sides until the flight ends. Nothing but bytes is passed between `simulation` and `flight`."""

    simulation: Simulation
    wire: Wire
    flight: Flight
    max_simulated_s: float = 3600.0
    keep_scans: bool = True
    on_output: Callable[[int, bytes], None] | None = None  # the recorder's: frames to the flight controller
    _digest: hashlib._Hash = field(init=False, default_factory=hashlib.sha256)
    _truth: list[tuple[int, float, float, float, float, bool]] = field(init=False, default_factory=list)
    _keyframe_scans: list[tuple[LidarScan, ScanResult]] = field(init=False, default_factory=list)
    _mapped_scans: list[ScanResult] = field(init=False, default_factory=list)
    _estimates: list[OdometryEstimate] = field(init=False, default_factory=list)
    _took_off_ns: int | None = field(init=False, default=None)
    _landed_ns: int | None = field(init=False, default=None)
    _finished_ns: int | None = field(init=False, default=None)

    @property
    def t_ns(self) -> int:
        """Companion time."""
        return self.simulation.t_ns + COMPANION_CLOCK_AHEAD_NS

    @property
    def crossed_sha256(self) -> str:
        """Of every packet and frame that crossed so far, both ways, in order."""
        return self._digest.hexdigest()

    def abort(self, source: str) -> None:
        """What SIGTERM does to the companion in flight: land."""
        self.flight.on_operator(OperatorCommand(t_ns=self.t_ns, kind=OperatorCommandKind.ABORT, source=source))

    def step(self) -> None:
        """4 ms of both sides."""
        simulation, flight = self.simulation, self.flight
        simulation.step()
        t_ns = self.t_ns
        for packet in simulation.take_lidar_packets():
            self._digest.update(packet)
            for scan in flight.on_lidar_packet(packet, t_ns):
                self._take_scan(scan, flight.begin_scan(scan, t_ns)(), t_ns)
        for frame in self.wire.take(simulation.t_ns):
            self._digest.update(frame)
            flight.on_mavlink(frame, t_ns)
        if t_ns >= flight.next_deadline_ns():
            flight.poll(t_ns)
        frames = flight.take_output()
        for frame in frames:
            self._digest.update(frame)
            if self.on_output is not None:
                self.on_output(t_ns, frame)
        self.wire.send(frames, simulation.t_ns)
        if simulation.t_ns % TRUTH_PERIOD_NS == 0:
            self._log_truth(t_ns)

    def run(self, progress: Progress | None = None) -> Outcome:
        """Until landed, crashed or out of time."""
        began = time.perf_counter()
        began_ns = self.simulation.t_ns
        state, reason = "", ""
        steps = 0
        while not state:
            self.step()
            steps += 1
            state, reason = self._ended(began_ns)
            if progress is not None and steps % 250 == 0:
                progress(self)
        return Outcome(
            state=state,
            reason=reason,
            truth=self._truth_log(),
            flight_time_s=self._flight_time_s(),
            wall_time_s=time.perf_counter() - began,
            simulated_s=(self.simulation.t_ns - began_ns) * 1e-9,
            estimates=self._estimates,
            keyframe_scans=self._keyframe_scans,
            mapped_scans=self._mapped_scans,
            crossed_sha256=self.crossed_sha256,
            odometry_max_gap_s=self.flight.odometry_max_gap_s,
        )

    def _take_scan(self, scan: LidarScan, result: ScanResult | None, t_ns: int) -> None:
        belongs = self.flight.accept_scan(result, t_ns)
        if result is None:
            return
        if belongs:
            self.flight.mapper.add(result.levelled, result.estimate)
        if self.keep_scans:
            self._estimates.append(result.estimate)
            if result.estimate.is_keyframe:
                self._keyframe_scans.append((scan, result))
            if belongs:
                self._mapped_scans.append(result)

    def _ended(self, began_ns: int) -> tuple[str, str]:
        simulation, flight = self.simulation, self.flight
        if simulation.collision:
            return "collision", f"the vehicle touched something at {self._where()}"
        navigation = flight.navigation
        if flight.is_finished and navigation is not None:
            if self._finished_ns is None:
                self._finished_ns = simulation.t_ns
            if simulation.t_ns - self._finished_ns >= AFTER_FINISH_NS:
                return navigation.outcome, navigation.reason
        if simulation.t_ns - began_ns > self.max_simulated_s * 1e9:
            phase = navigation.state.value if navigation is not None else "start"
            return "timeout", f"not landed after {self.max_simulated_s:g} s, in state {phase}"
        return "", ""

    def _where(self) -> str:
        p = self.simulation.truth().position_world_m
        return f"({p[0]:.1f}, {p[1]:.1f}, {p[2]:.1f})"

    def _log_truth(self, t_ns: int) -> None:
        truth = self.simulation.truth()
        p = truth.position_world_m
        flying = float(p[2]) > 0.5
        if flying and self._took_off_ns is None:
            self._took_off_ns = t_ns
        if self._took_off_ns is not None and flying:
            self._landed_ns = t_ns
        rate = float(truth.rate_body_radps[2])
        navigation = self.flight.navigation
        straight = navigation is not None and navigation.is_straight and abs(rate) < STRAIGHT_YAW_RATE_RADPS
        yaw = yaw_from_quat(truth.q_world_body_wxyz)
        self._truth.append((t_ns, float(p[0]), float(p[1]), float(p[2]), yaw, straight))

    def _truth_log(self) -> TruthLog:
        rows = self._truth
        return TruthLog(
            t_ns=np.array([r[0] for r in rows], dtype=np.int64),
            position_world_m=np.array([r[1:4] for r in rows], dtype=np.float64).reshape(-1, 3),
            yaw_rad=np.unwrap(np.array([r[4] for r in rows], dtype=np.float64)),
            is_following=np.array([r[5] for r in rows], dtype=np.bool_),
        )

    def _flight_time_s(self) -> float:
        if self._took_off_ns is None or self._landed_ns is None:
            return 0.0
        return (self._landed_ns - self._took_off_ns) * 1e-9
