"""The tasks around the flight core, on loopback sockets: the beat goes on whatever the rest does."""

from __future__ import annotations

import asyncio
import socket
import time

import pytest

from companion.app import App
from companion.cadence import Cadence
from companion.config import CompanionConfig
from companion.flight import Flight
from companion.messages import Event, LidarScan
from companion.topics import EVENT, Topic


def free_ports(count: int) -> list[int]:
    probes = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    for probe in probes:
        probe.bind(("127.0.0.1", 0))
    ports = [int(probe.getsockname()[1]) for probe in probes]
    for probe in probes:
        probe.close()
    return ports


@pytest.fixture
def app() -> App:
    link, lidar = free_ports(2)
    return App(Flight(CompanionConfig()), connect=f"udpin://127.0.0.1:{link}", lidar=f"udp://127.0.0.1:{lidar}")


def events_of(app: App) -> list[Event]:
    heard: list[Event] = []

    def tap(topic: Topic, t_ns: int, message: object) -> None:
        if topic is EVENT and isinstance(message, Event):
            heard.append(message)

    app.flight.tap = tap
    return heard


async def run_for(app: App, seconds: float) -> None:
    task = asyncio.create_task(app.run())
    await asyncio.sleep(seconds)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


async def test_a_failing_outer_task_is_started_again_and_ends_nothing(app: App) -> None:
    heard = events_of(app)
    calls: list[float] = []

    async def telemetry() -> None:
        calls.append(time.monotonic())
        raise RuntimeError("the broker bites")

    app.telemetry = telemetry
    polled: list[int] = []
    app.flight.record = lambda kind, t_ns, payload, source: polled.append(t_ns) if kind == "poll" else None
    await run_for(app, 1.3)
    assert len(calls) >= 2
    assert app.restarts["telemetry"] >= 2
    assert any(event.name == "telemetry_failed" and "the broker bites" in event.text for event in heard)
    assert polled[-1] > calls[-1] * 1e9, "the beat went on after the failure"


async def test_a_registration_that_hangs_does_not_hold_up_the_beat(app: App, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fault 31: odometry may be late, estimates and setpoints are not made late by it."""
    polled: list[int] = []
    app.flight.record = lambda kind, t_ns, payload, source: polled.append(t_ns) if kind == "poll" else None

    def slow(flight: Flight, scan: LidarScan, t_ns: int) -> object:
        return lambda: time.sleep(0.6)

    monkeypatch.setattr(Flight, "begin_scan", slow)
    app._scans.append(None)  # type: ignore[arg-type]
    app._scan_ready.set()
    await run_for(app, 0.5)
    assert len(polled) > 5


def test_a_beat_that_comes_late_is_told_once_in_a_while() -> None:
    cadence = Cadence()
    told = [
        cadence.lag(0, 150_000_000),
        cadence.lag(1_000_000_000, 150_000_000),
        cadence.lag(11_000_000_000, 20_000_000),
    ]
    assert [event.name for event in told if event is not None] == ["overloaded"]
    assert cadence.longest_lag_s == pytest.approx(0.15)


def test_cadence_measures_what_the_flight_controller_needs() -> None:
    cadence = Cadence()
    odometry = b"\xfd" + bytes(6) + (331).to_bytes(3, "little")
    for n in range(11):
        cadence.sent(odometry, n * 32_000_000)
    cadence.sent(b"\xfd" + bytes(9), 5)
    report = cadence.report()
    assert set(report) == {"odometry"}
    assert report["odometry"]["median_s"] == pytest.approx(0.032)


async def test_sigterm_reaches_the_flight_as_an_abort(app: App) -> None:
    heard: list[bytes] = []
    app.flight.record = lambda kind, t_ns, payload, source: heard.append(payload) if kind == "operator" else None
    app.abort("sigterm")
    assert heard == [b"abort sigterm"]


async def test_abort_without_a_flight_controller_ends_the_program(app: App) -> None:
    """Nothing can be landed: it must not wait for ever."""
    app.give_up_s = 0.3
    running = asyncio.create_task(app.run())
    await asyncio.sleep(0.1)
    app.abort("sigint")
    await asyncio.wait_for(running, 5.0)
