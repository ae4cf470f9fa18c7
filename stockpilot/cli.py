"""The command `stockpilot`. Progress goes to stderr, results to stdout; each command has --json."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from companion.errors import StockpilotError

EXIT_CODES = """
Exit codes: 0 all well; 1 it ran, but the result is not what was asked for (a flight that did not complete, a check that
failed); 2 wrong use: an option, a mission file or an input file; 3 recovered with loss (recover).
"""

app = typer.Typer(
    name="stockpilot",
    help="Maps dark, dusty stores with a LiDAR drone, without GPS or camera, and says how much material lies there.\n\n"
    "Start with: stockpilot run missions/cement_store.yaml",
    epilog=EXIT_CODES,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)
config_app = typer.Typer(help="Look at a mission file as the program reads it.", no_args_is_help=True)
app.add_typer(config_app, name="config")

MissionArgument = Annotated[
    Path, typer.Argument(help="mission file (YAML), e.g. missions/cement_store.yaml", show_default=False)
]
SetOption = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="change a mission key, e.g. navigator.height_m=8; may be repeated"),
]
SeedOption = Annotated[
    int | None, typer.Option(help="seed of all noise; the same seed gives the same result to the last bit")
]
OutOption = Annotated[Path | None, typer.Option(help="folder for the results; default runs/<mission>-<seed>")]
AutopilotOption = Annotated[
    str | None,
    typer.Option(help="emulated, px4 or ardupilot (the last two need a SITL binary); default: as autopilot.kind says"),
]
JsonOption = Annotated[bool, typer.Option("--json", help="print the result as JSON on stdout")]


@app.command()
def run(
    mission: MissionArgument,
    seed: SeedOption = None,
    out: OutOption = None,
    settings: SetOption = None,
    autopilot: AutopilotOption = None,
    autopilot_binary: Annotated[Path | None, typer.Option(help="SITL binary to start; else one is waited for")] = None,
    record: Annotated[bool, typer.Option(help="write recording.mcap, telemetry.tlog beside the results")] = True,
    as_json: JsonOption = False,
) -> None:
    """Fly a mission in the emulated store, in lockstep, faster than real time, and measure the material.

    Writes report.json, report.html, map.ply, map.laz, trajectory.tum, pictures and the recording.
    Ctrl-C lands the vehicle and keeps what was mapped; a second Ctrl-C stops at once.
    """
    from stockpilot.run import run_command

    raise typer.Exit(
        run_command(
            mission, seed=seed, out=out, settings=settings or [], autopilot=autopilot, binary=autopilot_binary,
            record=record, as_json=as_json,
        )
    )  # fmt: skip


@app.command()
def sim(
    mission: MissionArgument,
    seed: SeedOption = None,
    settings: SetOption = None,
    autopilot: AutopilotOption = None,
    autopilot_binary: Annotated[Path | None, typer.Option(help="SITL binary to start; else one is waited for")] = None,
    offboard: Annotated[str, typer.Option(help="where the companion listens for MAVLink")] = "udpout://127.0.0.1:14540",
    ground: Annotated[
        str, typer.Option(help="where the ground station listens for MAVLink")
    ] = "udpout://127.0.0.1:14550",
    lidar: Annotated[str, typer.Option(help="where LiDAR packets go")] = "udp://127.0.0.1:7502",
    speed: Annotated[float, typer.Option(min=0.1, max=50, help="times real time")] = 1.0,
    duration: Annotated[
        float | None, typer.Option(help="stop after so many simulated seconds; default: until Ctrl-C")
    ] = None,
    metadata: Annotated[
        Path | None, typer.Option(help="write the LiDAR's metadata JSON there (for fly --lidar-metadata)")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Emulate only the world, on the wire, in real time: MAVLink over UDP 14540 and 14550, LiDAR packets over UDP 7502."""
    from stockpilot.sim import sim_command

    raise typer.Exit(
        sim_command(
            mission, seed=seed, settings=settings or [], autopilot=autopilot, binary=autopilot_binary,
            offboard=offboard, ground=ground, lidar=lidar, speed=speed, duration_s=duration, metadata=metadata,
            as_json=as_json,
        )
    )  # fmt: skip


@app.command()
def fly(
    mission: MissionArgument,
    connect: Annotated[
        str, typer.Option(help="flight controller: udpin://HOST:PORT, udpout://, tcpout://, serial:///dev/ttyX:BAUD")
    ] = "udpin://0.0.0.0:14540",
    lidar: Annotated[str, typer.Option(help="where LiDAR packets arrive")] = "udp://:7502",
    lidar_metadata: Annotated[
        Path | None, typer.Option(help="the sensor's metadata JSON; default: an Ouster as the mission says")
    ] = None,
    out: OutOption = None,
    settings: SetOption = None,
    record: Annotated[bool, typer.Option(help="write the recording")] = True,
    as_json: JsonOption = False,
) -> None:
    """Fly a mission as on the vehicle: only the companion, on real links, in real time.

    SIGTERM and Ctrl-C land the vehicle.
    """
    from stockpilot.fly import fly_command

    raise typer.Exit(
        fly_command(
            mission, connect=connect, lidar=lidar, lidar_metadata=lidar_metadata, out=out, settings=settings or [],
            record=record, as_json=as_json,
        )
    )  # fmt: skip


@config_app.command("show")
def config_show(
    mission: MissionArgument, settings: SetOption = None, seed: SeedOption = None, as_json: JsonOption = False
) -> None:
    """Print a mission with every key and its value, defaults included."""
    import yaml

    from stockpilot.mission import load_mission

    resolved = load_mission(mission, settings or [], seed=seed).resolved()
    if as_json:
        typer.echo(json.dumps(resolved, indent=2))
    else:
        typer.echo(yaml.safe_dump(resolved, sort_keys=False, allow_unicode=True).rstrip())


@config_app.command("validate")
def config_validate(mission: MissionArgument, settings: SetOption = None, as_json: JsonOption = False) -> None:
    """Check a mission file: every fault with file, line, key, value and what is allowed. Exit code 0 or 2."""
    from stockpilot.mission import load_mission

    try:
        loaded = load_mission(mission, settings or [])
    except StockpilotError as error:
        if as_json:
            typer.echo(json.dumps({"valid": False, "file": str(mission), "faults": str(error).splitlines()}, indent=2))
            raise typer.Exit(2) from None
        raise
    if as_json:
        typer.echo(json.dumps({"valid": True, "file": str(mission), "name": loaded.name, "faults": []}, indent=2))
    else:
        typer.echo(f"{mission}: valid ({loaded.name}{'' if loaded.sim else ', without a world: for fly only'})")


# Commands in files of their own, imported only when they are called: name, module, what it gives, one line of help.
ELSEWHERE = (
    ("volume", "volume_cli", "volume_command", "Measure the material in a point cloud (PLY, LAS, LAZ)."),
    ("sweep", "sweep", "sweep_command", "Fly a grid of missions; go on where it stopped; one table, one page."),
    ("doctor", "doctor", "doctor", "Check a flight controller before a mission: parameters, time, sensors, fusion."),
    ("ground", "ground", "ground_app", "An operator's commands: status, hold, land, abort, logs."),
    ("replay", "replay", "replay_command", "Fly a recording again, to the last bit, or with other settings."),
    ("recover", "recover", "recover_command", "Rebuild a recording that was cut or damaged; the original stays."),
    ("info", "info", "info_command", "Say what is in a recording, and how whole it is."),
    ("odometry", "odometry_cli", "odometry_command", "Run the odometry on other people's recordings."),
)


def _mount(wanted: str | None) -> None:
    """Put the other commands in: the one that is called with its code, the rest by name for --help."""
    for name, module, attribute, line in ELSEWHERE:
        if name != wanted:
            app.command(name, help=line)(_named)
            continue
        found = getattr(importlib.import_module(f"stockpilot.{module}"), attribute)
        if isinstance(found, typer.Typer):
            app.add_typer(found, name=name)
        else:
            app.command(name)(found)


def _named() -> None:
    """Stands for a command in the list of --help; never called, since a called command is mounted itself."""
    raise AssertionError("a command was called that is only listed")


def main() -> None:
    """Entry point: errors that a person can mend are told on stderr without a traceback, exit code 2."""
    _mount(next((word for word in sys.argv[1:] if not word.startswith("-")), None))
    try:
        app(prog_name="stockpilot")
    except StockpilotError as error:
        if "--json" in sys.argv:
            problem: dict[str, Any] = {"error": type(error).__name__, "faults": str(error).splitlines()}
            print(json.dumps(problem, indent=2))
        console = Console(stderr=True, highlight=False, soft_wrap=True)
        for line in str(error).splitlines():
            console.print(
                f"[bold red]error[/] {line}" if console.is_terminal else f"error: {line}", markup=console.is_terminal
            )
        raise SystemExit(2) from None
    except BrokenPipeError:
        raise SystemExit(0) from None


if __name__ == "__main__":
    main()
