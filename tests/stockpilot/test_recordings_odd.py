"""Files that are empty, cut, of another kind, without what belongs beside them: each is told in a line that names it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from companion.errors import FileFormatError
from companion.lidar.pcap import PcapReader
from companion.recording.manifest import write_manifest
from stockpilot import odometry_cli, replay
from stockpilot.files import begin_folder, fresh_folder, make_folder
from stockpilot.info import contents_of, info_command
from stockpilot.odometry_cli import odometry_command
from stockpilot.recover import recover_command
from stockpilot.replay import replay_command
from stockpilot.replay_check import REPLAYS
from stockpilot.scan_files import open_scans
from stockpilot.volume_cli import volume_command
from tests.companion.lidar.packets import frame_packets, sensor
from tests.companion.lidar.test_pcap import classic
from tests.companion.recording.samples import small_recording
from tests.companion.recording.test_log import a_recorder, fill
from tests.stockpilot.test_scan_files import udp_frame


def run(command, *arguments: object) -> tuple[int, str]:
    app = typer.Typer()
    app.command()(command)
    result = CliRunner().invoke(app, [*map(str, arguments)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.stdout


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Two turns of an Ouster sensor; its metadata is not beside it."""
    info = sensor()
    packets = [p for n in range(2) for p in frame_packets(info, n + 1, t_ns=5_000_000_000 + n * 100_000_000)]
    path = tmp_path / "capture.pcap"
    path.write_bytes(classic([udp_frame(p, 7502) for p in packets]))
    return path


@pytest.mark.parametrize("content", [b"\xff\xfe{", b"{", b'{"beam": 1}', b"", None], ids=str)
def test_metadata_that_cannot_be_used_is_named(capture: Path, content: bytes | None) -> None:
    metadata = capture.with_suffix(".json")
    if content is None:
        metadata.mkdir()
    else:
        metadata.write_bytes(content)
    for read in (open_scans, contents_of):
        with pytest.raises(FileFormatError, match=r"capture\.json"):
            read(capture)


def test_capture_of_another_sensor_says_why_there_is_no_scan(capture: Path) -> None:
    info = sensor()
    info.sn = 12345
    capture.with_suffix(".json").write_text(info.to_json_string())
    with pytest.raises(FileFormatError, match="64 dropped: foreign"):
        run(odometry_command, capture)


def test_cut_capture_gives_what_came_before_and_is_told(capture: Path) -> None:
    capture.with_suffix(".json").write_text(sensor().to_json_string())
    capture.write_bytes(capture.read_bytes()[:-700])
    reader = PcapReader(capture)
    assert len(list(reader)) == 63
    code, said = run(odometry_command, capture)
    assert code == 0
    assert "1 scans" in said
    assert "the file is cut" in said


def test_cut_recording_of_a_flight_is_told_by_odometry(tmp_path: Path) -> None:
    info = sensor()
    recorder = a_recorder(tmp_path, lidar=info.to_json_string().encode())
    for n in range(6):
        for k, packet in enumerate(frame_packets(info, n, t_ns=n * 100_000_000)):
            recorder.input("lidar", n * 100_000_000 + k * 3_000_000, packet, None)
    recorder.close()
    path = tmp_path / "recording.mcap"
    whole = open_scans(path)
    assert len(list(whole.scans)) == 6
    assert not any(whole.dropped.values())
    path.write_bytes(path.read_bytes()[:-3000])
    cut = open_scans(path)
    assert list(cut.scans)
    assert any(why.startswith("bytes at") and n for why, n in cut.dropped.items())


@pytest.mark.parametrize(
    ("option", "place"), [("--map", "x.txt"), ("--map", "no/x.ply"), ("--tum", "no/x"), ("--tum", "")]
)
def test_result_that_cannot_be_written_is_told_before_the_work(
    capture: Path, monkeypatch: pytest.MonkeyPatch, option: str, place: str
) -> None:
    monkeypatch.setattr(odometry_cli, "open_scans", lambda *_, **__: pytest.fail("the work was begun"))
    with pytest.raises(FileFormatError, match=r"written"):
        run(odometry_command, capture, option, capture.parent / place)


def test_replay_out_that_is_a_file_is_told_before_the_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replay, "replay_run", lambda *_, **__: pytest.fail("the work was begun"))
    (tmp_path / "file").write_text("")
    with pytest.raises(FileFormatError, match="it is a file"):
        run(replay_command, REPLAYS / "corner", "--out", tmp_path / "file")


def test_packed_recording_is_replayed_with_its_scans() -> None:
    code, said = run(replay_command, REPLAYS / "straight_wall", "--json")
    assert code == 0
    assert json.loads(said)["scans"] > 100


def test_replay_of_what_holds_no_flight_says_so(tmp_path: Path, capture: Path) -> None:
    (tmp_path / "empty").write_bytes(b"")
    for path in (tmp_path / "empty", capture):
        with pytest.raises(FileFormatError, match="not a recording of a flight"):
            run(replay_command, path)
    with pytest.raises(FileFormatError, match="no such file"):
        run(replay_command, tmp_path / "absent")


@pytest.mark.parametrize(("name", "told"), [("empty", "it is empty"), ("capture.pcap", "it is a packet capture")])
def test_recover_says_why_there_is_nothing(tmp_path: Path, capture: Path, name: str, told: str) -> None:
    (tmp_path / "empty").write_bytes(b"")
    code, said = run(recover_command, tmp_path / name)
    assert code == 1
    assert told in said
    assert "not closed" not in said


def test_what_was_lost_is_kept_in_the_recovered_recording_and_told(tmp_path: Path) -> None:
    whole = bytearray(small_recording())
    whole[whole.index(b"zstd", 1500) + 40] ^= 8
    path = tmp_path / "flipped.mcap"
    path.write_bytes(whole)
    assert run(recover_command, path)[0] == 3
    code, said = run(info_command, tmp_path / "flipped.recovered.mcap", "--json")
    assert code == 1
    assert any("lost before it was recovered, at byte" in problem for problem in json.loads(said)["problems"])
    assert run(recover_command, tmp_path / "flipped.recovered.mcap")[0] == 0


def test_replay_of_a_recovered_flight_tells_what_was_lost(tmp_path: Path) -> None:
    recorder = a_recorder(tmp_path)
    fill(recorder, seconds=3)
    path = tmp_path / "recording.mcap"
    run(recover_command, path)
    recorder.close()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(replay, "recorded_config", lambda *_: replay.CompanionConfig())
        code, said = run(replay_command, tmp_path / "recording.recovered.mcap")
    assert code == 0
    assert "lost end: it was not closed" in said


def test_a_flight_is_never_written_over(tmp_path: Path) -> None:
    """FAULTS 18: a companion that starts again in the air, with the same --out, records a new segment."""
    asked = tmp_path / "flight"
    folders = []
    for _ in range(3):
        folder = fresh_folder(asked)
        fill(a_recorder(folder), seconds=2)
        folders.append(folder)
    assert [f.name for f in folders] == ["flight", "flight-2", "flight-3"]
    assert all((f / "recording.mcap").stat().st_size > 1000 for f in folders)


def test_a_run_begun_anew_is_not_taken_for_one_that_was_altered(tmp_path: Path) -> None:
    for name in ("manifest.json", "report.json", "map.ply", "notes.txt"):
        (tmp_path / name).write_text("of the last run")
    begin_folder(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


def test_folder_that_cannot_be_made_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "run"):
        with pytest.raises(FileFormatError, match="--out"):
            make_folder(folder)


def test_report_beside_a_recording_that_is_no_report_is_left_alone(tmp_path: Path) -> None:
    shutil.copy(REPLAYS / "corner" / "recording.packed.xz", tmp_path)
    (tmp_path / "report.json").write_text("[]")
    assert replay.left_behind(tmp_path) == {}
    assert replay.told_by_run(tmp_path) == {}


def test_altered_files_of_a_run_are_refused_by_every_command_that_reads_them(tmp_path: Path) -> None:
    """FAULTS 32: "a recording or map was altered": "refused, shown"."""
    recorder = a_recorder(tmp_path, lidar=sensor().to_json_string().encode())
    for n, packet in enumerate(p for k in range(3) for p in frame_packets(sensor(), k)):
        recorder.input("lidar", n * 3_000_000, packet, None)
    recorder.close()
    for name in ("map.ply", "report.json"):
        (tmp_path / name).write_text("as the run left it")
    write_manifest(tmp_path)
    recording = tmp_path / "recording.mcap"
    assert run(odometry_command, recording)[0] in (0, 1)  # read
    (tmp_path / "map.ply").write_text("as somebody else left")
    (tmp_path / "report.json").write_text("as somebody left it")
    recording.write_bytes(recording.read_bytes() + b"x")
    for command, *arguments in (
        (odometry_command, recording),
        (volume_command, tmp_path / "map.ply"),
        (volume_command, tmp_path),
        (replay_command, tmp_path),
    ):
        with pytest.raises(FileFormatError, match="altered"):
            run(command, *arguments)
    with pytest.raises(FileFormatError, match=r"(?s)map\.ply: altered.*report\.json: altered"):
        run(replay_command, tmp_path, "--diff")
    copy = tmp_path / "elsewhere" / "recording.mcap"
    copy.parent.mkdir()
    shutil.copy(recording, copy)
    assert run(odometry_command, copy)[0] in (0, 1)


@pytest.mark.parametrize("content", ["{", "[]", '{"name": "of another program"}'])
def test_a_manifest_of_another_program_says_nothing_of_a_file_beside_it(capture: Path, content: str) -> None:
    (capture.parent / "manifest.json").write_text(content)
    capture.with_suffix(".json").write_text(sensor().to_json_string())
    assert run(odometry_command, capture)[0] == 0
