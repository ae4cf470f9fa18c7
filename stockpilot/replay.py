"""`stockpilot replay`: a recorded flight through the same code again, to check it, to tune it, to measure it anew."""

from __future__ import annotations

import contextlib
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import ValidationError

from companion.config import CompanionConfig
from companion.errors import ConfigError, FileFormatError
from companion.flight import Flight
from companion.garbage import collected_seldom
from companion.messages import OdometryEstimate, VolumeReport
from companion.odometry import ScanResult
from companion.recording import ahead, codec
from companion.recording.manifest import require_unaltered
from companion.recording.recover import RECOVERED
from companion.recording.replay import Replay, TopicDifference, compare
from companion.recording.run_files import RunRecording, read_run, recording_path
from companion.recording.tum import tum_line
from companion.topics import VOLUME
from stockpilot.files import finite, make_folder, write_json
from stockpilot.mission import parse_setting
from stockpilot.replay_edit import rebuild_scans

EXIT_DIFFERENT = 1
BESIDE = ("keyframes", "volume_m3", "volume_interval_m3", "seen_ratio")  # of the run's own report, set beside a new one


@dataclass(slots=True)
class Replayed:
    """A flight flown again, and what it took."""

    recording: RunRecording
    config: CompanionConfig
    replay: Replay
    estimates: list[OdometryEstimate]
    wall_time_s: float

    @property
    def flight(self) -> Flight:
        return self.replay.flight

    @property
    def real_time_factor(self) -> float:
        return self.replay.duration_s / self.wall_time_s if self.wall_time_s > 0 else 0.0


def replay_run(path: Path, settings: Sequence[str] = (), *, keep_messages: bool = False) -> Replayed:
    """Fly a recording again.

    Args:
        path: a run's folder or its recording. settings: "key=value" of the companion's configuration.
    Raises: FileFormatError: no recording of a flight, or altered since. ConfigError: a setting is wrong.
    """
    file = recording_path(path)
    require_unaltered(file.parent, [file.name])
    recording = read_run(file, with_topics=keep_messages)
    config = recorded_config(recording, settings)
    lidar = recording.attachments.get("lidar.json")
    metadata = None if lidar is None else lidar.decode()
    if metadata is not None and not any(item.kind == "begin" for item in recording.inputs):
        recording.inputs = rebuild_scans(recording.inputs, metadata)  # packed recordings leave them out
    flight = Flight(config=config, lidar_metadata_json=metadata)
    estimates: list[OdometryEstimate] = []

    def take(result: ScanResult) -> None:
        estimates.append(result.estimate)

    replay = Replay(flight, keep_messages=keep_messages, on_scan=take)
    began = time.perf_counter()
    with collected_seldom(), contextlib.ExitStack() as stack:
        if ahead.is_worthwhile():
            replay.scans = stack.enter_context(ahead.registering(flight, recording.inputs))
        replay.run(recording.inputs)
    return Replayed(recording, config, replay, estimates, time.perf_counter() - began)


def recorded_config(recording: RunRecording, settings: Sequence[str] = ()) -> CompanionConfig:
    """The configuration that flew, changed by settings. Raises: FileFormatError, ConfigError."""
    stored = recording.attachments.get("companion.json")
    if stored is None:
        raise FileFormatError(
            "recording: lacks the attachment companion.json: the configuration that flew is not known"
        )
    content: dict[str, Any] = json.loads(stored)
    for setting in settings:
        location, value = parse_setting(setting)
        if len(location) != 2 or location[0] not in content:
            sections = ", ".join(content)
            raise ConfigError(
                f"--set {setting}: replay changes SECTION.KEY of the companion ({sections}); the world was flown already"
            )
        content[str(location[0])][str(location[1])] = value
    try:
        return CompanionConfig.model_validate(content)
    except ValidationError as error:
        raise ConfigError(
            "\n".join(f"{'.'.join(str(p) for p in e['loc'])} = {e['input']!r}: {e['msg']}" for e in error.errors())
        ) from None


def replay_command(
    run: Annotated[Path, typer.Argument(help="folder of a run, or its recording.mcap", show_default=False)],
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="another setting than flew, e.g. odometry.keyframe_period_s=3.2"
        ),
    ] = None,
    diff: Annotated[bool, typer.Option("--diff", help="compare with what was recorded, topic by topic")] = False,
    report: Annotated[bool, typer.Option("--report", help="measure the volume again and say how it went")] = False,
    out: Annotated[Path | None, typer.Option(help="write map.ply, trajectory.tum and report.json there")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print the result as JSON on stdout")] = False,
) -> None:
    """Fly a recording again: the same code on the recorded bytes, without a vehicle, as fast as it goes.

    With the settings that flew, everything comes out as it was to the last bit on the same machine (--diff checks it).
    With others it is a bench for tuning: stockpilot replay RUN --set odometry.keyframe_period_s=3.2 --report.

    Exit codes: 0 all well (with --diff: no difference), 1 --diff found differences, 2 not a recording, or altered.
    """
    if out is not None:
        make_folder(out)
    folder = recording_path(run).parent
    if diff or report:
        require_unaltered(folder, ["map.ply", "report.json"])  # it is set beside them
    again = replay_run(run, settings or (), keep_messages=diff)
    left = left_behind(folder) if diff else {}
    measured = again.recording.topics.get(VOLUME.name, [])
    wanted = report or out is not None or "volume_m3" in left or bool(measured)
    volume = again.flight.measure() if wanted and again.flight.mapper.size else None
    if volume is not None and measured:
        again.replay.messages[VOLUME.name] = [(t_ns, codec.encode(volume)) for t_ns, _ in measured]
    said = summary(again, volume)
    if report:
        said["recorded"] = told_by_run(folder)
    differences: list[TopicDifference] = []
    if diff:
        differences = [*compare(again.recording.topics, again.replay), *compare_results(left, again, volume)]
        said["differences"] = [
            {"topic": d.name, "recorded": d.recorded, "replayed": d.replayed, "first": d.first} for d in differences
        ]
        said["identical"] = all(d.first is None for d in differences)
    if out is not None:
        write_results(out, again, said)
    typer.echo(json.dumps(finite(said), indent=2) if as_json else describe(said))
    raise typer.Exit(EXIT_DIFFERENT if any(d.first for d in differences) else 0)


def left_behind(folder: Path) -> dict[str, Any]:
    """What a run wrote of its map and volume: map.ply's bytes, volume_m3 of report.json; what is not there is left out."""
    found: dict[str, Any] = {}
    if (folder / "map.ply").is_file():
        found["map.ply"] = (folder / "map.ply").read_bytes()
    with contextlib.suppress(OSError, ValueError):
        report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
        if isinstance(report, dict) and isinstance(report.get("volume_m3"), float):
            found["volume_m3"] = report["volume_m3"]
    return found


def told_by_run(folder: Path) -> dict[str, Any]:
    """What the run's own report.json says of the figures that a replay tells anew; empty without one."""
    try:
        report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return {key: report[key] for key in BESIDE if isinstance(report, dict) and report.get(key) is not None}


def compare_results(left: dict[str, Any], again: Replayed, volume: VolumeReport | None) -> list[TopicDifference]:
    """Map and volume against what the run left behind."""
    from companion.mapping.export import save_point_map

    found: list[TopicDifference] = []
    if "map.ply" in left:
        with tempfile.TemporaryDirectory() as temporary:
            path = Path(temporary) / "map.ply"
            save_point_map(again.flight.mapper.point_map(), path)
            data = path.read_bytes()
        first = None if data == left["map.ply"] else f"{len(left['map.ply'])} bytes, now {len(data)} others"
        found.append(TopicDifference("map.ply", 1, 1, first))
    if "volume_m3" in left:
        now = None if volume is None else volume.volume_m3
        first = None if now == left["volume_m3"] else f"{left['volume_m3']!r} m3, now {now!r}"
        found.append(TopicDifference("report.json volume_m3", 1, 1, first))
    return found


def summary(again: Replayed, volume: VolumeReport | None = None) -> dict[str, Any]:
    """What is said of a replay; with a volume, also of that."""
    flight, estimates = again.flight, again.estimates
    navigation = flight.navigation
    said: dict[str, Any] = {
        "mission": again.recording.metadata.get("run", {}).get("mission"),
        "duration_s": again.replay.duration_s,
        "wall_time_s": again.wall_time_s,
        "real_time_factor": again.real_time_factor,
        "scans": flight.scans,
        "keyframes": len(flight.keyframes),
        "rejected_scans": sum(not e.converged for e in estimates),
        "degenerate_scans": sum(e.is_degenerate for e in estimates),
        "lidar_dropped": {k: n for k, n in flight.decoder.dropped.items() if n},
        "state": None if navigation is None else navigation.state.value,
        "is_whole": again.recording.is_whole,
        "lost": again.recording.damage + [f"{k}: {v}" for k, v in again.recording.metadata.get(RECOVERED, {}).items()],
    }
    if estimates:
        last = estimates[-1]
        said["final_position_map_m"] = [float(v) for v in last.position_map_m]
        said["final_sigma_m"] = float(last.pose_covariance[:2, :2].trace() ** 0.5)
    if again.replay.unmatched:
        said["unmatched"] = again.replay.unmatched
    if not flight.mapper.size:
        said["warnings"] = ["nothing was mapped"]
    if volume is not None:
        said |= {
            "volume_m3": volume.volume_m3,
            "volume_interval_m3": list(volume.interval_m3),
            "seen_ratio": volume.seen_ratio,
            "interpolated_ratio": volume.interpolated_ratio,
            "unseen_ratio": volume.unseen_ratio,
            "warnings": list(volume.warnings),
        }
    return said


def write_results(folder: Path, again: Replayed, said: dict[str, Any]) -> None:
    from companion.mapping.export import save_point_map

    make_folder(folder)
    save_point_map(again.flight.mapper.point_map(), folder / "map.ply")
    (folder / "trajectory.tum").write_text("".join(tum_line(e) for e in again.estimates), encoding="utf-8")
    write_json(folder / "report.json", said)


def _span(interval_m3: list[float | None]) -> str:
    """high: None or infinite where a flight was cut short."""
    low, high = interval_m3
    return (
        f"interval {low or 0.0:.2f} to {high:.2f}"
        if high is not None and high < float("inf")
        else f"at least {low or 0.0:.2f}"
    )


def _beside(recorded: dict[str, Any]) -> str:
    parts = []
    if "volume_m3" in recorded:
        parts.append(f"volume {recorded['volume_m3']:.2f} m3")
    if "volume_interval_m3" in recorded:
        parts.append(_span(recorded["volume_interval_m3"]))
    if "seen_ratio" in recorded:
        parts.append(f"seen {recorded['seen_ratio']:.1%}")
    if "keyframes" in recorded:
        parts.append(f"keyframes {recorded['keyframes']}")
    return ", ".join(parts)


def describe(said: dict[str, Any]) -> str:
    """The same for people."""
    lines = [
        f"{said['mission'] or 'flight'}: {said['duration_s']:.1f} s replayed in {said['wall_time_s']:.1f} s, "
        f"{said['real_time_factor']:.0f} times real time",
        f"scans {said['scans']}, keyframes {said['keyframes']}, rejected {said['rejected_scans']}, "
        f"degenerate {said['degenerate_scans']}, ended in {said['state']}",
    ]
    if "volume_m3" in said:
        span = _span(said["volume_interval_m3"])
        lines.append(f"volume {said['volume_m3']:.2f} m3, {span}, seen {said['seen_ratio']:.1%}")
    lines += [f"  {w}" for w in said.get("warnings", [])]
    if said.get("recorded"):
        lines.append(f"the run itself told {_beside(said['recorded'])}")
    if not said["is_whole"]:
        lines.append("the recording is not whole: stockpilot recover rebuilds it")
    lines += [f"  lost {what}" for what in said["lost"]]
    for d in said.get("differences", []):
        lines.append(f"  {'differs' if d['first'] else 'same   '}  {d['topic']}: {d['first'] or d['recorded']}")
    if "identical" in said:
        lines.append("identical to the last bit" if said["identical"] else "NOT identical")
    return "\n".join(lines)
