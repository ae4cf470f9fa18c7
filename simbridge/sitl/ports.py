"""The ports an autopilot that we start takes on this machine: which they are, whether they are free, who holds them.

An autopilot that cannot bind one says so in its own log at best, and goes on without: PX4 then never gets ready, and the
one whose port it was gets its messages. So they are looked at before it is started. An edge: sockets.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Literal

import psutil

from simbridge.sitl import SitlError
from simbridge.sitl.ardupilot import PHYSICS_PORT
from simbridge.sitl.px4 import SIMULATOR_PORT

INSTANCES = range(10)
ARDUCOPTER_STEP = 10  # between the ports of one ArduCopter and of the next


@dataclass(frozen=True, slots=True)
class Port:
    """One port, and what its autopilot wants it for."""

    protocol: Literal["TCP", "UDP"]
    number: int
    purpose: str

    def __str__(self) -> str:
        return f"{self.protocol} {self.number} ({self.purpose})"

    def is_free(self) -> bool:
        kind = socket.SOCK_STREAM if self.protocol == "TCP" else socket.SOCK_DGRAM
        with socket.socket(socket.AF_INET, kind) as probe:
            if self.protocol == "TCP":  # as each server does: a connection that lingers after a flight holds nothing
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(("0.0.0.0", self.number))
            except OSError:
                return False
        return True

    def holder(self) -> str:
        """Who has it: name and process number, as far as this user may know."""
        try:
            connections = psutil.net_connections(kind=self.protocol.lower())
        except (psutil.Error, OSError):
            connections = []
        owners = sorted(
            {
                c.pid
                for c in connections
                if c.pid is not None
                and c.laddr
                and c.laddr.port == self.number
                and (self.protocol == "UDP" or c.status == psutil.CONN_LISTEN)
            }
        )
        if not owners:
            return "a program of another user"
        return " and ".join(_name(pid) for pid in owners)


def px4_ports(instance: int) -> tuple[Port, ...]:
    """What PX4 SITL of this instance, and its simulator, bind: its start-up adds the instance to each."""
    return (
        Port("TCP", SIMULATOR_PORT + instance, "the simulator that PX4 connects to"),
        Port("UDP", 14580 + instance, "PX4's link to the companion"),
        Port("UDP", 18570 + instance, "PX4's link to a ground station"),
        Port("UDP", 14280 + instance, "PX4's link to a camera"),
        Port("UDP", 13030 + instance, "PX4's link to a gimbal"),
    )


def arducopter_ports(instance: int) -> tuple[Port, ...]:
    """What ArduCopter SITL of this instance, and its physics, bind: ten ports apart. Of its serial ports only the third
    still listens on TCP: the first two are told to send."""
    return (
        Port("UDP", PHYSICS_PORT + ARDUCOPTER_STEP * instance, "the physics that ArduCopter asks"),
        Port("TCP", 5763 + ARDUCOPTER_STEP * instance, "ArduCopter's third serial port"),
    )


def require_free(ports: Iterable[Port]) -> None:
    """Raises: SitlError: which port is held, by whom, and how to mend it."""
    held = [port for port in ports if not port.is_free()]
    if held:
        raise SitlError(f"{_told(held)}: end that program, or wait until it has ended, and start again")


def first_free_instance(ports_of: Callable[[int], tuple[Port, ...]]) -> int:
    """The lowest instance whose ports are all free. Raises: SitlError: none is; who holds the ports of each."""
    told = []
    for instance in INSTANCES:
        held = [port for port in ports_of(instance) if not port.is_free()]
        if not held:
            return instance
        told.append(f"  instance {instance}: {_told(held)}")
    raise SitlError(
        "no instance of the autopilot has all of its ports free: end one of these programs, or wait until it has ended\n"
        + "\n".join(told)
    )


def _told(held: list[Port]) -> str:
    return "; ".join(f"{port} is held by {port.holder()}" for port in held)


def _name(pid: int) -> str:
    if pid == os.getpid():
        return f"this program (process {pid})"
    try:
        return f"{psutil.Process(pid).name()} (process {pid})"
    except psutil.Error:
        return f"process {pid}"
