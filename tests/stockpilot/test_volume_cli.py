"""`stockpilot volume`: any cloud, and errors that say how to mend them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from companion.errors import FileFormatError
from companion.mapping.export import save_point_map
from companion.messages import PointMap
from stockpilot.volume_cli import fitting_cell_m, measure, volume_command

TRUE_M3 = np.pi * 4.0**3 / 0.6**2 / 3
RUNNER = CliRunner()
APP = typer.Typer()
APP.command()(volume_command)


def heap(count: int = 60_000, scale: float = 1.0) -> PointMap:
    """A cone of 4 m in the open."""
    rng = np.random.default_rng(3)
    xy = rng.uniform([-14, -12], [14, 12], (count, 2))
    z = np.maximum(4.0 - 0.6 * np.hypot(*xy.T), 0.0) + rng.normal(0, 0.02, count)
    return PointMap(
        points_map=np.column_stack([xy, z]) * scale,
        keyframe_id=np.zeros(count, dtype=np.int64),
        range_m=np.zeros(count),
        path_map=np.zeros((0, 3)),
    )


@pytest.fixture
def cloud(tmp_path: Path) -> Path:
    save_point_map(heap(), tmp_path / "heap.ply")
    return tmp_path / "heap.ply"


def test_json_on_stdout_alone_and_progress_on_stderr(cloud: Path) -> None:
    result = RUNNER.invoke(APP, [str(cloud), "--json"])
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert report["volume_m3"] == pytest.approx(TRUE_M3, rel=0.01)
    low, high = report["volume_interval_m3"]
    assert low <= TRUE_M3 <= high
    assert "points read" in result.stderr


def test_summary_names_volume_and_interval(cloud: Path) -> None:
    result = RUNNER.invoke(APP, [str(cloud), "--density", "1.5"])
    assert result.exit_code == 0
    assert "m³" in result.stdout
    assert "95 % confidence" in result.stdout
    assert "t/m³" in result.stdout


def test_out_writes_report_page_and_pictures(cloud: Path, tmp_path: Path) -> None:
    out = tmp_path / "deep" / "results"
    assert RUNNER.invoke(APP, [str(cloud), "--out", str(out)]).exit_code == 0
    assert sorted(p.name for p in out.iterdir()) == ["map.png", "report.html", "report.json", "surface.png"]
    assert json.loads((out / "report.json").read_text())["volume_m3"] == pytest.approx(TRUE_M3, rel=0.01)


@pytest.mark.parametrize("name", ["heap.las", "heap.laz", "heap.xyz"])
def test_formats_agree(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if name.endswith("xyz"):
        np.savetxt(path, heap().points_map, fmt="%.4f")
    else:
        save_point_map(heap(), path)
    assert measure(path)[0]["volume_m3"] == pytest.approx(TRUE_M3, rel=0.01)


def test_folder_of_a_run_stands_for_its_map(cloud: Path) -> None:
    cloud.rename(cloud.with_name("map.ply"))
    assert measure(cloud.parent)[0]["volume_m3"] == pytest.approx(TRUE_M3, rel=0.01)


def test_millimetres_are_noticed_and_scale_mends_them(tmp_path: Path) -> None:
    save_point_map(heap(scale=1000.0), tmp_path / "mm.ply")
    with pytest.raises(FileFormatError, match=r"--scale 0\.001"):
        measure(tmp_path / "mm.ply")
    assert measure(tmp_path / "mm.ply", scale=0.001)[0]["volume_m3"] == pytest.approx(TRUE_M3, rel=0.01)


def test_centimetres_are_noticed(tmp_path: Path) -> None:
    save_point_map(heap(scale=100.0), tmp_path / "cm.ply")
    with pytest.raises(FileFormatError, match=r"--scale 0\.01,"):
        measure(tmp_path / "cm.ply")


@pytest.mark.parametrize(("stored", "told"), [(np.float32, True), (np.float64, False)])
def test_survey_coordinates_in_single_precision_are_told(tmp_path: Path, stored: type, told: bool) -> None:
    whole = heap()
    points = (whole.points_map + [431_000.0, 5_412_000.0, 312.0]).astype(stored).astype(np.float64)
    far = PointMap(points_map=points, keyframe_id=whole.keyframe_id, range_m=whole.range_m, path_map=whole.path_map)
    save_point_map(far, tmp_path / "utm.ply")
    report = measure(tmp_path / "utm.ply")[0]
    assert any("steps of 0.5 m" in w for w in report["warnings"]) == told
    assert report["volume_m3"] == pytest.approx(TRUE_M3, rel=0.02)


def test_floor_by_hand_is_taken(cloud: Path) -> None:
    report, volume, _ = measure(cloud, floor="1.0")
    assert np.nanmax(volume.floor_z_m) == 1.0
    assert report["volume_m3"] != pytest.approx(TRUE_M3, rel=0.05)


def test_thin_cloud_gets_larger_cells(tmp_path: Path) -> None:
    thin = heap(3_000)
    assert fitting_cell_m(thin) > 2 * fitting_cell_m(heap())
    save_point_map(thin, tmp_path / "thin.ply")
    assert measure(tmp_path / "thin.ply")[0]["volume_m3"] == pytest.approx(TRUE_M3, rel=0.04)


def test_points_that_are_not_numbers_are_passed_over(tmp_path: Path) -> None:
    whole = heap()
    points = whole.points_map.copy()
    points[::7] = np.nan
    broken = PointMap(points_map=points, keyframe_id=whole.keyframe_id, range_m=whole.range_m, path_map=whole.path_map)
    save_point_map(broken, tmp_path / "nan.ply")
    assert measure(tmp_path / "nan.ply")[0]["volume_m3"] == pytest.approx(TRUE_M3, rel=0.01)


@pytest.mark.parametrize(
    ("points", "says"),
    [
        (np.zeros((0, 3)), "no points"),
        (np.full((500, 3), np.nan), "none of them finite"),
        (np.zeros((20, 3)), "only 20 points"),
        (np.random.default_rng(0).uniform(0, 0.1, (500, 3)), "too small"),
        (np.random.default_rng(0).uniform(0, 1, (500, 3)) * [5, 5, 80], "is z up"),
    ],
)
def test_cloud_that_cannot_be_measured_is_refused(tmp_path: Path, points: np.ndarray, says: str) -> None:
    bad = PointMap(
        points_map=points,
        keyframe_id=np.zeros(len(points), dtype=np.int64),
        range_m=np.zeros(len(points)),
        path_map=np.zeros((0, 3)),
    )
    save_point_map(bad, tmp_path / "bad.ply")
    with pytest.raises(FileFormatError, match=says):
        measure(tmp_path / "bad.ply")


def test_missing_file_and_empty_folder_are_told(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="no such file"):
        measure(tmp_path / "nowhere.ply")
    with pytest.raises(FileFormatError, match="folder"):
        measure(tmp_path)


@pytest.mark.parametrize(
    "options",
    [["--cell", "0"], ["--cell", "9"], ["--floor", "low"], ["--level", "1"], ["--scale", "-1"], ["--density", "0"]],
)
def test_wrong_option_is_wrong_use(cloud: Path, options: list[str]) -> None:
    assert RUNNER.invoke(APP, [str(cloud), *options]).exit_code == 2
