"""Recordings of our own and of real sensors, flown again: each folder of missions/replays keeps what it expects."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from companion.errors import FileFormatError
from stockpilot import replay_check
from stockpilot.replay_check import EXPECTED, check_folder, folders, load_expected

FOLDERS = folders()
REQUIRED = {
    "straight_wall",
    "corner",
    "turn_on_the_spot",
    "dust",
    "long_corridor",
    "lost_lidar",
    "flight_controller_restart",
    "real_os0_32",
}


def test_every_case_that_must_be_there_is_there() -> None:
    assert {f.name for f in FOLDERS} >= REQUIRED


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda f: f.name)
def test_replay_keeps_what_it_expects(folder: Path) -> None:
    outcome = check_folder(folder)
    if outcome.skipped:
        pytest.skip(outcome.skipped)
    assert outcome.checks
    broken = [f"{c.name}: {c.got}, expected {c.expected} within {c.tolerance}" for c in outcome.checks if not c.is_kept]
    assert not broken, "\n".join(broken)


@pytest.mark.parametrize("folder", FOLDERS, ids=lambda f: f.name)
def test_recording_is_small(folder: Path) -> None:
    assert sum(p.stat().st_size for p in folder.iterdir()) < 1_010_000


def small(tmp_path: Path, expected: dict[str, Any]) -> Path:
    folder = tmp_path / "case"
    folder.mkdir()
    content = {
        "about": "a case",
        "recording": "shared:ouster/OS-0-32-U1_v2.2.0_1024x10.pcap",
        "metadata": "OS-0-32-U1_v2.2.0_1024x10.json",
        "expected": expected,
    }
    (folder / EXPECTED).write_text(json.dumps(content))
    return folder


def fake_measure(values: dict[str, float]) -> Any:
    return lambda folder, content: dict(values)


def test_case_that_compares_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="compares nothing"):
        load_expected(small(tmp_path, {}))


def test_value_without_a_reason_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="reason"):
        load_expected(small(tmp_path, {"scans": {"value": 1}}))


def test_value_that_is_not_measured_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replay_check, "measure_folder", fake_measure({"scans": 1}))
    monkeypatch.setattr(replay_check, "shared_path", lambda content: None)
    with pytest.raises(FileFormatError, match="speed is not measured"):
        check_folder(small(tmp_path, {"speed": {"value": 1, "reason": "none"}}))


def test_value_outside_its_tolerance_breaks_the_case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replay_check, "measure_folder", fake_measure({"scans": 3}))
    monkeypatch.setattr(replay_check, "shared_path", lambda content: None)
    folder = small(tmp_path, {"scans": {"value": 1, "tolerance": 1, "reason": "one may be cut"}})
    assert not check_folder(folder).is_kept
    monkeypatch.setattr(replay_check, "measure_folder", fake_measure({"scans": 2}))
    assert check_folder(folder).is_kept


def test_rewriting_prints_what_changed_and_then_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(replay_check, "measure_folder", fake_measure({"scans": 3}))
    monkeypatch.setattr(replay_check, "shared_path", lambda content: None)
    folder = small(tmp_path, {"scans": {"value": 1, "tolerance": 0, "reason": "exact"}})
    monkeypatch.setattr(replay_check, "REPLAYS", tmp_path)
    assert replay_check.main(["case"]) == 1
    assert replay_check.main(["--write"]) == 1
    assert "scans 1 -> 3" in capsys.readouterr().out
    assert replay_check.main(["--write"]) == 0
    assert replay_check.main([]) == 0
    assert load_expected(folder)["expected"]["scans"] == {"value": 3, "tolerance": 0, "reason": "exact"}


def test_no_case_at_all_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replay_check, "REPLAYS", tmp_path)
    assert replay_check.main([]) == 2
