"""The operator's own line to a vehicle, through MAVSDK: an independent client, beside the companion's link."""

from __future__ import annotations

import asyncio
import json
import time
from collections import Counter, deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any

from companion.errors import LinkError
from companion.mavlink.wire import COMP_COMPANION, COMP_ESTIMATOR

GROUND_SYSTEM = 255  # a ground station's own, MAV_COMP_ID_MISSIONPLANNER
GROUND_COMPONENT = 190
AUTOPILOT = 1
_TEXTS = 200
_AUTOPILOTS = {3: "ardupilot", 12: "px4"}  # MAV_AUTOPILOT

Fields = dict[str, Any]


@dataclass
class VehicleLink:
    """A vehicle that was found. `newest`: last message of each name from the autopilot, `counts`: how many so far."""

    url: str
    system: Any
    direct: Any
    system_id: int = 1
    autopilot: str | None = None
    newest: dict[str, Fields] = field(default_factory=dict)
    arrived_s: dict[str, float] = field(default_factory=dict)
    counts: Counter[str] = field(default_factory=Counter)
    texts: deque[tuple[int, str]] = field(default_factory=lambda: deque(maxlen=_TEXTS))
    version: str | None = None
    has_companion: bool = False  # heard a companion's heartbeat for the same vehicle
    _chunks: dict[int, str] = field(default_factory=dict)
    _trips_s: dict[int, float] = field(default_factory=dict)

    async def listen(self) -> None:
        """Take in every message, until cancelled."""
        async for message in self.direct.subscribe_message(""):
            if message.component_id != AUTOPILOT:
                self.has_companion = self.has_companion or message.component_id in (COMP_COMPANION, COMP_ESTIMATOR)
                continue
            name = message.message_name
            try:
                fields: Fields = json.loads(message.fields_json)
            except ValueError:
                continue
            self.newest[name] = fields
            self.arrived_s[name] = time.monotonic()
            self.counts[name] += 1
            if name == "HEARTBEAT":
                self.autopilot = _AUTOPILOTS.get(int(fields.get("autopilot", 0)), "other")
            elif name == "TIMESYNC" and fields.get("tc1"):
                self._trips_s[int(fields["ts1"])] = (time.monotonic_ns() - int(fields["ts1"])) * 1e-9
            elif name == "STATUSTEXT":
                self._take_text(fields)

    def _take_text(self, fields: Fields) -> None:
        """Chunks of one id belong together; MAVSDK hands out each."""
        text, number = str(fields.get("text", "")), int(fields.get("id", 0) or 0)
        if number:
            text = self._chunks.pop(number, "") + text
            if len(str(fields.get("text", ""))) == 50:
                self._chunks[number] = text
                return
        self.texts.append((int(fields.get("severity", 6)), text.strip()))

    async def send(self, name: str, fields: Fields) -> None:
        """Send any message to the autopilot. Raises: LinkError."""
        from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectError, MavlinkMessage

        message = MavlinkMessage(
            message_name=name,
            system_id=GROUND_SYSTEM,
            component_id=GROUND_COMPONENT,
            target_system_id=int(fields.get("target_system", self.system_id)),
            target_component_id=int(fields.get("target_component", AUTOPILOT)),
            fields_json=json.dumps({"message_name": name, **fields}),
        )
        try:
            await self.direct.send_message(message)
        except MavlinkDirectError as error:
            raise LinkError(f"{self.url}: {name} could not be sent: {error}") from None

    async def command(self, number: int, *params: float) -> None:
        """COMMAND_LONG, without waiting for its answer."""
        fields: Fields = {f"param{i + 1}": 0.0 for i in range(7)}
        fields |= {f"param{i + 1}": value for i, value in enumerate(params)}
        ids = {"target_system": self.system_id, "target_component": AUTOPILOT}
        await self.send("COMMAND_LONG", {**fields, **ids, "command": number, "confirmation": 0})

    async def wait_for_timesync(self, asked_ns: int, timeout_s: float) -> float | None:
        """How long the answer to our question took, s."""
        end = time.monotonic() + timeout_s
        while asked_ns not in self._trips_s:
            if time.monotonic() >= end:
                return None
            await asyncio.sleep(0.002)
        return self._trips_s.pop(asked_ns)

    async def wait_for(self, name: str, timeout_s: float) -> Fields | None:
        """The next message of that name; None when none comes."""
        before = self.counts[name]
        end = time.monotonic() + timeout_s
        while self.counts[name] == before:
            if time.monotonic() >= end:
                return None
            await asyncio.sleep(0.02)
        return self.newest[name]


@asynccontextmanager
async def open_vehicle(url: str, timeout_s: float = 10.0) -> AsyncIterator[VehicleLink]:
    """Connect and wait for the autopilot's heartbeat. Raises: LinkError: address, what was awaited, how to mend it."""
    from mavsdk.asyncio import Configuration, Mavsdk, MavsdkConnectionError
    from mavsdk.asyncio.plugins.mavlink_direct import MavlinkDirectAsync
    from mavsdk.logging import log_subscribe

    log_subscribe(lambda *_: True)  # stdout is for results
    async with Mavsdk(Configuration.create_manual(GROUND_SYSTEM, GROUND_COMPONENT, True)) as mavsdk:
        try:
            await mavsdk.add_any_connection(url)
        except MavsdkConnectionError as error:
            raise LinkError(
                f"--connect {url}: cannot be opened: {error}. Expected udpin://HOST:PORT, udpout://HOST:PORT, "
                "tcpin://, tcpout:// or serial://DEVICE:BAUD; is another program listening there?"
            ) from None
        system = await mavsdk.first_autopilot(timeout_s=timeout_s)
        if system is None:
            raise LinkError(
                f"--connect {url}: no autopilot's heartbeat within {timeout_s:g} s: is it powered, does it send to "
                "this address, is the port right (ground station: 14550)?"
            )
        system_id = await system.get_system_id()
        link = VehicleLink(url=url, system=system, direct=MavlinkDirectAsync(system), system_id=system_id)
        listener = asyncio.create_task(link.listen())
        try:
            await link.wait_for("HEARTBEAT", 3.0)
            yield link
        finally:
            listener.cancel()
            await asyncio.gather(listener, return_exceptions=True)
