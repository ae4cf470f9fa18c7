"""Telemetry over MQTT: an edge. Says what happens, hears commands; a broker that is away or slow costs the flight nothing.

Topics, below the prefix: `telemetry` (newest state; the oldest is dropped when the broker is slow), `event`, `report`
(wait on disk until delivered), `status` (retained: online or offline), `ack` (answers), `command` (heard).
aiomqtt 2.5 does not reconnect by itself: the loop here does. Its connect runs in the default executor.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import ssl
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import aiomqtt

from companion.config import TelemetryConfig
from companion.errors import LinkError
from companion.messages import Event, OperatorCommand, OperatorCommandKind
from companion.recording.codec import encode, encode_value
from companion.telemetry.commands import MAX_PAYLOAD_BYTES, CommandGate
from companion.telemetry.spool import Letter, Spool

QUEUED = 64  # newest telemetry that waits for the broker
DEADLINE_S = 5.0  # for one answer of the broker; then it counts as gone
KEEPALIVE_S = 10
BACKOFF_S = (0.5, 10.0)
MAX_INCOMING = 64

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Broker:
    host: str
    port: int
    prefix: str
    username: str | None
    password: str | None
    is_tls: bool


def parse_broker(url: str) -> Broker:
    """mqtt[s]://[USER:PASSWORD@]HOST[:PORT][/PREFIX]. Raises: LinkError: not such an address."""
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError as error:
        raise LinkError(f"telemetry.mqtt_url {url}: {error}") from None
    if parts.scheme not in ("mqtt", "mqtts") or not parts.hostname:
        raise LinkError(f"telemetry.mqtt_url {url}: expected mqtt://HOST:PORT/PREFIX or mqtts://HOST:PORT/PREFIX")
    prefix = parts.path.strip("/") or "stockpilot"
    if parts.fragment or parts.query or url.endswith("#") or any(c in prefix for c in "+$\0"):
        raise LinkError(f"telemetry.mqtt_url {url}: the prefix may not contain +, # or $")
    is_tls = parts.scheme == "mqtts"
    return Broker(
        host=parts.hostname,
        port=port or (8883 if is_tls else 1883),
        prefix=prefix,
        username=None if parts.username is None else unquote(parts.username),
        password=None if parts.password is None else unquote(parts.password),
        is_tls=is_tls,
    )


class Telemetry:
    """`offer`, `event` and `report` return at once; `run` is the task that talks to the broker until cancelled.

    Args:
        spool: folder for what must arrive. on_command: called for each command that is let through.
        on_refused: told why one was not (for the log of events).
    Raises: LinkError: cfg.mqtt_url is not an address of a broker.
    """

    def __init__(
        self,
        cfg: TelemetryConfig,
        spool: Path,
        *,
        on_command: Callable[[OperatorCommand], None],
        on_refused: Callable[[str], None] = lambda reason: None,
        now_ns: Callable[[], int] = time.monotonic_ns,
        wall_s: Callable[[], float] = time.time,
    ) -> None:
        if cfg.mqtt_url is None:
            raise LinkError("telemetry.mqtt_url is not set: expected mqtt://HOST:PORT/PREFIX")
        self.broker = parse_broker(cfg.mqtt_url)
        self.gate = CommandGate()
        self.is_connected = False
        self.dropped = 0
        self.published = 0
        self.reconnects = 0
        self._period_ns = round(1e9 / cfg.rate_hz)
        self._offered_ns: int | None = None
        self._on_command = on_command
        self._on_refused = on_refused
        self._now_ns = now_ns
        self._wall_s = wall_s
        self._newest: deque[Letter] = deque()
        self._answers: deque[Letter] = deque(maxlen=QUEUED)
        self._to_spool: deque[Letter] = deque(maxlen=4096)
        self._spool = Spool(spool)
        self._wake = asyncio.Event()
        self._spooled = asyncio.Event()
        self._all_said = asyncio.Event()
        if not self.waiting:
            self._all_said.set()

    # ---- said by the flight ------------------------------------------------------------------------------------------

    def offer(self, state: dict[str, Any]) -> None:
        """The newest state, at most rate_hz times a second; more often is left out."""
        now_ns = self._now_ns()
        if self._offered_ns is not None and now_ns - self._offered_ns < self._period_ns:
            return
        self._offered_ns = now_ns
        if len(self._newest) >= QUEUED:
            self._newest.popleft()
            self.dropped += 1
        self._newest.append(Letter("telemetry", encode_value(state)))
        self._all_said.clear()
        self._wake.set()

    def event(self, event: Event) -> None:
        self._keep(Letter("event", encode(event)))

    def report(self, report: dict[str, Any]) -> None:
        self._keep(Letter("report", encode_value(report)))

    @property
    def waiting(self) -> int:
        """Events and reports that the broker does not have yet."""
        return len(self._to_spool) + len(self._spool)

    async def flush(self, timeout_s: float) -> bool:
        """Wait until events and reports are delivered; False: they wait on disk for the next start."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                await self._all_said.wait()
        return self.waiting == 0

    async def run(self) -> None:
        """Until cancelled. Never ends by itself, whatever the broker does."""
        async with asyncio.TaskGroup() as group:
            group.create_task(self._persist(), name="telemetry spool")
            group.create_task(self._stay_connected(), name="telemetry broker")

    # ---- within ------------------------------------------------------------------------------------------------------

    def _keep(self, letter: Letter) -> None:
        self._to_spool.append(letter)
        self._all_said.clear()
        self._spooled.set()

    async def _persist(self) -> None:
        """Writes what must arrive to disk, off the event loop."""
        while True:
            await self._spooled.wait()
            self._spooled.clear()
            while self._to_spool:
                await asyncio.to_thread(self._spool.put, self._to_spool[0])
                self._to_spool.popleft()
                self._wake.set()

    async def _stay_connected(self) -> None:
        wait_s = BACKOFF_S[0]
        while True:
            began = time.monotonic()
            try:
                await self._converse()
            except* Exception as group:  # whatever it is, the next attempt comes
                _logger.info("MQTT broker %s:%d: %s", self.broker.host, self.broker.port, group.exceptions[0])
            self.is_connected = False
            self.reconnects += 1
            wait_s = BACKOFF_S[0] if time.monotonic() - began > BACKOFF_S[1] else min(2 * wait_s, BACKOFF_S[1])
            await asyncio.sleep(wait_s)

    async def _converse(self) -> None:
        broker = self.broker
        offline = aiomqtt.Will(f"{broker.prefix}/status", b"offline", qos=1, retain=True)
        async with aiomqtt.Client(
            broker.host,
            broker.port,
            username=broker.username,
            password=broker.password,
            tls_context=ssl.create_default_context() if broker.is_tls else None,
            will=offline,
            keepalive=KEEPALIVE_S,
            timeout=DEADLINE_S,
            max_queued_incoming_messages=MAX_INCOMING,
        ) as client:
            await client.subscribe(f"{broker.prefix}/command", qos=1)
            await client.publish(f"{broker.prefix}/status", b"online", qos=1, retain=True)
            self.is_connected = True
            try:
                async with asyncio.TaskGroup() as group:
                    group.create_task(self._listen(client))
                    group.create_task(self._speak(client))
            finally:  # said by ourselves on a clean end; by the broker, as our will, on any other
                with contextlib.suppress(Exception):
                    await client.publish(f"{broker.prefix}/status", b"offline", qos=1, retain=True, timeout=1.0)

    async def _listen(self, client: aiomqtt.Client) -> None:
        async for message in client.messages:
            payload = message.payload
            if isinstance(payload, (bytes, bytearray)):
                self._hear(bytes(payload[: MAX_PAYLOAD_BYTES + 1]), is_retained=bool(message.retain))

    def _hear(self, payload: bytes, *, is_retained: bool) -> None:
        verdict = self.gate.judge(payload, is_retained=is_retained, wall_s=self._wall_s())
        if verdict.kind is not None:
            self._on_command(OperatorCommand(t_ns=self._now_ns(), kind=verdict.kind, source="mqtt"))
        elif not verdict.is_accepted:
            self._on_refused(verdict.reason)
        answer = {"id": verdict.id, "accepted": verdict.is_accepted, "reason": verdict.reason}
        if verdict.kind is OperatorCommandKind.ABORT:
            answer["command"] = verdict.kind.value
        self._answers.append(Letter("ack", encode_value(answer)))
        self._wake.set()

    async def _speak(self, client: aiomqtt.Client) -> None:
        """Answers first, then what must arrive, then the newest state."""
        while True:
            while self._answers:
                await self._publish(client, self._answers[0], qos=1)
                self._answers.popleft()
            kept = await asyncio.to_thread(self._spool.oldest) if len(self._spool) else None
            if kept is not None:
                name, letter = kept
                await self._publish(client, letter, qos=1)
                await asyncio.to_thread(self._spool.remove, name)
            elif self._newest:
                await self._publish(client, self._newest.popleft(), qos=1)
            else:
                self._wake.clear()
                if not (self._answers or self._newest or self.waiting):
                    self._all_said.set()
                if not (self._answers or self._newest or len(self._spool)):
                    await self._wake.wait()

    async def _publish(self, client: aiomqtt.Client, letter: Letter, *, qos: int) -> None:
        await client.publish(f"{self.broker.prefix}/{letter.topic}", letter.payload, qos=qos)
        self.published += 1
