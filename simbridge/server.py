"""The world on the wire, in real time: MAVLink over UDP, LiDAR packets over UDP. An edge: sockets and the wall clock."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

from simbridge.loop import Simulation

RECEIVE_BYTES = 2048
BEHIND_LIMIT_S = 0.25  # farther behind than this, lost time is let go instead of caught up in a burst
LATE_TICK_S = 0.02  # a step that ends this far behind is counted: what is on the wire comes that late


class MavlinkEndpoint(Protocol):
    """The flight controller's side of its MAVLink links, by name ("offboard", "gcs")."""

    def receive(self, link: str, data: bytes, t_ns: int) -> None: ...

    def take_output(self) -> list[tuple[str, bytes]]: ...


@dataclass(slots=True)
class UdpLink:
    """One link of the flight controller: sends to a listener, answers whoever spoke last, as PX4 does.

    Raises: OSError: the local address is taken or not ours.
    """

    remote: tuple[str, int]
    local: tuple[str, int] = ("127.0.0.1", 0)
    unsent: int = 0
    _socket: socket.socket = field(init=False)

    def __post_init__(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._socket.bind(self.local)

    @property
    def port(self) -> int:
        return int(self._socket.getsockname()[1])

    def send(self, data: bytes) -> None:
        try:
            self._socket.sendto(data, self.remote)
        except OSError:  # nobody listens yet, or the buffer is full: a datagram lost, as on any network
            self.unsent += 1

    def receive(self) -> list[bytes]:
        out: list[bytes] = []
        while True:
            try:
                data, source = self._socket.recvfrom(RECEIVE_BYTES)
            except BlockingIOError:
                return out
            except OSError:  # an earlier datagram bounced
                continue
            self.remote = source
            out.append(data)

    def close(self) -> None:
        self._socket.close()


@dataclass(frozen=True, slots=True)
class Tick:
    """One step of a paced world, once it had waited."""

    wall_s: float  # time.monotonic
    t_ns: int
    late_ticks: int  # up to here


@dataclass(frozen=True, slots=True)
class Pacing:
    """How well a stretch kept its pace."""

    wall_time_s: float
    sim_time_s: float
    late_ticks: int  # steps that ended more than LATE_TICK_S behind real time

    @property
    def real_time_factor(self) -> float | None:
        """None: no time has passed."""
        return self.sim_time_s / self.wall_time_s if self.wall_time_s > 0 else None


@dataclass(slots=True)
class Pace:
    """Keeps simulated time at `speed` times wall time. speed 0: as fast as it goes."""

    speed: float
    _wall0_s: float = 0.0
    _sim0_ns: int = 0
    late_s: float = 0.0  # let go, all in all
    _late_ticks: int = 0
    _first: Tick | None = None
    newest: Tick | None = None

    def wait(self, t_ns: int) -> None:
        now = time.monotonic()
        if self._first is None:  # what came before (an autopilot's boot) is not paced
            self._wall0_s, self._sim0_ns = now, t_ns
            self._first = self.newest = Tick(now, t_ns, 0)
            return
        if self.speed > 0:
            target = self._wall0_s + (t_ns - self._sim0_ns) * 1e-9 / self.speed
            behind_s = now - target
            if behind_s < 0:
                time.sleep(-behind_s)
                now = time.monotonic()
            self._late_ticks += behind_s > LATE_TICK_S
            if behind_s > BEHIND_LIMIT_S:
                self.late_s += behind_s
                self._wall0_s += behind_s
        self.newest = Tick(now, t_ns, self._late_ticks)

    def since(self, tick: Tick | None = None) -> Pacing:
        """From `tick` (None: the first) to the newest."""
        first, newest = tick or self._first, self.newest
        if first is None or newest is None:
            return Pacing(wall_time_s=0.0, sim_time_s=0.0, late_ticks=0)
        return Pacing(
            wall_time_s=newest.wall_s - first.wall_s,
            sim_time_s=(newest.t_ns - first.t_ns) * 1e-9,
            late_ticks=newest.late_ticks - first.late_ticks,
        )


def serve(
    simulation: Simulation,
    autopilot: MavlinkEndpoint | None,
    links: dict[str, UdpLink],
    lidar: UdpLink,
    *,
    speed: float,
    stop: Callable[[], bool],
    each_second: Callable[[Simulation, Pace], None] | None = None,
) -> Pace:
    """Run the world until `stop()`; autopilot None: a real one, that has its own MAVLink sockets."""
    pace = Pace(speed)
    second = simulation.t_ns // 1_000_000_000
    with contextlib.ExitStack() as closing:
        for link in (*links.values(), lidar):
            closing.callback(link.close)
        while not stop():
            if autopilot is not None:
                for name, link in links.items():
                    for data in link.receive():
                        autopilot.receive(name, data, simulation.t_ns)
            simulation.step()
            for packet in simulation.take_lidar_packets():
                lidar.send(packet)
            if autopilot is not None:
                for name, frame in autopilot.take_output():
                    if name in links:
                        links[name].send(frame)
            if each_second is not None and simulation.t_ns // 1_000_000_000 != second:
                second = simulation.t_ns // 1_000_000_000
                each_second(simulation, pace)
            pace.wait(simulation.t_ns)
    return pace
