"""Parameters through MAVSDK: read those of the manifest, set those that are wrong, read back."""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import dataclass
from typing import Any

from companion.mavlink.checks import Facts, Verdict, check_parameters
from companion.mavlink.manifest import MANIFESTS
from stockpilot.vehicle_link import VehicleLink

_READ_TIMEOUT_S = 6.0


@dataclass(frozen=True, slots=True)
class Change:
    """One parameter that was set. after: as read back; ok: it is what was asked for."""

    name: str
    before: float | None
    after: float
    ok: bool
    needs_reboot: bool


async def read_parameters(link: VehicleLink) -> dict[str, float | None]:
    """The manifest's parameters; None for a name that the autopilot does not have or does not answer."""
    from mavsdk.asyncio.plugins.param import ParamAsync

    manifest = MANIFESTS.get(link.autopilot or "")
    if manifest is None:
        return {}
    param = ParamAsync(link.system)
    values: dict[str, float | None] = {}
    for expected in manifest.parameters:
        for name in (expected.name, *expected.other_names):
            if name not in values:
                values[name] = await _read(param, name)
            if values[name] is not None:
                break  # an older name is asked for only where the new one is not there: silence costs seconds
    return values


async def _read(param: Any, name: str) -> float | None:
    from mavsdk.asyncio.plugins.param import ParamError, ParamResult

    try:
        return float(await asyncio.wait_for(param.get_param_int(name), _READ_TIMEOUT_S))
    except TimeoutError:
        return None
    except ParamError as error:
        if error.result != ParamResult.WRONG_TYPE:
            return None
    try:
        return float(await asyncio.wait_for(param.get_param_float(name), _READ_TIMEOUT_S))
    except (ParamError, TimeoutError):
        return None


async def _write(param: Any, name: str, value: float) -> None:
    """Set by its own type: an integer sent as one to a real parameter is refused. Reading back tells how it went."""
    from mavsdk.asyncio.plugins.param import ParamError, ParamResult

    is_real = False
    try:
        await param.get_param_int(name)
    except ParamError as error:
        is_real = error.result == ParamResult.WRONG_TYPE
    with contextlib.suppress(ParamError):
        await (param.set_param_float(name, value) if is_real else param.set_param_int(name, int(value)))


async def apply_manifest(link: VehicleLink) -> list[Change]:
    """Set what is red or amber to what the manifest says, and read it back."""
    from mavsdk.asyncio.plugins.param import ParamAsync

    values = await read_parameters(link)
    manifest = MANIFESTS.get(link.autopilot or "")
    if manifest is None:
        return []
    wrong = {
        check.name.removeprefix("parameter.")
        for check in check_parameters(Facts(autopilot=link.autopilot, parameters=values))
        if check.verdict in (Verdict.FAIL, Verdict.WARN) and check.actual != "not there"
    }
    param = ParamAsync(link.system)
    changes: dict[str, Change] = {}
    for expected in manifest.parameters:
        for name in (expected.name, *expected.other_names):
            before = values.get(name)
            if name not in wrong or before is None or expected.is_met(before):
                continue
            wanted = expected.mended(before)
            await _write(param, name, wanted)
            after = await _read(param, name)
            ok = after is not None and expected.is_met(after)
            values[name] = after
            told = float("nan") if after is None else after
            first = changes[name].before if name in changes else before
            changes[name] = Change(name, first, told, ok, expected.needs_reboot)
    return list(changes.values())
