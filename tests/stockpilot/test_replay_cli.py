"""A recorded flight flown again: identical to the last bit, or the first difference shown."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from companion.flight import Flight
from companion.recording.log import Recorder
from companion.recording.manifest import write_manifest
from companion.recording.replay import Replay
from companion.recording.run_files import Input, read_run
from companion.topics import VOLUME
from stockpilot.cli import main as stockpilot_main
from stockpilot.replay import describe, recorded_config, replay_command, replay_run
from stockpilot.replay_check import REPLAYS
from stockpilot.replay_edit import rebuild_scans

SECONDS = 6.0


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first seconds of straight_wall, flown with a recorder on the flight core, as `run` and `fly` hang it there."""
    folder = tmp_path_factory.mktemp("flown")
    source = read_run(REPLAYS / "straight_wall")
    metadata = source.attachments["lidar.json"].decode()
    flight = Flight(config=recorded_config(source), lidar_metadata_json=metadata)
    recorder = Recorder(folder, metadata=source.metadata["run"], attachments=source.attachments)
    replay = Replay(flight, keep_messages=False)
    flight.record, flight.tap = recorder.input, recorder.tap
    start_ns = next(i.t_ns for i in source.inputs if i.kind == "lidar")
    window = [i for i in source.inputs if i.t_ns < start_ns + SECONDS * 1e9]
    inputs = rebuild_scans(window, metadata)
    inputs.append(Input("operator", inputs[-1].t_ns, b"abort sigterm"))
    inputs += [Input("poll", inputs[-1].t_ns + n * 10_000_000, b"") for n in range(1, 50)]
    sent = 0
    for item in inputs:
        replay.feed(item)
        for t_ns, frame in replay.frames[sent:]:
            recorder.output(t_ns, frame)
        sent = len(replay.frames)
    recorder.tap(VOLUME, inputs[-1].t_ns, flight.measure())
    recorder.close()
    write_manifest(folder)
    return folder


def run(*arguments: object) -> tuple[int, dict]:
    app = typer.Typer()
    app.command()(replay_command)
    result = CliRunner().invoke(app, [*map(str, arguments), "--json"])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, json.loads(result.stdout)


def test_replay_is_identical_to_the_last_bit(flown: Path) -> None:
    code, said = run(flown, "--diff")
    compared = {d["topic"]: d for d in said["differences"]}
    assert said["identical"], [d for d in said["differences"] if d["first"]]
    assert code == 0
    assert compared["odometry/estimate"]["recorded"] > 150
    assert compared["out/mavlink"]["recorded"] > 300
    assert compared["operator/command"]["recorded"] == 1
    assert compared["volume/report"]["recorded"] == 1
    assert said["scans"] == 60


def test_another_setting_shows_the_first_difference(flown: Path) -> None:
    code, said = run(flown, "--diff", "--set", "odometry.keyframe_period_s=1.6")
    assert code == 1
    different = {d["topic"]: d["first"] for d in said["differences"] if d["first"]}
    assert "odometry/keyframe" in different
    assert "message" in different["odometry/keyframe"]
    assert "vehicle/attitude" not in different
    assert said["keyframes"] == 4


def test_altered_recording_is_refused(flown: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "run"
    shutil.copytree(flown, folder)
    with (folder / "recording.mcap").open("r+b") as file:
        file.seek(5000)
        file.write(b"\xff")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["stockpilot", "replay", str(folder)])
        with pytest.raises(SystemExit) as ended:
            stockpilot_main()
    assert ended.value.code == 2
    assert "altered" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("setting", "told"),
    [
        ("odometry.keyframe_period_s=-1", "keyframe_period_s"),
        ("odometry.nothing=1", "nothing"),
        ("world.height_m=3", "world was flown"),
    ],
)
def test_wrong_setting_is_told(flown: Path, setting: str, told: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["stockpilot", "replay", str(flown), "--set", setting])
        with pytest.raises(SystemExit) as ended:
            stockpilot_main()
    assert ended.value.code == 2
    assert told in capsys.readouterr().err


def test_report_measures_the_map_again(flown: Path, tmp_path: Path) -> None:
    code, said = run(flown, "--report", "--out", tmp_path / "again")
    assert code == 0
    assert said["volume_m3"] >= 0.0
    assert {p.name for p in (tmp_path / "again").iterdir()} == {"map.ply", "trajectory.tum", "report.json"}


def test_report_is_set_beside_what_the_run_told(flown: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(flown, folder)
    told = {"keyframes": 12, "volume_m3": 34.5, "volume_interval_m3": [30.0, 39.0], "seen_ratio": 0.5, "seed": 3}
    (folder / "report.json").write_text(json.dumps(told), encoding="utf-8")
    _, said = run(folder, "--report", "--set", "odometry.keyframe_period_s=3.2")
    assert said["recorded"] == {
        key: told[key] for key in ("keyframes", "volume_m3", "volume_interval_m3", "seen_ratio")
    }
    assert "the run itself told volume 34.50 m3, interval 30.00 to 39.00, seen 50.0%, keyframes 12" in describe(said)
    (folder / "report.json").write_text(json.dumps(told | {"volume_interval_m3": [30.0, None]}), encoding="utf-8")
    assert "told volume 34.50 m3, at least 30.00," in describe(
        run(folder, "--report")[1]
    )  # a flight that was cut short
    _, said = run(flown, "--report")
    assert said["recorded"] == {}


def test_replay_of_a_recording_without_its_scans_says_so(flown: Path) -> None:
    again = replay_run(flown)
    replay = Replay(Flight(config=again.config, lidar_metadata_json=again.recording.attachments["lidar.json"].decode()))
    replay.run(i for i in again.recording.inputs if i.kind != "lidar")
    assert replay.unmatched == 120
