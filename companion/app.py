"""The companion as a program: the flight core, its edges, and the tasks between them. Read this first.

Two rings. In the task group: link, LiDAR, odometry, beat (estimates and setpoints); if one of them fails, the flight
controller's own failsafe acts. Under `supervise`: mapping and telemetry; they may fail and are started again, and never
end a flight. Registration runs in a thread; nothing holds up the beat.
"""

from __future__ import annotations

import asyncio
import signal
import sys
import time
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field

from companion.cadence import Cadence
from companion.flight import Flight
from companion.lidar.udp import LidarSocket, open_lidar
from companion.mavlink.link import MavlinkLink, open_link
from companion.messages import Event, LidarScan, OperatorCommand, OperatorCommandKind, Severity
from companion.odometry import ScanResult

SWITCH_INTERVAL_S = 0.001  # how long a thread may keep the interpreter from the beat
SCAN_QUEUE = 2  # topics.SCAN.queue: a late scan is worth less than the next one
MAP_QUEUE = 64
AFTER_FINISH_S = 1.0


@dataclass(slots=True)
class App:
    """One flight on real links. `run` returns when the navigator has finished, or after SIGTERM once landed."""

    flight: Flight
    connect: str
    lidar: str
    on_sent: Callable[[int, bytes], None] | None = None  # the recorder's
    telemetry: Callable[[], Awaitable[None]] | None = None
    housekeeping: Callable[[], Awaitable[None]] | None = None  # the recorder's: tells of a full disk
    scans_dropped: int = 0
    scans_unmapped: int = 0
    restarts: dict[str, int] = field(default_factory=dict)
    give_up_s: float = 10.0  # after an abort without a flight controller
    _aborted_ns: int | None = None
    cadence: Cadence = field(default_factory=Cadence)
    _scans: deque[LidarScan] = field(default_factory=lambda: deque(maxlen=SCAN_QUEUE))
    _scan_ready: asyncio.Event = field(default_factory=asyncio.Event)
    _to_map: deque[ScanResult] = field(default_factory=lambda: deque(maxlen=MAP_QUEUE))
    _map_ready: asyncio.Event = field(default_factory=asyncio.Event)
    _link: MavlinkLink | None = None

    async def run(self, ready: Callable[[], None] | None = None) -> None:
        """Raises: LinkError: a link cannot be opened (before anything is sent)."""
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        self._link = await open_link(self.connect)
        lidar = await open_lidar(self.lidar)
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, self.abort, signal.Signals(number).name.lower())
        if ready is not None:
            ready()
        try:
            async with asyncio.TaskGroup() as tasks:
                outer = [tasks.create_task(self.supervise("mapping", self._map), name="mapping")]
                for name, task in (("telemetry", self.telemetry), ("recorder", self.housekeeping)):
                    if task is not None:
                        outer.append(tasks.create_task(self.supervise(name, task), name=name))
                inner = [
                    tasks.create_task(self._receive_mavlink(self._link), name="link"),
                    tasks.create_task(self._receive_lidar(lidar), name="lidar"),
                    tasks.create_task(self._odometry(), name="odometry"),
                ]
                await tasks.create_task(self._beat(), name="beat")
                for running in (*inner, *outer):
                    running.cancel()
        finally:
            for number in (signal.SIGINT, signal.SIGTERM):
                loop.remove_signal_handler(number)
            self._link.close()
            lidar.close()
        self._drain_map()

    def abort(self, source: str) -> None:
        """Latched: zero velocity, then land. Where no flight controller is heard any more there is nothing to land."""
        now = time.monotonic_ns()
        self._aborted_ns = self._aborted_ns or now
        self.flight.on_operator(OperatorCommand(t_ns=now, kind=OperatorCommandKind.ABORT, source=source))

    async def supervise(self, name: str, task: Callable[[], Awaitable[None]]) -> None:
        """Run a task again, with back-off, whenever it fails."""
        pause_s = 0.5
        while True:
            try:
                await task()
                return
            except Exception as error:  # of the outer ring: told, counted, never the end of a flight
                self.restarts[name] = self.restarts.get(name, 0) + 1
                text = f"{name} failed and is started again: {type(error).__name__}: {error}"
                t_ns, severity = time.monotonic_ns(), Severity.WARNING
                self.flight.on_event(Event(t_ns=t_ns, severity=severity, name=f"{name}_failed", text=text))
                await asyncio.sleep(pause_s)
                pause_s = min(2 * pause_s, 10.0)

    async def _beat(self) -> None:
        """Estimates, setpoints, heartbeats at their deadlines, until the flight is finished."""
        finished_ns: int | None = None
        while finished_ns is None or time.monotonic_ns() - finished_ns < AFTER_FINISH_S * 1e9:
            deadline_ns = self.flight.next_deadline_ns()
            await asyncio.sleep(max(0.0, (deadline_ns - time.monotonic_ns()) * 1e-9))
            now_ns = time.monotonic_ns()
            overloaded = self.cadence.lag(now_ns, now_ns - deadline_ns) if deadline_ns > 0 else None
            if overloaded is not None:
                self.flight.on_event(overloaded)
            self.flight.poll(now_ns)
            self._send()
            if self.flight.is_finished and finished_ns is None:
                finished_ns = now_ns
            if self._is_in_vain(now_ns):
                return

    def _is_in_vain(self, now_ns: int) -> bool:
        """Aborted, and for a while no flight controller was heard that could be landed."""
        if self._aborted_ns is None or now_ns - self._aborted_ns < self.give_up_s * 1e9:
            return False
        return not self.flight.session.vehicle_state(now_ns).is_connected

    async def _receive_mavlink(self, link: MavlinkLink) -> None:
        while True:
            for data, t_ns, source in await link.take():
                self.flight.on_mavlink(data, t_ns, source)
            self._send()

    async def _receive_lidar(self, lidar: LidarSocket) -> None:
        while True:
            for data, t_ns, source in await lidar.take():
                for scan in self.flight.on_lidar_packet(data, t_ns, source):
                    self.scans_dropped += len(self._scans) == SCAN_QUEUE
                    self._scans.append(scan)
                    self._scan_ready.set()

    async def _odometry(self) -> None:
        while True:
            await self._scan_ready.wait()
            if not self._scans:
                self._scan_ready.clear()
                continue
            scan = self._scans.popleft()
            result = await asyncio.to_thread(self.flight.begin_scan(scan, time.monotonic_ns()))
            if self.flight.accept_scan(result, time.monotonic_ns()) and result is not None:
                self.scans_unmapped += len(self._to_map) == MAP_QUEUE
                self._to_map.append(result)
                self._map_ready.set()

    async def _map(self) -> None:
        while True:
            await self._map_ready.wait()
            self._map_ready.clear()
            await asyncio.to_thread(self._drain_map)

    def _drain_map(self) -> None:
        while self._to_map:
            result = self._to_map.popleft()
            self.flight.mapper.add(result.levelled, result.estimate)

    def _send(self) -> None:
        assert self._link is not None
        for frame in self.flight.take_output():
            self._link.send(frame)
            now = time.monotonic_ns()
            self.cadence.sent(frame, now)
            if self.on_sent is not None:
                self.on_sent(now, frame)
