"""`stockpilot fly`: the companion on real links, as on the vehicle."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import typer
from rich.console import Console

from companion.app import App
from companion.computer import read_computer
from companion.config import TelemetryConfig
from companion.errors import FileFormatError
from companion.flight import Flight
from companion.garbage import collected_seldom
from companion.mapping.export import save_point_map
from companion.mavlink.keys import open_signer
from companion.messages import Event, PointMap, Severity, VolumeReport
from companion.recording.log import Recorder
from companion.recording.manifest import write_manifest
from companion.telemetry.mqtt import Telemetry
from companion.topics import EVENT, VOLUME, Topic
from companion.warm_up import warm_up
from stockpilot.files import fresh_folder, turned_keys, volume_keys, write_json, write_trajectory
from stockpilot.mission import Mission, load_mission
from stockpilot.recorded import listen, open_recorder
from stockpilot.telemetry import DELIVERY_S, mqtt_task, mqtt_telemetry

HOUSEKEEPING_PERIOD_S = 1.0
STYLES = {Severity.WARNING: "yellow", Severity.NOTICE: "cyan", Severity.INFO: "dim", Severity.DEBUG: "dim"}


def fly_command(
    path: Path, *, connect: str, lidar: str, lidar_metadata: Path | None, out: Path | None, settings: list[str],
    record: bool, as_json: bool,
) -> int:  # fmt: skip
    """Exit code: 0 completed, 1 not."""
    mission = load_mission(path, settings, with_world=False)
    metadata = _read_metadata(lidar_metadata)
    asked = out or Path("runs") / f"{mission.name}-{time.strftime('%Y%m%d-%H%M%S')}"
    folder = fresh_folder(asked)
    console = Console(stderr=True)
    if folder != asked:
        console.print(f"[bold yellow]{asked} holds a flight already: this one is recorded in {folder}[/]")
    key_file = mission.companion.mavlink.signing_key_file
    signer = open_signer(Path(key_file)) if key_file is not None else None
    flight = Flight(config=mission.companion, lidar_metadata_json=metadata, signer=signer)
    recorder: Recorder | None = None
    if record and mission.companion.recording.enabled:
        recorder = open_recorder(folder, mission, lidar_metadata_json=metadata, autopilot="unknown", threaded=True)
        listen(recorder, flight)
    _tell_events(flight, console)
    app = App(flight=flight, connect=connect, lidar=lidar, on_sent=recorder.output if recorder else None)
    app.housekeeping = _housekeeping(recorder, flight, folder)
    spool = asked / "mqtt"  # what an earlier start could not deliver waits there
    if mission.companion.telemetry.mqtt_url is not None:
        app.telemetry = mqtt_task(mqtt_telemetry(mission.companion.telemetry, flight, spool), flight)
    console.print("warming up (half a minute the first time on a computer) ...", style="dim")
    warm_up(mission.companion)
    began = time.monotonic()
    try:
        with collected_seldom():
            asyncio.run(
                app.run(ready=lambda: console.print(f"listening on {connect} and {lidar}; Ctrl-C lands the vehicle"))
            )
        report = flight_report(mission, flight, app, time.monotonic() - began)
        console.print("measuring ...", style="dim")
        volume = flight.measure() if flight.mapper.size else None
        if recorder is not None and volume is not None:
            recorder.tap(VOLUME, time.monotonic_ns(), volume)
    finally:
        if recorder is not None:
            recorder.close(_outcome(flight))
    report.update(volume_keys(volume))
    _write(folder, flight, report, volume)
    if app.telemetry is not None:
        asyncio.run(_deliver(mission.companion.telemetry, spool, report))
    if as_json:
        typer.echo((folder / "report.json").read_text(encoding="utf-8").rstrip())
    else:
        from stockpilot.report import text_summary

        Console().print(text_summary(report))
        typer.echo(f"results in {folder}")
    return 0 if report["state"] == "completed" else 1


def flight_report(mission: Mission, flight: Flight, app: App, wall_time_s: float) -> dict[str, Any]:
    """What is known of a flight without truth."""
    navigation = flight.navigation
    return {
        "mission": mission.name,
        "autopilot": flight.session.autopilot,
        **_outcome(flight),
        "forward_speed_mps": mission.companion.navigator.forward_speed_mps,
        "scan_period_s": mission.companion.odometry.keyframe_period_s,
        "wall_distance_m": mission.companion.navigator.wall_distance_m,
        "height_m": mission.companion.navigator.height_m,
        "wall_time_s": wall_time_s,
        "scans": flight.scans,
        "scans_dropped": app.scans_dropped,
        "keyframes": len(flight.keyframes),
        "lap_closed": bool(navigation is not None and navigation.lap_closed),
        **turned_keys(flight.lidar_turned_by),
        "odometry_max_gap_s": flight.odometry_max_gap_s,
        "cadence": app.cadence.report(),
        "longest_lag_s": app.cadence.longest_lag_s,
        "lidar_dropped": dict(flight.decoder.dropped),
        "events": [
            {"t_s": (e.t_ns - flight.events[0].t_ns) * 1e-9, "severity": e.severity.name, "name": e.name, "text": e.text}
            for e in flight.events
        ],
    }  # fmt: skip


def _outcome(flight: Flight) -> dict[str, str]:
    navigation = flight.navigation
    if navigation is None:
        return {"state": "not started", "reason": "the flight controller was never heard"}
    return {"state": navigation.outcome or navigation.state.value, "reason": navigation.reason}


async def _deliver(cfg: TelemetryConfig, spool: Path, report: dict[str, Any]) -> None:
    """The report to the broker; what it does not take in time waits on disk for the next start."""
    telemetry = Telemetry(cfg, spool, on_command=lambda command: None)
    telemetry.report({key: value for key, value in report.items() if key != "events"})
    link = asyncio.create_task(telemetry.run())
    await telemetry.flush(DELIVERY_S)
    link.cancel()
    await asyncio.gather(link, return_exceptions=True)


def _write(folder: Path, flight: Flight, report: dict[str, Any], volume: VolumeReport | None) -> None:
    from stockpilot.report import write_report_page

    point_map = flight.mapper.point_map()
    save_point_map(point_map, folder / "map.ply")
    save_point_map(point_map, folder / "map.laz")
    write_trajectory(folder / "trajectory.tum", flight.keyframes)
    pictures = _draw(folder, flight, point_map, volume, report["mission"]) if len(point_map.points_map) else {}
    write_report_page(folder / "report.html", report, pictures)
    write_json(folder / "report.json", report)
    write_manifest(folder)


def _draw(
    folder: Path, flight: Flight, point_map: PointMap, volume: VolumeReport | None, title: str
) -> dict[str, Path]:
    """Pictures, where matplotlib is: it comes with the extra `sim` and need not be on a vehicle."""
    try:
        from stockpilot.pictures import draw_map, draw_surface, draw_trajectory
    except ImportError:
        return {}
    path = np.array([e.position_map_m for e in flight.keyframes], dtype=np.float64).reshape(-1, 3)
    walls = [volume.footprint_m] if volume is not None and len(volume.footprint_m) else []
    pictures = {
        "trajectory": draw_trajectory(
            folder / "trajectory.png",
            outlines=walls,
            truth_world_m=None,
            estimated_world_m=path[:, :2],
            title=title,
        ),
        "map": draw_map(folder / "map.png", point_map),
    }
    if volume is not None:
        pictures["surface"] = draw_surface(folder / "surface.png", volume)
    return pictures


def _read_metadata(path: Path | None) -> str | None:
    if path is None:
        return None
    try:
        text = path.read_text(encoding="utf-8")
        json.loads(text)
    except (OSError, ValueError) as error:
        raise FileFormatError(
            f"--lidar-metadata {path}: expected the sensor's metadata JSON (from its web page, or sim --metadata): {error}"
        ) from None
    return text


def _tell_events(flight: Flight, console: Console) -> None:
    """Events on the terminal too."""
    inner = flight.tap

    def tap(topic: Topic, t_ns: int, message: object) -> None:
        inner(topic, t_ns, message)
        if topic is EVENT and isinstance(message, Event):
            console.print(
                f"[{STYLES.get(message.severity, 'bold red')}]{message.severity.name.lower():8} {message.text}[/]"
            )

    flight.tap = tap


def _housekeeping(recorder: Recorder | None, flight: Flight, folder: Path) -> Callable[[], Any]:
    """Once a second: how the recording and the computer fare."""

    async def watch() -> None:
        while True:
            await asyncio.sleep(HOUSEKEEPING_PERIOD_S)
            now = time.monotonic_ns()
            flight.on_computer(read_computer(now, folder))
            for event in recorder.take_events(now) if recorder is not None else ():
                flight.on_event(event)

    return watch
