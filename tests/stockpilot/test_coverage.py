"""What is said of the interval over several sweeps is counted from their flights, and only from those with a volume."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path

import pytest

from benchmarks import coverage
from companion.errors import ConfigError
from stockpilot.sweep_report import fill_block


def report(volume: float | None, *, inside: bool, warned: bool = False) -> coverage.Report:
    return {
        "volume_m3": volume, "truth_in_interval": inside, "warnings": ["said"] if warned else [],
        "truth_volume_m3": 100.0, "volume_interval_level": 0.95,
        "volume_interval_m3": None if volume is None else [volume - 1.959964, volume + 1.959964],
    }  # fmt: skip


def sweep(folder: Path, reports: list[coverage.Report]) -> Path:
    folder.mkdir()
    for n, each in enumerate(reports):
        (folder / f"flight_{n}.json").write_text(json.dumps({"run": f"flight_{n}", "report": each}))
    (folder / "other.json").write_text("[1]")
    return folder


def test_flights_are_counted_by_what_their_interval_did() -> None:
    reports = [report(101.0, inside=True)] * 8 + [report(103.0, inside=False), report(103.0, inside=False, warned=True)]
    told = coverage.row("a", [*reports, report(None, inside=False)])
    assert (told["flights"], told["with a volume"], told["inside"]) == (11, 10, 8)
    assert told["inside, %"] == pytest.approx(80.0)
    assert told["95 % range, %"] == "44.4 to 97.5"  # Clopper and Pearson, 8 of 10
    assert told["outside without a warning"] == 1
    assert told["error over 1 sigma, RMS"] == pytest.approx(math.sqrt((8 * 1.0 + 2 * 9.0) / 10), rel=1e-5)


def test_no_flights_is_an_error_and_never_a_ratio(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="expected the folder of a sweep"):
        coverage.reports_of(tmp_path)


def test_table_of_several_sweeps_goes_into_a_document(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    a = sweep(tmp_path / "a", [report(101.0, inside=True)] * 3)
    b = sweep(tmp_path / "b", [report(105.0, inside=False)])
    document = tmp_path / "results.md"
    document.write_text("above\n<!-- coverage: begin -->\nold\n<!-- coverage: end -->\nbelow\n")
    monkeypatch.setattr(sys, "argv", ["coverage", str(a), str(b), "--docs", str(document)])
    coverage.main()
    assert "| all | 4 | 4 | 3 | 75 |" in capsys.readouterr().out
    text = document.read_text()
    assert text.startswith("above\n")
    assert text.endswith("below\n")
    assert "| all | 4 | 4 | 3 | 75 |" in text
    assert "old" not in text
    with pytest.raises(ConfigError, match="nothing: begin"):
        fill_block(document, "nothing", "text")


def test_worlds_are_told_apart_with_what_their_intervals_are_made_of(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    hall = {
        **report(102.0, inside=False),
        "mission": "hall",
        "error_budget_m3": {"poses": 0.8, "floor": 0.6, "doubt": 0.0},
    }
    silo = {**report(99.0, inside=True), "mission": "silo", "error_budget_m3": {"poses": 0.5}}
    folder = sweep(
        tmp_path / "a", [hall, {**hall, "volume_m3": 98.0}, silo, {**report(None, inside=False), "mission": "silo"}]
    )
    document = tmp_path / "results.md"
    document.write_text("<!-- coverage_by_world: begin -->\n<!-- coverage_by_world: end -->\n")
    monkeypatch.setattr(sys, "argv", ["coverage", "--by-world", str(folder), "--docs", str(document)])
    coverage.main()
    lines = capsys.readouterr().out.splitlines()
    assert lines[2].startswith("| hall | 2 | 0 | 0 | 2 |")
    assert lines[2].endswith("| poses 0.800, floor 0.600 |")
    assert lines[3].startswith("| silo | 1 | 1 | -1 | 1 | 1 |")
    assert "| silo | 1 | 1 |" in document.read_text()
