"""`stockpilot ground`: what an operator does from the ground station, through MAVSDK."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from companion.errors import LinkError
from companion.mavlink.ardupilot import ARDUPILOT
from companion.mavlink.dialect import Dialect, ModeReport
from companion.mavlink.px4 import PX4
from companion.messages import LandedState
from stockpilot.vehicle_link import VehicleLink, open_vehicle

ground_app = typer.Typer(
    help="Look at the vehicle, hold it, land it, abort the mission, fetch its logs: from the ground station's link, "
    "whatever the companion is doing.",
    no_args_is_help=True,
)
ConnectOption = Annotated[
    str,
    typer.Option(help="the ground station's link: udpin://HOST:PORT, udpout://, tcpout://, serial://DEVICE:BAUD"),
]
TimeoutOption = Annotated[float, typer.Option(min=0.5, help="seconds to wait for the autopilot")]
JsonOption = Annotated[bool, typer.Option("--json", help="print the result as JSON on stdout")]
DEFAULT_URL = "udpin://0.0.0.0:14550"
_DIALECTS: dict[str | None, Dialect] = {"px4": PX4, "ardupilot": ARDUPILOT}
_ARMED = 128
_SETTLE_S = 1.2  # the slowest message of a status, HEARTBEAT, comes once a second
_CONFIRM_S = 3.0

Result = dict[str, Any]


def read_status(link: VehicleLink) -> Result:
    """What the autopilot has said, in words; None for what it has not."""
    newest = link.newest
    heartbeat = newest.get("HEARTBEAT", {})
    landed = LandedState(int(newest.get("EXTENDED_SYS_STATE", {}).get("landed_state", 0)))
    current = newest.get("CURRENT_MODE", {})
    custom_mode = int(heartbeat.get("custom_mode", 0))
    is_same = current.get("custom_mode") == custom_mode
    dialect = _DIALECTS.get(link.autopilot)
    report = ModeReport(
        custom_mode=custom_mode,
        landed_state=landed,
        standard_mode=int(current["standard_mode"]) if is_same and "standard_mode" in current else None,
    )
    flags = newest.get("ESTIMATOR_STATUS" if link.autopilot == "px4" else "EKF_STATUS_REPORT", {}).get("flags")
    position = newest.get("LOCAL_POSITION_NED")
    remaining = newest.get("SYS_STATUS", {}).get("battery_remaining", -1)
    return {
        "autopilot": link.autopilot,
        "armed": bool(int(heartbeat.get("base_mode", 0)) & _ARMED),
        "mode": dialect.decode_mode(report).value if dialect else "unknown",
        "failsafe": int(heartbeat.get("system_status", 0)) in (5, 6),
        "landed_state": landed.name.lower(),
        "position_map_m": [position["x"], -position["y"], -position["z"]] if position else None,
        "position_valid": bool(dialect and flags is not None and dialect.is_position_valid(int(flags))),
        "vision_fused": bool(dialect and flags is not None and dialect.is_vision_fused(int(flags))),
        "battery_percent": remaining if isinstance(remaining, int) and remaining >= 0 else None,
        "messages": [text for _, text in list(link.texts)[-5:]],
    }


async def _status(link: VehicleLink) -> Result:
    await asyncio.sleep(_SETTLE_S)
    return {"ok": True, **read_status(link)}


async def _act(link: VehicleLink, name: str, mode_wanted: tuple[str, ...]) -> Result:
    """Ask through MAVSDK's action plugin, then look whether it came to pass."""
    from mavsdk.asyncio.plugins.action import ActionAsync, ActionError

    action = ActionAsync(link.system)
    calls: dict[str, Callable[[], Awaitable[object]]] = {"hold": action.hold, "land": action.land}
    try:
        await calls[name]()
    except ActionError as error:
        await asyncio.sleep(0.5)  # the reasons come after the refusal
        reasons = [text for _, text in list(link.texts)[-3:]]
        return {"ok": False, "asked": name, "error": str(error).split(";")[0], **read_status(link), "messages": reasons}
    end = time.monotonic() + _CONFIRM_S
    while time.monotonic() < end:
        await asyncio.sleep(0.1)
        status = read_status(link)
        if status["mode"] in mode_wanted or (name == "land" and not status["armed"]):
            return {"ok": True, "asked": name, **status}
    status = read_status(link)
    return {"ok": False, "asked": name, "error": f"accepted, but the mode is {status['mode']}", **status}


async def _abort(link: VehicleLink) -> Result:
    """Hold first, where that can be done: it takes the companion's hand off at once; then land."""
    held = await _act(link, "hold", ("hold",))
    landed = await _act(link, "land", ("land", "descend"))
    return {**landed, "asked": "abort", "held_first": held["ok"]}


async def _logs(link: VehicleLink, out: Path | None, newest: int) -> Result:
    from mavsdk.asyncio.plugins.log_files import LogFilesAsync, LogFilesError, LogFilesResult

    logs = LogFilesAsync(link.system)
    try:
        entries = list(await logs.get_entries())
    except LogFilesError as error:
        if error.result == LogFilesResult.NO_LOGFILES:
            return {"ok": True, "logs": []}
        return {"ok": False, "error": f"the list of logs was not given: {str(error).split(';')[0]}", "logs": []}
    entries.sort(key=lambda entry: entry.id)
    listed = [{"id": e.id, "date": e.date, "bytes": e.size_bytes} for e in entries]
    if out is None:
        return {"ok": True, "logs": listed}
    await asyncio.to_thread(out.mkdir, parents=True, exist_ok=True)
    console = Console(stderr=True)
    saved: list[str] = []
    for entry in entries[-newest:]:
        path = out / f"log{entry.id:03d}_{entry.date.replace(':', '').replace(' ', '_') or 'nodate'}.ulg"
        try:
            async for _, progress in logs.download_log_file(entry, str(path)):
                console.print(f"{path.name}: {progress.progress:.0%}", end="\r")
        except LogFilesError as error:
            return {"ok": False, "error": f"{path.name}: {str(error).split(';')[0]}", "logs": listed, "saved": saved}
        saved.append(str(path))
    return {"ok": True, "logs": listed, "saved": saved}


def _run(url: str, timeout_s: float, as_json: bool, what: Callable[[VehicleLink], Awaitable[Result]]) -> None:
    async def go() -> Result:
        async with open_vehicle(url, timeout_s) as link:
            return await what(link)

    try:
        result = asyncio.run(go())
    except LinkError as error:
        result = {"ok": False, "error": str(error)}
    if as_json:
        typer.echo(json.dumps(result, indent=2))
    else:
        _show(result)
    raise typer.Exit(0 if result["ok"] else 1)


def _show(result: Result) -> None:
    console = Console()
    for key, value in result.items():
        if key in ("ok", "error"):
            continue
        if key == "logs" and not value:
            console.print("it keeps no logs")
        elif key == "logs":
            for log in value:
                console.print(f"{log['id']:>4}  {log['date'] or 'no date':24}  {log['bytes'] / 1e6:8.1f} MB")
        elif isinstance(value, list) and value and isinstance(value[0], float):
            console.print(f"{key:16} {', '.join(f'{v:.2f}' for v in value)}", highlight=False)
        elif isinstance(value, list):
            for line in value:
                console.print(f"{key:16} {line}", highlight=False)
        else:
            console.print(f"{key:16} {value}", highlight=False)
    if result.get("error"):
        Console(stderr=True).print(f"[bold red]{result['error']}[/]", highlight=False)


@ground_app.command()
def status(connect: ConnectOption = DEFAULT_URL, timeout: TimeoutOption = 10.0, as_json: JsonOption = False) -> None:
    """Mode, armed, landed, position, battery, the autopilot's last words."""
    _run(connect, timeout, as_json, _status)


@ground_app.command()
def hold(connect: ConnectOption = DEFAULT_URL, timeout: TimeoutOption = 10.0, as_json: JsonOption = False) -> None:
    """Stop where it is. The companion takes this for the pilot's takeover and stops its setpoints."""
    _run(connect, timeout, as_json, lambda link: _act(link, "hold", ("hold",)))


@ground_app.command()
def land(connect: ConnectOption = DEFAULT_URL, timeout: TimeoutOption = 10.0, as_json: JsonOption = False) -> None:
    """Land where it is."""
    _run(connect, timeout, as_json, lambda link: _act(link, "land", ("land", "descend")))


@ground_app.command()
def abort(connect: ConnectOption = DEFAULT_URL, timeout: TimeoutOption = 10.0, as_json: JsonOption = False) -> None:
    """End the mission: hold where possible, then land. May be given again and again."""
    _run(connect, timeout, as_json, _abort)


@ground_app.command()
def logs(
    connect: ConnectOption = DEFAULT_URL,
    out: Annotated[Path | None, typer.Option(help="folder to download into; none: only list them")] = None,
    newest: Annotated[int, typer.Option(min=1, help="how many of the newest to download")] = 1,
    timeout: TimeoutOption = 10.0,
    as_json: JsonOption = False,
) -> None:
    """List the autopilot's own logs, and download the newest."""
    _run(connect, timeout, as_json, lambda link: _logs(link, out, newest))
