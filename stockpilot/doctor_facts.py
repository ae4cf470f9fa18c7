"""Gathers what the doctor's checks need to know: from the autopilot through MAVSDK, and from this computer."""

from __future__ import annotations

import asyncio
import datetime
import math
import shutil
import socket
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from companion.mavlink.ardupilot import ARDUPILOT
from companion.mavlink.checks import Facts, SentVision
from companion.mavlink.dialect import Dialect
from companion.mavlink.px4 import PX4
from stockpilot.addresses import parse_address
from stockpilot.doctor_params import read_parameters
from stockpilot.doctor_probe import Probe, ensure_origin, send_pose
from stockpilot.vehicle_link import VehicleLink

_DIALECTS: dict[str, Dialect] = {"px4": PX4, "ardupilot": ARDUPILOT}
_ARMED = 128
_ON_GROUND = 1
# SYS_STATUS, ATTITUDE, ATTITUDE_QUATERNION, LOCAL_POSITION_NED, DISTANCE_SENSOR, EXTENDED_SYS_STATE
_STREAMS_HZ = {1: 2.0, 30: 10.0, 31: 10.0, 32: 5.0, 132: 2.0, 245: 2.0}
_SETTLE_S = 1.2
_HEARTBEAT_FRESH_S = 1.6


@dataclass(frozen=True, slots=True, kw_only=True)
class Surroundings:
    """lidar: udp://HOST:PORT where packets should arrive; empty: not looked at. folder: whose disk is to be free."""

    lidar: str = ""
    folder: Path = Path()


async def gather(link: VehicleLink, around: Surroundings, *, probe: Probe | None, seconds: float) -> Facts:
    """All facts; takes a little longer than `seconds`, twice that with a probe."""
    dialect = _DIALECTS.get(link.autopilot or "")
    if dialect is None:
        return Facts(autopilot=link.autopilot)
    before = (time.time(), time.monotonic())
    parameters = await read_parameters(link)
    await _ask_for_streams(link, dialect)
    lidar_task = asyncio.create_task(asyncio.to_thread(_listen_to_lidar, around.lidar, min(seconds, 2.0)))
    started, counts = time.monotonic(), Counter(link.counts)
    round_trip = await _round_trip(link)
    await asyncio.sleep(max(0.0, seconds - (time.monotonic() - started)))
    span = time.monotonic() - started
    rates = {name: (link.counts[name] - counts[name]) / span for name in link.counts}
    if time.monotonic() - link.arrived_s.get("HEARTBEAT", 0.0) < _HEARTBEAT_FRESH_S:
        rates["HEARTBEAT"] = max(rates["HEARTBEAT"], 1.0 / _HEARTBEAT_FRESH_S)  # rarer than a short look is long

    flags = _flags(link, dialect)
    fused = None if flags is None else dialect.is_vision_fused(flags)
    vision: SentVision | None = None
    ratios = _ratios(link)
    if probe is not None and _may_probe(link, probe, fused):
        holds_position = dialect is PX4 and flags is not None and dialect.is_position_valid(flags)
        if await ensure_origin(link, may_set=not holds_position):  # never under a fused position (PX4.md, 6)
            vision, ratios, fused, flags = await _probe(link, dialect, probe, seconds)
    else:
        await _look_for_origin(link)
    packets_hz, sources = await lidar_task
    origin = link.newest.get("GPS_GLOBAL_ORIGIN")
    status = link.newest.get("SYS_STATUS", {})
    remaining = status.get("battery_remaining")
    return Facts(
        autopilot=link.autopilot,
        version=link.version or await _version(link),
        is_armed=_is_armed(link),
        parameters=parameters,
        rates_hz=rates,
        timesync_round_trip_s=round_trip,
        has_origin=origin is not None,
        origin_altitude_m=float(origin["altitude"]) / 1e3 if origin else None,
        sensors_present=status.get("onboard_control_sensors_present"),
        sensors_health=status.get("onboard_control_sensors_health"),
        battery_ratio=remaining / 100.0 if isinstance(remaining, int) and 0 <= remaining <= 100 else None,
        estimator_flags=flags,
        is_vision_fused=fused,
        ratios=ratios,
        texts=tuple(text for _, text in link.texts),
        lidar_packets_hz=packets_hz,
        lidar_sources=sources,
        clock_drift_s=(time.time() - before[0]) - (time.monotonic() - before[1]),
        clock_year=datetime.datetime.now(tz=datetime.UTC).year,
        disk_free_gib=shutil.disk_usage(around.folder.resolve()).free / 2**30,
        vision=vision,
    )


async def _probe(
    link: VehicleLink, dialect: Dialect, probe: Probe, seconds: float
) -> tuple[SentVision, dict[str, float], bool | None, int | None]:
    """Send the test pose, and watch what the estimator makes of it while it goes on."""
    seen: list[tuple[int, dict[str, float]]] = []  # each status report after settling
    counted = 0

    async def watch() -> None:
        nonlocal counted
        await asyncio.sleep(_SETTLE_S)
        while True:
            await asyncio.sleep(0.05)
            flags, count = _flags(link, dialect), link.counts[_status_name(dialect)]
            if flags is not None and count != counted:
                counted = count
                seen.append((flags, _ratios(link)))

    watcher = asyncio.create_task(watch())
    try:
        vision = await send_pose(link, probe, seconds + _SETTLE_S)
    finally:
        watcher.cancel()
    flags = seen[-1][0] if seen else _flags(link, dialect)
    return (
        vision,
        _lasting([ratios for _, ratios in seen]),
        None if flags is None else dialect.is_vision_fused(flags),
        flags,
    )


def _lasting(reports: list[dict[str, float]]) -> dict[str, float]:
    """The highest that each ratio held for three reports on end: a single high one is a start, not a disagreement."""
    out: dict[str, float] = {}
    for name in sorted({name for report in reports for name in report}):
        values = [report.get(name, 0.0) for report in reports]
        windows = [min(values[i : i + 3]) for i in range(max(1, len(values) - 2))]
        out[name] = max(windows)
    return out


def _status_name(dialect: Dialect) -> str:
    return "ESTIMATOR_STATUS" if dialect is PX4 else "EKF_STATUS_REPORT"


def _is_armed(link: VehicleLink) -> bool:
    return bool(int(link.newest.get("HEARTBEAT", {}).get("base_mode", 0)) & _ARMED)


def _may_probe(link: VehicleLink, probe: Probe, fused: bool | None) -> bool:
    """Never with motors on or off the ground, nor against a vision that is already fused."""
    landed = link.newest.get("EXTENDED_SYS_STATE", {}).get("landed_state", 0)
    is_safe = not _is_armed(link) and landed in (0, _ON_GROUND)
    return is_safe and not fused and (probe.is_forced or not link.has_companion)


async def _ask_for_streams(link: VehicleLink, dialect: Dialect) -> None:
    wanted = {**_STREAMS_HZ, dialect.estimator_message: 5.0}
    for msg_id, rate_hz in wanted.items():
        await link.command(511, float(msg_id), 1e6 / rate_hz)  # MAV_CMD_SET_MESSAGE_INTERVAL


async def _look_for_origin(link: VehicleLink) -> None:
    if "GPS_GLOBAL_ORIGIN" not in link.newest:
        await link.command(512, 49.0)
        await link.wait_for("GPS_GLOBAL_ORIGIN", 1.0)


async def _round_trip(link: VehicleLink) -> float | None:
    """The quickest of five TIMESYNC exchanges, s; None when none is answered."""
    best: float | None = None
    for _ in range(5):
        asked = time.monotonic_ns()
        await link.send("TIMESYNC", {"tc1": 0, "ts1": asked, "target_system": 0, "target_component": 0})
        answered = await link.wait_for_timesync(asked, 0.3)
        if answered is not None:
            best = answered if best is None else min(best, answered)
    return best


def _flags(link: VehicleLink, dialect: Dialect) -> int | None:
    newest = link.newest.get(_status_name(dialect))
    return None if newest is None else int(newest["flags"])


def _ratios(link: VehicleLink) -> dict[str, float]:
    """PX4's innovation test ratios of what is fused. (ArduPilot's variances do not move with vision.)"""
    newest = link.newest.get("ESTIMATOR_STATUS", {})
    names = {
        "velocity": "vel_ratio",
        "position": "pos_horiz_ratio",
        "height": "pos_vert_ratio",
        "heading": "mag_ratio",
    }
    found = {name: newest.get(key) for name, key in names.items()}
    return {name: float(r) for name, r in found.items() if isinstance(r, int | float) and math.isfinite(r)}


async def _version(link: VehicleLink) -> str | None:
    from mavsdk.asyncio.plugins.info import InfoAsync, InfoError

    info = InfoAsync(link.system)
    for _ in range(3):
        try:
            v = await info.get_version()
        except InfoError:
            await asyncio.sleep(0.5)
        else:
            link.version = f"{v.flight_sw_major}.{v.flight_sw_minor}.{v.flight_sw_patch}"
            return link.version
    return None


def _listen_to_lidar(url: str, seconds: float) -> tuple[float | None, tuple[str, ...]]:
    """Packets a second and their senders; None where the port cannot be had (the companion has it: it will say)."""
    if not url:
        return None, ()
    _, host, port = parse_address(url, ("udp", "udpin"), option="--lidar")
    sources: set[str] = set()
    packets = 0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sensor:
        try:
            sensor.bind((host, port))
        except OSError:
            return None, ()
        sensor.settimeout(0.2)
        begin = time.monotonic()
        while time.monotonic() - begin < seconds:
            try:
                _, sender = sensor.recvfrom(65536)
            except TimeoutError:
                continue
            packets += 1
            sources.add(str(sender[0]))
    return packets / seconds, tuple(sorted(sources))
