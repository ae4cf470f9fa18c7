"""`stockpilot sim`: only the world, on the wire, in real time."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import typer
from rich.console import Console

from companion.errors import ConfigError, LinkError
from simbridge.loop import Simulation
from simbridge.server import MavlinkEndpoint, Pace, Tick, UdpLink, serve
from stockpilot.addresses import parse_address
from stockpilot.mission import load_mission

# Where PX4 itself binds: offboard and ground station links of instance 0.
PX4_LOCAL_PORT = {"offboard": 14580, "gcs": 18570}


def open_link(option: str, url: str, preferred_port: int = 0) -> UdpLink:
    """A UDP link that sends to `url`; bound to the preferred local port where that is free. Raises: LinkError."""
    _, host, port = parse_address(url, ("udpout", "udp"), option=option)
    local = "127.0.0.1" if host.startswith("127.") or host == "localhost" else "0.0.0.0"
    for candidate in dict.fromkeys((preferred_port, 0)):
        try:
            return UdpLink(remote=(host, port), local=(local, candidate))
        except OSError as error:
            fault = error
    raise LinkError(f"{option} {url}: no local UDP port could be bound: {fault}")


def sim_command(
    path: Path, *, seed: int | None, settings: list[str], autopilot: str | None, binary: Path | None, offboard: str,
    ground: str, lidar: str, speed: float, duration_s: float | None, metadata: Path | None, as_json: bool,
) -> int:  # fmt: skip
    """Exit code: 0 stopped as asked."""
    mission = load_mission(path, settings, seed=seed)
    if mission.sim is None:
        raise ConfigError(f"{mission.path}: world: is missing: there is nothing to emulate")
    autopilot = autopilot or mission.autopilot
    console = Console(stderr=True)
    stop = _Stop()
    links: dict[str, UdpLink] = {}
    endpoint: MavlinkEndpoint | None = None
    if autopilot == "emulated":
        from stockpilot.run import emulated

        simulation, endpoint = emulated(mission.sim, ("offboard", "gcs"))
        links = {
            name: open_link(f"--{name}", url, PX4_LOCAL_PORT[name])
            for name, url in (("offboard", offboard), ("gcs", ground))
        }
        close: Callable[[], object] = lambda: None  # noqa: E731
    else:
        from stockpilot.real_autopilot import GROUND_URL, OFFBOARD_URL, simulation_for

        simulation, closing = simulation_for(mission.sim, autopilot, binary)
        close = closing.close
        offboard, ground = OFFBOARD_URL, GROUND_URL  # its own sockets
    lidar_link = open_link("--lidar", lidar)
    if metadata is not None:
        metadata.write_text(simulation.lidar_metadata_json(), encoding="utf-8")
    console.print(
        f"[bold]{mission.name}[/] in real time x {speed:g}: MAVLink to {offboard} and {ground}, LiDAR to {lidar}; Ctrl-C stops"
    )
    began_ns = simulation.t_ns
    told_late_s = 0.0
    liftoff: Tick | None = None

    def each_second(world: Simulation, pace: Pace) -> None:
        nonlocal told_late_s, liftoff
        if liftoff is None and world.liftoff_ns is not None:
            liftoff = pace.newest
        if pace.late_s > told_late_s + 0.5:
            told_late_s = pace.late_s
            console.print(f"[yellow]this machine is too slow: {pace.late_s:.1f} s behind real time so far[/]")
        if world.collision and not stop.told_collision:
            stop.told_collision = True
            console.print("[bold red]collision[/]")

    def finished() -> bool:
        return stop.asked or (duration_s is not None and simulation.t_ns - began_ns >= duration_s * 1e9)

    try:
        pace = serve(simulation, endpoint, links, lidar_link, speed=speed, stop=finished, each_second=each_second)
    finally:
        close()
    paced = pace.since()
    in_flight = pace.since(liftoff) if liftoff is not None else None
    summary = {
        "mission": mission.name, "seed": mission.seed, "autopilot": autopilot,
        "wall_time_s": paced.wall_time_s, "sim_time_s": paced.sim_time_s,
        "real_time_factor": paced.real_time_factor, "late_ticks": paced.late_ticks, "late_s": pace.late_s,
        # From lift-off on; what came before is an autopilot's boot and the companion's warming up.
        "real_time_factor_in_flight": in_flight.real_time_factor if in_flight is not None else None,
        "late_ticks_in_flight": in_flight.late_ticks if in_flight is not None else None,
        "collision": simulation.collision, "min_clearance_m": simulation.min_clearance_m,
    }  # fmt: skip
    typer.echo(json.dumps(summary, indent=2) if as_json else "\n".join(_line(k, v) for k, v in summary.items()))
    return 0


def _line(name: str, value: object) -> str:
    return f"{name:26} {f'{value:.3f}' if isinstance(value, float) else '-' if value is None else value}"


class _Stop:
    """SIGINT and SIGTERM end the world."""

    def __init__(self) -> None:
        self.asked = False
        self.told_collision = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._handle)

    def _handle(self, _number: int, _frame: FrameType | None) -> None:
        self.asked = True
