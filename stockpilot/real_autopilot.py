"""A real PX4 or ArduCopter in the place of the emulated flight controller, for `run` (lockstep) and `sim` (real time)."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from companion.errors import ConfigError, LinkError
from simbridge.config import SimConfig
from simbridge.faults import LinkFaults
from simbridge.loop import Simulation
from simbridge.sensors import BaroSample, ImuSample
from simbridge.server import UdpLink
from simbridge.sitl import SitlError, parameters
from simbridge.sitl.ardupilot import ArduPilotSitl
from simbridge.sitl.ports import Port, arducopter_ports, first_free_instance, px4_ports, require_free
from simbridge.sitl.process import start_arducopter, start_px4
from simbridge.sitl.px4 import Px4Sitl

Array = NDArray[np.float64]

COMPANION_PORT = 14540  # where PX4 sends; ArduCopter is told to
GROUND_PORT = 14550
PX4_ITS_PORT_ABOVE = 40  # PX4 itself binds 14580 for the link to 14540
OFFBOARD_URL, GROUND_URL = f"udpin://127.0.0.1:{COMPANION_PORT}", f"udpin://127.0.0.1:{GROUND_PORT}"
PX4_COMMANDS_PER_STEP, PX4_STEP_NS = 1, 4_000_000
ARDUPILOT_COMMANDS_PER_STEP, ARDUPILOT_STEP_NS = 4, 5_000_000  # 800 Hz


class RealController:
    """A real autopilot in a Simulation: what goes wrong with it is an error of a link, for the command to tell."""

    def __init__(self, sitl: Px4Sitl | ArduPilotSitl) -> None:
        self._sitl = sitl
        self.motors: Array = np.zeros(4)  # the newest commands, 0..1

    def step(self, t_ns: int, imu: ImuSample, baro: BaroSample | None, rangefinder_m: float | None) -> Array:
        try:
            self.motors = self._sitl.step(t_ns, imu, baro, rangefinder_m)
        except SitlError as error:
            raise LinkError(str(error)) from error
        return self.motors


class RealWire:
    """The companion's MAVLink to a real autopilot on this machine: UDP, with the faults of a mission."""

    def __init__(self, link: UdpLink, cfg: SimConfig, liftoff_ns: Callable[[], int | None]) -> None:
        self._link, self._liftoff_ns = link, liftoff_ns
        self._has_faults = bool(cfg.faults)
        self._down = LinkFaults(cfg.faults, "from_autopilot", cfg.seed)
        self._up = LinkFaults(cfg.faults, "to_autopilot", cfg.seed)

    def take(self, t_ns: int) -> list[bytes]:
        datagrams = self._link.receive()
        return self._down.pass_on(datagrams, t_ns, self._liftoff_ns()) if self._has_faults else datagrams

    def send(self, frames: list[bytes], t_ns: int) -> None:
        if self._has_faults:
            frames = self._up.pass_on(frames, t_ns, self._liftoff_ns())
        for frame in frames:
            self._link.send(frame)


def prepare_real(cfg: SimConfig, autopilot: str, binary: Path | None) -> tuple[Simulation, RealWire, ExitStack]:
    """World, wire and what ends them, for a flight in lockstep. Raises: ConfigError, LinkError."""
    with ExitStack() as stack:
        try:
            link = _companion_link(autopilot, is_ours=binary is not None)
        except (SitlError, OSError) as error:
            raise LinkError(str(error)) from error
        stack.callback(link.close)
        simulation, closing = simulation_for(cfg, autopilot, binary, companion_port=link.port)
        stack.enter_context(closing)
        return simulation, RealWire(link, cfg, lambda: simulation.liftoff_ns), stack.pop_all()
    raise AssertionError("unreachable")


def simulation_for(
    cfg: SimConfig, autopilot: str, binary: Path | None, *, companion_port: int = COMPANION_PORT
) -> tuple[Simulation, ExitStack]:
    """The world with a real flight controller: started from `binary`, else waited for. Close the stack to end both.

    companion_port: where one that we start sends its MAVLink; of PX4 it tells the instance: 14540 is 0, 14541 is 1.
    Raises: ConfigError: no such autopilot, no such binary, parameters of another. LinkError: a port is taken.
    """
    with ExitStack() as stack:
        try:
            if autopilot == "px4":
                simulation = _with_px4(cfg, binary, stack, companion_port - COMPANION_PORT)
            elif autopilot == "ardupilot":
                simulation = _with_arducopter(cfg, binary, stack, companion_port)
            else:
                raise ConfigError(f"--autopilot {autopilot}: is none of emulated, px4, ardupilot")
        except SitlError as error:
            raise LinkError(str(error)) from error
        return simulation, stack.pop_all()
    raise AssertionError("unreachable")


def _companion_link(autopilot: str, *, is_ours: bool) -> UdpLink:
    """Where the autopilot sends: the usual port, or for one that we start, and can tell, a free one.

    PX4's port is of its instance: one all of whose ports are free, its own ones too. Raises: SitlError: there is none.
    """
    if is_ours and autopilot == "ardupilot":
        return UdpLink(remote=("127.0.0.1", 0), local=("127.0.0.1", 0))  # it answers whoever spoke
    if is_ours:
        port = _companion_port(first_free_instance(lambda i: (_companion_port(i), *px4_ports(i)))).number
    else:
        require_free([_companion_port(0)])
        port = COMPANION_PORT
    return UdpLink(remote=("127.0.0.1", port + PX4_ITS_PORT_ABOVE), local=("127.0.0.1", port))


def _companion_port(instance: int) -> Port:
    return Port("UDP", COMPANION_PORT + instance, "where the autopilot sends to the companion")


def _with_px4(cfg: SimConfig, binary: Path | None, stack: ExitStack, instance: int) -> Simulation:
    ports = px4_ports(instance)
    require_free(ports if binary is not None else ports[:1])  # of a user's own PX4 the others are its own matter
    sitl = Px4Sitl(port=ports[0].number, seed=cfg.seed)
    stack.callback(sitl.close)
    if binary is None:
        _say(f"waiting for a PX4 (PX4_SIM_MODEL=none_iris) on TCP {sitl.port}")
    else:
        sitl.process = stack.enter_context(start_px4(binary, parameters.PX4 | cfg.autopilot.params, instance=instance))
    simulation = Simulation(cfg, RealController(sitl), step_ns=PX4_STEP_NS, commands_per_step=PX4_COMMANDS_PER_STEP)
    sitl.attach(simulation.truth)
    return simulation


def _with_arducopter(cfg: SimConfig, binary: Path | None, stack: ExitStack, companion_port: int) -> Simulation:
    if cfg.autopilot.params:
        names = ", ".join(sorted(cfg.autopilot.params))
        raise ConfigError(f"autopilot.params: {names}: are PX4's; a mission for ArduCopter has none")
    instance = 0 if binary is None else first_free_instance(arducopter_ports)
    sitl = ArduPilotSitl(port=arducopter_ports(instance)[0].number)
    stack.callback(sitl.close)
    if binary is None:
        _say(f"waiting for an ArduCopter (--model JSON:127.0.0.1) on UDP {sitl.port}")
    else:
        ports = {"physics_port": sitl.port, "offboard_port": companion_port, "ground_port": GROUND_PORT}
        sitl.process = stack.enter_context(start_arducopter(binary, parameters.ARDUPILOT, instance=instance, **ports))
    simulation = Simulation(
        cfg, RealController(sitl), step_ns=ARDUPILOT_STEP_NS, commands_per_step=ARDUPILOT_COMMANDS_PER_STEP
    )
    sitl.attach(simulation.truth)
    return simulation


def _say(text: str) -> None:
    Console(stderr=True).print(text, style="dim")
