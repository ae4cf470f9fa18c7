"""`stockpilot doctor`: is this vehicle fit to fly a mission, and if not, what is to be done. Through MAVSDK.

The checks are companion/mavlink/checks.py's, the very ones that stand before arming. Here their facts are gathered.
"""

from __future__ import annotations

import asyncio
import json
from enum import Enum
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.text import Text

from companion.errors import LinkError
from companion.mavlink.checks import Check, Facts, Verdict, all_checks, is_green
from stockpilot.doctor_facts import Surroundings, gather
from stockpilot.doctor_params import Change, apply_manifest
from stockpilot.doctor_probe import Probe
from stockpilot.vehicle_link import open_vehicle

_SIGNS = {
    Verdict.OK: ("ok", "green"),
    Verdict.WARN: ("warn", "yellow"),
    Verdict.FAIL: ("FAIL", "bold red"),
    Verdict.SKIPPED: ("-", "dim"),
}


class ProbeChoice(Enum):
    AUTO = "auto"  # when disarmed, on the ground, and nobody else sends vision
    ON = "on"
    OFF = "off"


async def examine(
    url: str,
    *,
    lidar: str = "",
    apply: bool = False,
    probe: Probe | None = None,
    seconds: float = 4.0,
    timeout_s: float = 10.0,
) -> tuple[Facts, list[Check], list[Change]]:
    """Gather facts and judge them. probe: the test pose to send where that is safe, None: none is sent.

    Raises: LinkError: no link, no autopilot.
    """
    async with open_vehicle(url, timeout_s) as link:
        changes = await apply_manifest(link) if apply else []
        facts = await gather(link, Surroundings(lidar=lidar), probe=probe, seconds=seconds)
    return facts, all_checks(facts), changes


def doctor(
    connect: Annotated[
        str, typer.Option(help="a link to the autopilot: udpin://HOST:PORT, udpout://, tcpout://, serial://DEVICE:BAUD")
    ] = "udpin://0.0.0.0:14550",
    lidar: Annotated[
        str, typer.Option(help="UDP port where LiDAR packets should arrive (udp://:7502); empty: not looked at")
    ] = "udp://:7502",
    apply: Annotated[
        bool, typer.Option("--apply", help="set the parameters that are not as the manifest says, and read them back")
    ] = False,
    probe: Annotated[
        ProbeChoice,
        typer.Option(
            help="send a standing test pose to see whether it is fused; auto: when disarmed, on the ground, and no "
            "companion is running"
        ),
    ] = ProbeChoice.AUTO,
    seconds: Annotated[float, typer.Option(min=1.0, max=60.0, help="how long to listen")] = 4.0,
    timeout: Annotated[float, typer.Option(min=0.5, help="seconds to wait for the autopilot")] = 10.0,
    as_json: Annotated[bool, typer.Option("--json", help="print the result as JSON on stdout")] = False,
) -> None:
    """Check a vehicle before a mission: firmware, parameters, time, streams, sensors, origin, LiDAR, clock, disk, and
    whether the vision it is sent is really fused; if not, which gate stops it.

    Exit code 0: nothing is red; 1: something is, and arming would be refused.
    """
    settings = None if probe is ProbeChoice.OFF else Probe(is_forced=probe is ProbeChoice.ON)
    try:
        facts, checks, changes = asyncio.run(
            examine(connect, lidar=lidar, apply=apply, probe=settings, seconds=seconds, timeout_s=timeout)
        )
    except LinkError as error:
        checks = [Check(name="link", verdict=Verdict.FAIL, actual=str(error), mend="See the message")]
        facts, changes = Facts(autopilot=None), []
    if as_json:
        typer.echo(json.dumps(report(facts, checks, changes), indent=2))
    else:
        _show(facts, checks, changes)
    raise typer.Exit(0 if is_green(checks) else 1)


def report(facts: Facts, checks: list[Check], changes: list[Change]) -> dict[str, Any]:
    """The result for machines."""
    return {
        "green": is_green(checks),
        "autopilot": facts.autopilot,
        "version": facts.version,
        "shut_gates": [c.name.removeprefix("fusion.") for c in checks if c.name.startswith("fusion.")],
        "checks": [
            {
                "name": c.name,
                "verdict": c.verdict.value,
                "actual": c.actual,
                "expected": c.expected,
                "why": c.why,
                "mend": c.mend,
            }
            for c in checks
        ],
        "applied": [
            {"name": c.name, "before": c.before, "after": c.after, "ok": c.ok, "needs_reboot": c.needs_reboot}
            for c in changes
        ],
    }


def _show(facts: Facts, checks: list[Check], changes: list[Change]) -> None:
    """Every line that is not green in full, the green ones in short."""
    console = Console()
    for change in changes:
        word, style = ("set", "green") if change.ok else ("NOT SET", "bold red")
        again = "  (restart the autopilot)" if change.needs_reboot else ""
        before = "?" if change.before is None else f"{change.before:g}"
        console.print(Text.assemble((f"{word:8}", style), f"{change.name}: {before} -> {change.after:g}{again}"))
    for check in checks:
        sign, style = _SIGNS[check.verdict]
        line = Text.assemble((f"{sign:6}", style), f"{check.name:32} {check.actual}")
        if check.verdict in (Verdict.WARN, Verdict.FAIL):
            if check.expected:
                line.append(f"\n{'':39}expected: {check.expected}")
            if check.why:
                line.append(f"\n{'':39}why: {check.why}", "dim")
            if check.mend:
                line.append(f"\n{'':39}to mend: {check.mend}", "cyan")
        console.print(line, soft_wrap=True)
    red = sum(check.verdict is Verdict.FAIL for check in checks)
    amber = sum(check.verdict is Verdict.WARN for check in checks)
    if red:
        console.print(f"[bold red]red[/]: {red} to mend before arming, {amber} to look at")
    else:
        console.print(f"[bold green]green[/]: fit to arm, {amber} to look at")
