"""What carries MAVLink frames between the companion and an emulated flight controller, with the faults of a mission."""

from __future__ import annotations

from collections.abc import Callable

from simbridge.autopilot import Autopilot
from simbridge.config import SimConfig
from simbridge.faults import LinkFaults
from simbridge.sitl.parameters import PX4_VISION

OFFBOARD = "offboard"
BATTERY: dict[str, float] = {"SIM_BAT_DRAIN": 1800}  # s to empty; PX4's default is made for demonstrations: 60 s


def emulated_autopilot(cfg: SimConfig, links: tuple[str, ...]) -> Autopilot:
    """The emulated flight controller, set up for flight on vision; the mission's own parameters come on top.

    Raises: ConfigError: an unknown parameter.
    """
    return Autopilot({**PX4_VISION, **BATTERY, **cfg.autopilot.params}, seed=cfg.seed, links=links)


class EmulatedWire:
    """Both ends in one process: bytes only."""

    def __init__(self, autopilot: Autopilot, cfg: SimConfig, liftoff_ns: Callable[[], int | None]) -> None:
        self._autopilot = autopilot
        self._liftoff_ns = liftoff_ns
        self._has_faults = bool(cfg.faults)
        self._down = LinkFaults(cfg.faults, "from_autopilot", cfg.seed)
        self._up = LinkFaults(cfg.faults, "to_autopilot", cfg.seed)

    def take(self, t_ns: int) -> list[bytes]:
        frames = [frame for link, frame in self._autopilot.take_output() if link == OFFBOARD]
        return self._down.pass_on(frames, t_ns, self._liftoff_ns()) if self._has_faults else frames

    def send(self, frames: list[bytes], t_ns: int) -> None:
        if self._has_faults:
            frames = self._up.pass_on(frames, t_ns, self._liftoff_ns())
        for frame in frames:
            self._autopilot.receive(OFFBOARD, frame, t_ns)
