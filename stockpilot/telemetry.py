"""MQTT for a flight: its state at a low rate, its events and its report, an operator's commands back."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

from companion.config import TelemetryConfig
from companion.flight import Flight
from companion.geometry import yaw_from_quat
from companion.messages import Event
from companion.telemetry.mqtt import Telemetry
from companion.topics import EVENT, Topic

DELIVERY_S = 5.0  # how long a finished flight waits for the broker; what is left waits on disk


def mqtt_telemetry(cfg: TelemetryConfig, flight: Flight, spool: Path) -> Telemetry:
    """Telemetry that hears this flight's events and passes commands on. Raises: LinkError: not a broker's address."""
    telemetry = Telemetry(cfg, spool, on_command=flight.on_operator)
    inner = flight.tap

    def tap(topic: Topic, t_ns: int, message: object) -> None:
        inner(topic, t_ns, message)
        if topic is EVENT and isinstance(message, Event):
            telemetry.event(message)

    flight.tap = tap
    return telemetry


def mqtt_task(telemetry: Telemetry, flight: Flight) -> Callable[[], Awaitable[None]]:
    """The task to supervise: offers the state while `Telemetry.run` talks to the broker."""

    async def offer() -> None:
        while True:
            telemetry.offer(flight_state(flight))
            await asyncio.sleep(0.1)

    async def run() -> None:
        async with asyncio.TaskGroup() as group:
            group.create_task(offer(), name="telemetry state")
            group.create_task(telemetry.run(), name="telemetry link")

    return run


def flight_state(flight: Flight) -> dict[str, Any]:
    """What an operator looks at: state, pose in map, quality, progress."""
    estimate, navigation = flight.estimate, flight.navigation
    state: dict[str, Any] = {"scans": flight.scans, "keyframes": len(flight.keyframes)}
    if navigation is not None:
        state |= {"state": navigation.state.value, "progress_ratio": navigation.progress_ratio}
        state |= {"lap_closed": navigation.lap_closed, "path_length_m": navigation.path_length_m}
    if estimate is not None:
        state |= {"position_map_m": [float(v) for v in estimate.position_map_m], "quality": estimate.quality}
        state |= {"yaw_rad": yaw_from_quat(estimate.q_map_body_wxyz), "is_degenerate": estimate.is_degenerate}
    return state
