"""A companion that stands still in flight as after SIGSTOP: the world goes on, its sockets fill, then it wakes."""

from __future__ import annotations

from collections.abc import Callable

from stockpilot.lockstep import Lockstep
from stockpilot.wires import EmulatedWire

SOCKET_BYTES = 212_992  # net.core.rmem_default: the first of what comes stays, the rest is lost
BYTES_BESIDE = 768  # what the kernel counts for a small datagram


def freeze(run: Lockstep, until: Callable[[], bool], limit_s: float) -> None:
    """Step the world alone until `until()`, then let the companion find what its sockets had room for: the oldest.

    A real autopilot's socket is the kernel's own, and fills by itself.
    """
    simulation, began_ns = run.simulation, run.simulation.t_ns
    wire = run.wire if isinstance(run.wire, EmulatedWire) else None
    packets, frames = Inbox(), Inbox()
    while not until():
        simulation.step()
        packets.take(simulation.take_lidar_packets())
        if wire is not None:
            frames.take(wire.take(simulation.t_ns))
            wire.send([], simulation.t_ns)
        assert simulation.t_ns < began_ns + limit_s * 1e9, f"still not so after {limit_s} s"
    flight, t_ns = run.flight, run.t_ns
    for frame in frames.kept:
        flight.on_mavlink(frame, t_ns)
    for packet in packets.kept:
        for scan in flight.on_lidar_packet(packet, t_ns):
            run._take_scan(scan, flight.begin_scan(scan, t_ns)(), t_ns)


class Inbox:
    """A socket that nobody reads."""

    def __init__(self) -> None:
        self.kept: list[bytes] = []
        self._bytes = 0

    def take(self, datagrams: list[bytes]) -> None:
        for datagram in datagrams:
            size = len(datagram) + BYTES_BESIDE
            if self._bytes + size <= SOCKET_BYTES:
                self._bytes += size
                self.kept.append(datagram)
