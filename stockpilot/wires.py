"""What carries MAVLink frames between the companion and an emulated flight controller, with the faults of a mission."""

from __future__ import annotations

from simbridge.autopilot import Autopilot

OFFBOARD = "offboard"


class EmulatedWire:
    """Both ends in one process: bytes only."""

    def __init__(self, autopilot: Autopilot) -> None:
        self._autopilot = autopilot

    def take(self, t_ns: int) -> list[bytes]:
        return [frame for link, frame in self._autopilot.take_output() if link == OFFBOARD]

    def send(self, frame: bytes, t_ns: int) -> None:
        self._autopilot.receive(OFFBOARD, frame, t_ns)
