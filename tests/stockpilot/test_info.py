"""stockpilot info and recover say what is in a file, with exit codes that scripts can use."""

from __future__ import annotations

import gzip
import json
import random
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from companion.recording.manifest import write_manifest
from stockpilot.info import contents_of, info_command
from stockpilot.recover import recover_command
from tests.companion.recording.samples import small_recording
from tests.companion.recording.test_log import a_recorder, fill, heartbeats
from tests.shared_data import shared_data

RUNNER = CliRunner()
ROOT = Path(__file__).resolve().parents[2]


def run(command, *arguments: object) -> tuple[int, dict]:
    app = typer.Typer()
    app.command()(command)
    result = RUNNER.invoke(app, [*map(str, arguments), "--json"])
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, json.loads(result.stdout)


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    recorder = a_recorder(tmp_path)
    fill(recorder, seconds=5)
    recorder.close({"state": "completed"})
    return tmp_path


def test_recording_of_a_flight_is_described(flight: Path) -> None:
    code, said = run(info_command, flight)
    topics = {t["name"]: t for t in said["topics"]}
    assert code == 0
    assert said["verdict"] == "sound"
    assert said["labels"]["mission"] == "m"
    assert said["labels"]["outcome state"] == "completed"
    assert topics["in/lidar"]["count"] == 50
    assert topics["in/lidar"]["rate_hz"] == pytest.approx(10.0)
    assert topics["in/lidar"]["longest_gap_s"] == pytest.approx(0.1)
    assert said["duration_s"] == pytest.approx(4.9, abs=0.01)


def test_gap_in_a_steady_stream_makes_the_verdict(tmp_path: Path) -> None:
    recorder = a_recorder(tmp_path)
    for n in range(100):
        recorder.input("poll", n * 100_000_000 + (3_000_000_000 if n > 50 else 0))
    recorder.close()
    code, said = run(info_command, tmp_path)
    assert code == 1
    assert said["problems"] == ["gap of 3.100 s in in/poll"]


def test_altered_file_of_a_run_is_told(flight: Path) -> None:
    write_manifest(flight)
    assert run(info_command, flight)[0] == 0
    (flight / "telemetry.tlog").write_bytes(b"shorter")
    code, said = run(info_command, flight)
    assert code == 1
    assert "telemetry.tlog altered" in said["problems"][0]


def test_tlog_counts_missing_frames(tmp_path: Path) -> None:
    frames = heartbeats(10)
    path = tmp_path / "log"
    stamps = [(1_700_000_000_000_000 + n * 1_000_000).to_bytes(8, "big") for n in range(10)]
    path.write_bytes(b"".join(s + f for n, (s, f) in enumerate(zip(stamps, frames, strict=True)) if n not in (4, 5)))
    code, said = run(info_command, path)
    assert code == 1
    assert said["kind"] == "MAVLink tlog"
    assert said["topics"][0]["name"] == "1/191 HEARTBEAT"
    assert said["drops"] == {"MAVLink frames missing by sequence number": 2}


def test_recordings_of_real_systems_are_described() -> None:
    capture = contents_of(shared_data("ouster", "OS-1-128_v2.3.0_1024x10_lb_n3.pcap")).as_dict()
    assert capture["labels"]["sensor"] == "OS-1-128 122201000998, 128 x 1024"
    assert {t["name"]: t["count"] for t in capture["topics"]} == {"udp 7502": 192, "udp 7503": 30, "scans (Ouster)": 3}
    assert capture["verdict"] == "sound"
    tlog = contents_of(shared_data("autopilots", "px4", "vision_loss.from_fc.tlog")).as_dict()
    assert tlog["duration_s"] == pytest.approx(96.9, abs=0.1)
    assert {t["name"]: t["count"] for t in tlog["topics"]}["1/1 TIMESYNC"] == 1066
    bag = contents_of(shared_data("scans2d", "aces.orig.bag")).as_dict()
    assert {t["name"]: t["count"] for t in bag["topics"]}["/scan"] == 7374
    carmen = contents_of(shared_data("scans2d", "aces-corrected.log.gz")).as_dict()
    assert {t["name"]: t["count"] for t in carmen["topics"]}["FLASER"] == 440


def test_recover_tells_whole_loss_and_nothing_by_its_exit_code(tmp_path: Path) -> None:
    whole = small_recording()
    path = tmp_path / "r.mcap"
    path.write_bytes(whole)
    assert run(recover_command, path)[0] == 0
    path.write_bytes(whole[: len(whole) // 2])
    code, said = run(recover_command, path)
    assert code == 3
    assert said["state"] == "recovered"
    assert said["messages"] > 100
    assert Path(said["output"]).exists()
    path.write_bytes(whole[:100])
    code, said = run(recover_command, path)
    assert (code, said["state"], said["output"]) == (1, "nothing", None)


def test_packed_log_that_is_cut_is_not_sound(tmp_path: Path) -> None:
    rng = random.Random(0)
    lines = [f"ODOM {rng.random()} 0 0 0 0 0 {n}.5 host {n}.5" for n in range(500)]
    packed = gzip.compress("\n".join(lines).encode())
    (tmp_path / "whole").write_bytes(packed)
    (tmp_path / "cut").write_bytes(packed[:-2000])
    assert run(info_command, tmp_path / "whole")[0] == 0
    code, said = run(info_command, tmp_path / "cut")
    assert code == 1
    assert "cut" in json.dumps(said["drops"])
