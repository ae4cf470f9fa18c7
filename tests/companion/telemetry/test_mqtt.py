"""Telemetry against a real broker, which also goes away, hangs and comes back."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path

import aiomqtt
import pytest

from companion.config import TelemetryConfig
from companion.errors import LinkError
from companion.messages import Event, OperatorCommand, OperatorCommandKind, Severity
from companion.telemetry.mqtt import QUEUED, Telemetry, parse_broker
from companion.telemetry.spool import Letter, Spool

from .conftest import Mosquitto


def an_event(n: int) -> Event:
    return Event(t_ns=n, severity=Severity.INFO, name=f"event_{n}", text=f"number {n}")


class Side:
    """A Telemetry with what it passed on."""

    def __init__(self, broker: Mosquitto, folder: Path, rate_hz: float = 20.0) -> None:
        self.commands: list[OperatorCommand] = []
        self.refused: list[str] = []
        self.telemetry = Telemetry(
            TelemetryConfig(mqtt_url=broker.url, rate_hz=rate_hz),
            folder / "spool",
            on_command=self.commands.append,
            on_refused=self.refused.append,
        )


@contextlib.asynccontextmanager
async def running(side: Side) -> AsyncIterator[Telemetry]:
    task = asyncio.create_task(side.telemetry.run())
    try:
        yield side.telemetry
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


@contextlib.asynccontextmanager
async def ground(broker: Mosquitto) -> AsyncIterator[aiomqtt.Client]:
    async with aiomqtt.Client("127.0.0.1", broker.port) as client:
        await client.subscribe("test/#", qos=1)
        yield client


async def wait_until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(15):
        while not condition():  # noqa: ASYNC110 (what is waited for has no event of its own)
            await asyncio.sleep(0.01)


async def collect(client: aiomqtt.Client, topic: str, count: int) -> list[bytes]:
    got: list[bytes] = []
    async with asyncio.timeout(15):
        async for message in client.messages:
            if str(message.topic) == f"test/{topic}":
                got.append(bytes(message.payload))
                if len(got) == count:
                    break
    return got


async def test_events_and_reports_arrive_in_order(broker: Mosquitto, tmp_path: Path) -> None:
    side = Side(broker, tmp_path)
    async with ground(broker) as client, running(side) as telemetry:
        for n in range(5):
            telemetry.event(an_event(n))
        telemetry.report({"volume_m3": 1000.5, "nothing": float("nan")})
        events = await collect(client, "event", 5)
        (report,) = await collect(client, "report", 1)
        assert await telemetry.flush(10)
    assert [json.loads(e)["t_ns"] for e in events] == [0, 1, 2, 3, 4]
    assert json.loads(report) == {"volume_m3": 1000.5, "nothing": "nan"}
    assert list((tmp_path / "spool").iterdir()) == []


async def test_events_said_while_the_broker_is_away_arrive_when_it_is_back(broker: Mosquitto, tmp_path: Path) -> None:
    broker.stop()
    side = Side(broker, tmp_path)
    async with running(side) as telemetry:
        began = time.monotonic()
        for n in range(3):
            telemetry.event(an_event(n))
        assert time.monotonic() - began < 0.05, "the flight waited for the broker"
        await wait_until(lambda: len(list((tmp_path / "spool").glob("*.json"))) == 3)
        broker.start()
        async with ground(broker) as client:
            assert [json.loads(e)["t_ns"] for e in await collect(client, "event", 3)] == [0, 1, 2]


async def test_events_wait_on_disk_for_the_next_start(broker: Mosquitto, tmp_path: Path) -> None:
    broker.stop()
    first = Side(broker, tmp_path)
    async with running(first) as telemetry:
        telemetry.event(an_event(7))
        assert not await telemetry.flush(0.3)
    broker.start()
    async with ground(broker) as client, running(Side(broker, tmp_path)):
        (event,) = await collect(client, "event", 1)
    assert json.loads(event)["t_ns"] == 7


async def test_hanging_broker_sheds_the_oldest_telemetry_and_never_holds_the_caller(
    broker: Mosquitto, tmp_path: Path
) -> None:
    side = Side(broker, tmp_path)
    side.telemetry._period_ns = 0
    async with running(side) as telemetry:
        await wait_until(lambda: telemetry.is_connected)
        broker.pause()
        slowest = 0.0
        for n in range(3 * QUEUED):
            began = time.monotonic()
            telemetry.offer({"n": n})
            slowest = max(slowest, time.monotonic() - began)
        assert slowest < 0.05
        assert telemetry.dropped >= 2 * QUEUED - 1
        broker.resume()
        await wait_until(lambda: telemetry.published >= QUEUED)


async def test_telemetry_is_held_to_its_rate(broker: Mosquitto, tmp_path: Path) -> None:
    now_ns = 0
    telemetry = Telemetry(
        TelemetryConfig(mqtt_url=broker.url, rate_hz=2),
        tmp_path,
        on_command=lambda command: None,
        now_ns=lambda: now_ns,
    )
    for _ in range(100):
        telemetry.offer({})
        now_ns += 100_000_000
    assert len(telemetry._newest) == 20


async def test_connection_comes_back_after_the_broker_restarts(broker: Mosquitto, tmp_path: Path) -> None:
    side = Side(broker, tmp_path)
    async with running(side) as telemetry:
        await wait_until(lambda: telemetry.is_connected)
        broker.stop()
        await wait_until(lambda: not telemetry.is_connected)
        broker.start()
        await wait_until(lambda: telemetry.is_connected)


async def test_commands_are_passed_on_and_answered(broker: Mosquitto, tmp_path: Path) -> None:
    side = Side(broker, tmp_path)
    async with ground(broker) as client, running(side) as telemetry:
        await wait_until(lambda: telemetry.is_connected)
        hold = {"command": "hold", "id": "h1", "time_s": time.time()}
        for data in (json.dumps(hold).encode(), b"abort", b"\xff" * 500, b"x" * 100_000):
            await client.publish("test/command", data, qos=1)
        answers = [json.loads(a) for a in await collect(client, "ack", 4)]
    assert [c.kind for c in side.commands] == [OperatorCommandKind.HOLD, OperatorCommandKind.ABORT]
    assert all(c.source == "mqtt" for c in side.commands)
    assert [a["accepted"] for a in answers] == [True, True, False, False]
    assert len(side.refused) == 2


async def test_retained_command_does_nothing_to_a_newcomer(broker: Mosquitto, tmp_path: Path) -> None:
    side = Side(broker, tmp_path)
    async with ground(broker) as client:
        stale = {"command": "resume", "id": "r", "time_s": time.time()}
        await client.publish("test/command", json.dumps(stale), qos=1, retain=True)
        async with running(side):
            await wait_until(lambda: side.refused)
    assert side.commands == []
    assert "retained" in side.refused[0]


async def test_status_says_online_and_then_offline(broker: Mosquitto, tmp_path: Path) -> None:
    side = Side(broker, tmp_path)
    async with ground(broker) as client:
        async with running(side) as telemetry:
            await wait_until(lambda: telemetry.is_connected)
        assert await collect(client, "status", 2) == [b"online", b"offline"]


@pytest.mark.parametrize(
    "url", ["http://x", "mqtt://", "mqtt://h:99999", "mqtt://h/a+b", "mqtt://h/#", "1883", "mqtt://h:port"]
)
def test_wrong_broker_address_is_told(url: str) -> None:
    with pytest.raises(LinkError, match="mqtt_url"):
        parse_broker(url)


def test_broker_address_is_taken_apart() -> None:
    broker = parse_broker("mqtts://me:p%40ss@example.org/site/drone1/")
    assert (broker.host, broker.port, broker.prefix) == ("example.org", 8883, "site/drone1")
    assert (broker.username, broker.password, broker.is_tls) == ("me", "p@ss", True)


def test_spool_survives_a_torn_file(tmp_path: Path) -> None:
    spool = Spool(tmp_path)
    spool.put(Letter("event", b"{}"))
    (tmp_path / "000000000000.json").write_text('{"topic": "ev')
    (tmp_path / "000000000009.json.part").write_text("half")
    again = Spool(tmp_path)
    kept = again.oldest()
    assert kept is not None
    assert kept[1] == Letter("event", b"{}")
    assert again.errors == 1


def test_spool_drops_the_oldest_when_it_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.telemetry.spool.MAX_FILES", 3)
    spool = Spool(tmp_path)
    for n in range(5):
        spool.put(Letter("event", b"%d" % n))
    kept = spool.oldest()
    assert kept is not None
    assert (len(spool), spool.dropped, kept[1].payload) == (3, 2, b"2")


def test_spool_on_a_disk_that_cannot_be_written_counts_and_goes_on(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    spool = Spool(blocked / "spool")
    spool.put(Letter("event", b"{}"))
    assert spool.errors == 2
    assert spool.oldest() is None
