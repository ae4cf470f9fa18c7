"""Sweeps: a grid of named runs, skipped where they are done, put in one table and one page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
import typer
from typer.testing import CliRunner

from companion.errors import ConfigError
from companion.mapping.export import save_point_map
from companion.volume import estimate_volume
from stockpilot.mission import load_mission
from stockpilot.sweep import SweepRun, load_sweep, read_results, spread, sweep_command
from stockpilot.sweep_report import (
    fill_document,
    flat_row,
    is_confident_and_wrong,
    summarise,
    trends,
    write_sweep_report,
)
from tests.companion.volume.synthetic import Flight, Hall, cone, make_map, rectangle

MISSIONS = Path(__file__).resolve().parents[2] / "missions"
SWEEPS = [MISSIONS / "paper_sweep.yaml", *sorted((MISSIONS / "sweeps").glob("*.yaml"))]


@pytest.mark.parametrize("path", SWEEPS, ids=lambda p: p.stem)
def test_shipped_sweep_is_valid_and_its_runs_have_names_of_their_own(path: Path) -> None:
    _, runs = load_sweep(path)
    assert len({run.name for run in runs}) == len(runs) > 0


def test_the_papers_sweep_is_its_sixty_tests() -> None:
    _, runs = load_sweep(MISSIONS / "paper_sweep.yaml")
    assert len(runs) == 60
    speeds = {dict(run.parameters)["navigator.forward_speed_mps"] for run in runs}
    periods = {dict(run.parameters)["odometry.keyframe_period_s"] for run in runs}
    assert speeds == {0.31, 0.43, 0.55}
    assert periods == {1.6, 3.2, 4.8, 6.4}
    assert {run.seed for run in runs} == {0, 1, 2, 3, 4}


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("missions: []", "missions"),
        ("missions: [cement_store.yaml]\ngrit: {}", "grit"),
        ("missions: [cement_store.yaml]\ngrid: {navigator.height_m: []}", "at least one value"),
        ("missions: [cement_store.yaml]\ngrid: {navigator.hight_m: [5]}", "hight_m"),
        ("missions: [nowhere.yaml]", "no such mission"),
        ("missions: [", "not YAML"),
    ],
)
def test_bad_sweep_is_refused_before_anything_flies(tmp_path: Path, text: str, told: str) -> None:
    (tmp_path / "cement_store.yaml").write_text((MISSIONS / "cement_store.yaml").read_text(encoding="utf-8"))
    path = tmp_path / "sweep.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as error:
        load_sweep(path)
    assert told in str(error.value)


def test_a_part_of_a_sweep_is_spread_over_all_of_it() -> None:
    _, runs = load_sweep(MISSIONS / "sweeps" / "interval.yaml")
    part = spread(runs, 20)
    assert len({run.name for run in part}) == 20
    assert {dict(run.parameters)["mission"] for run in part} == {dict(run.parameters)["mission"] for run in runs}
    assert spread(runs, None) == spread(runs, 1000) == runs


def result(
    name: str, *, speed: float, seed: int, e_p: float, e_v: float, keyframes: int, **more: Any
) -> dict[str, Any]:
    report = {
        "state": "completed", "collision": False, "e_p_m": e_p, "e_v_percent": e_v, "keyframes": keyframes,
        "c_c": 4 * keyframes, "volume_m3": 1000 + 10 * e_v, "truth_volume_m3": 1000.0, "truth_in_interval": True,
        "volume_interval_m3": [980.0, 1020.0], "warnings": [], "events": [], "real_time_factor": 12.0,
        "cramer_rao_bound_m": 0.011, "paper": {"e_p_m": 0.01 * keyframes, "e_v_percent": 5.0, "c_c": 50 * keyframes},
    }  # fmt: skip
    return {
        "run": name, "parameters": {"mission": "cement_store", "navigator.forward_speed_mps": speed},
        "report": {**report, **more}, "path_world_m": [[1.0, 1.0], [2.0, 3.0]],
        "outlines_world_m": [[[0.0, 0.0], [50.0, 0.0], [50.0, 30.0], [0.0, 30.0]]],
    }  # fmt: skip


RESULTS = [
    result(f"r{n}", speed=speed, seed=n, e_p=0.01 + 0.001 * n, e_v=0.1 * n - 0.2, keyframes=40 + 10 * n)
    for n, speed in enumerate((0.31, 0.31, 0.43, 0.43, 0.55))
]


def test_table_holds_every_key_of_the_reports(tmp_path: Path) -> None:
    write_sweep_report(tmp_path, "demo", "", RESULTS)
    table = pd.read_parquet(tmp_path / "results.parquet")
    assert len(table) == len(RESULTS)
    assert {"e_p_m", "paper_e_p_m", "volume_interval_low_m3", "set.navigator.forward_speed_mps"} <= set(table.columns)
    again = pd.read_csv(tmp_path / "results.csv")
    assert list(again["e_p_m"]) == pytest.approx([r["report"]["e_p_m"] for r in RESULTS])


def test_page_shows_both_pipelines_and_every_flight(tmp_path: Path) -> None:
    page = write_sweep_report(tmp_path, "demo", "words", RESULTS).read_text(encoding="utf-8")
    for r in RESULTS:
        assert r["run"] in page
    assert page.count("data:image/png;base64,") >= 2


def test_a_wrong_volume_with_a_narrow_interval_is_counted() -> None:
    unsure = result("u", speed=0.3, seed=0, e_p=0.1, e_v=9.0, keyframes=10, truth_in_interval=False, warnings=["dust"])
    sure = result("s", speed=0.3, seed=0, e_p=0.1, e_v=9.0, keyframes=10, truth_in_interval=False)
    assert not is_confident_and_wrong(unsure["report"])
    assert is_confident_and_wrong(sure["report"])
    assert summarise([*RESULTS, unsure, sure])["outside_without_warning"] == 1


def test_trend_of_the_papers_pipeline_is_told_as_it_is() -> None:
    told = {(t["pipeline"], t["metric"]): t["rises_with_scans"] for t in trends(RESULTS)}
    assert told["paper", "e_p_m"] is True
    assert told["paper", "e_v_percent"] is None  # the same error in every flight: nothing can be told


def test_document_is_filled_between_its_markers_only(tmp_path: Path) -> None:
    path = tmp_path / "results.md"
    path.write_text(
        "before\n<!-- sweep demo: begin -->\nSTALE-TABLE\n<!-- sweep demo: end -->\nafter\n", encoding="utf-8"
    )
    fill_document(path, "demo", RESULTS, command="stockpilot sweep demo.yaml")
    text = path.read_text(encoding="utf-8")
    assert text.startswith("before\n")
    assert text.endswith("\nafter\n")
    assert "STALE-TABLE" not in text
    assert "stockpilot sweep demo.yaml" in text
    with pytest.raises(ConfigError, match="expected the lines"):
        fill_document(path, "other", RESULTS, command="x")


def test_flight_that_is_there_is_skipped_and_half_a_file_is_flown_again(tmp_path: Path) -> None:
    runs = [
        SweepRun(name=n, mission="m", settings=(), parameters=(), seed=0, perfect_poses=False) for n in ("a", "b", "c")
    ]
    (tmp_path / "a.json").write_text(json.dumps({"report": {}}), encoding="utf-8")
    (tmp_path / "b.json").write_text('{"report": {', encoding="utf-8")
    assert set(read_results(tmp_path, runs)) == {"a"}


def test_volume_is_measured_again_in_the_maps_that_were_kept(tmp_path: Path) -> None:
    """As a flight's own measuring would: to the last bit, and nothing else of the result changes."""
    sweep_file = tmp_path / "sweep.yaml"
    sweep_file.write_text(f"missions: [{MISSIONS / 'cement_store.yaml'}]\nseeds: [3]\n", encoding="utf-8")
    _, runs = load_sweep(sweep_file)
    made = make_map(Hall(footprint=rectangle(24.0, 20.0), pile=cone(12.0, 10.0, 3.0, 0.7)), Flight(height_m=6.0), 1)
    stale = result(runs[0].name, speed=0.43, seed=3, e_p=0.01, e_v=9.0, keyframes=40, lap_closed=True)
    stale["report"]["e_v_percent_perfect_poses"] = 0.1  # of the version that flew it: cannot be told from the map
    stale["report"]["truth_volume_m3"] = made.true_volume_m3
    stale["report"] |= {"lidar_turned_deg": 2.0, "lidar_turned_sigma_deg": 0.4}  # nor can this
    leans = {"t_s": 9.0, "severity": "CRITICAL", "name": "lidar_leans", "text": "LiDAR leans 8 deg or more"}
    stale["report"]["events"] = [leans]
    file = tmp_path / f"{runs[0].name}.json"
    file.write_text(json.dumps(stale), encoding="utf-8")

    app = typer.Typer()
    app.command()(sweep_command)
    command = [str(sweep_file), "--out", str(tmp_path), "--remeasure", "--workers", "1", "--json"]
    with pytest.raises(ConfigError, match="--keep-maps"):
        CliRunner().invoke(app, command, catch_exceptions=False)
    for other in (["--limit", "1"], ["--keep-maps"]):
        with pytest.raises(ConfigError, match="do not go with it"):
            CliRunner().invoke(app, [*command, *other], catch_exceptions=False)

    save_point_map(made.point_map, tmp_path / f"{runs[0].name}.ply")
    told = CliRunner().invoke(app, command)
    assert told.exit_code == 0, told.output
    again = json.loads(file.read_text(encoding="utf-8"))
    volume = estimate_volume(made.point_map, load_mission(Path(runs[0].mission), (), seed=3).companion.volume)
    assert again["report"]["volume_m3"] == volume.volume_m3
    assert again["report"]["volume_interval_m3"] == list(volume.interval_m3)
    assert abs(again["report"]["e_v_percent"]) < 2.0
    assert any("turned against each other by +2.0 deg" in w for w in again["report"]["warnings"])
    assert any("by 8 deg or more, which is more than is corrected" in w for w in again["report"]["warnings"])
    assert "e_v_percent_perfect_poses" not in again["report"]
    assert (again["path_world_m"], again["report"]["e_p_m"]) == (stale["path_world_m"], 0.01)


def test_how_wide_the_interval_is_and_how_full_is_told() -> None:
    results = [result("a", speed=0.3, seed=0, e_p=0.1, e_v=e_v, keyframes=10) for e_v in (0.5, -0.5)]
    for each in results:
        volume = each["report"]["volume_m3"]
        each["report"]["volume_interval_m3"] = [volume - 19.6, volume + 19.6]
        each["report"]["volume_interval_level"] = 0.95
        each["report"]["truth_volume_m3"] = volume - 5.0
    no_end = result("b", speed=0.3, seed=0, e_p=0.1, e_v=1.0, keyframes=10, volume_interval_m3=[900.0, None])
    told = summarise([*results, no_end])
    assert told["error_over_sigma_rms"] == pytest.approx(0.5, rel=1e-3)
    assert told["interval_half_width_percent_median"] == pytest.approx(1.96, rel=0.02)


def test_values_of_a_grid_may_be_lists(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """missions/sweeps/mount.yaml has some; they ended in "unhashable type" before anything flew."""
    sweep_file = tmp_path / "sweep.yaml"
    sweep_file.write_text(
        f"missions: [{MISSIONS / 'cement_store.yaml'}]\ngrid:\n  lidar.mount_error_rpy_deg: [[2, 0, 0], [0, 2, 0]]\n",
        encoding="utf-8",
    )

    def instead_of_flying(jobs, *_):
        for run, job in jobs.items():
            assert job.args == (run,)
            yield run, result(run.name, speed=0.43, seed=0, e_p=0.01, e_v=0.1, keyframes=40)

    monkeypatch.setattr("stockpilot.sweep._compute_all", instead_of_flying)
    app = typer.Typer()
    app.command()(sweep_command)
    told = CliRunner().invoke(app, [str(sweep_file), "--out", str(tmp_path), "--json"], catch_exceptions=False)
    assert told.exit_code == 0
    assert json.loads(told.stdout)["flights"] == 2


def test_row_is_flat() -> None:
    assert all(not isinstance(value, dict | list) for value in flat_row(RESULTS[0]).values())
