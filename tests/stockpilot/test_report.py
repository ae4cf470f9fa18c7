"""What people read: the page, the summary, the pictures."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib import image
from rich.console import Console

from companion.config import VolumeConfig
from companion.messages import PointMap, VolumeReport
from companion.volume import estimate_volume
from stockpilot.pictures import draw_map, draw_surface, draw_trajectory
from stockpilot.report import text_summary, write_report_page

REPORT: dict[str, Any] = {
    "mission": "cement <store>",
    "seed": 3,
    "autopilot": "emulated",
    "state": "completed",
    "reason": "",
    "forward_speed_mps": 0.43,
    "flight_time_s": 301.2,
    "keyframes": 62,
    "lap_closed": True,
    "collision": False,
    "volume_m3": 1109.24,
    "volume_interval_m3": [1104.4, 1114.1],
    "volume_interval_level": 0.95,
    "seen_ratio": 0.947,
    "interpolated_ratio": 0.053,
    "unseen_ratio": 0.0,
    "warnings": ["12 % of the floor was not seen & <guessed>"],
    "truth_volume_m3": 1108.01,
    "e_v_percent": 0.11,
    "truth_in_interval": True,
    "e_p_m": 0.018,
    "c_c": 310,
    "error_budget_m3": {"position": 2.3, "floor": 0.2, "unseen": 0.0},
    "paper": {"volume_m3": 1221.0, "e_v_percent": 10.2, "e_p_m": 0.57, "c_c": 3000},
}


def summary(report: dict[str, Any]) -> str:
    console = Console(width=120, record=True, force_terminal=False)
    with console.capture() as captured:
        console.print(text_summary(report))
    return captured.get()


@pytest.fixture(scope="module")
def cloud() -> PointMap:
    rng = np.random.default_rng(3)
    xy = rng.uniform([-14, -12], [14, 12], (40_000, 2))
    z = np.maximum(4.0 - 0.6 * np.hypot(*xy.T), 0.0) + rng.normal(0, 0.02, len(xy))
    return PointMap(
        points_map=np.column_stack([xy, z]),
        keyframe_id=np.zeros(len(xy), dtype=np.int64),
        range_m=np.zeros(len(xy)),
        path_map=np.array([[-5.0, -5, 6], [5, -5, 6], [5, 5, 6]]),
    )


@pytest.fixture(scope="module")
def measured(cloud: PointMap) -> VolumeReport:
    return estimate_volume(cloud, VolumeConfig())


def draw_all(folder: Path, cloud: PointMap, volume: VolumeReport) -> dict[str, Path]:
    hall = np.array([[-14, -12], [14, -12], [14, 12], [-14, 12.0]])
    path = cloud.path_map[:, :2]
    return {
        "trajectory": draw_trajectory(
            folder / "t.png",
            outlines=[hall],
            pile_outlines=[0.4 * hall],
            truth_world_m=path,
            estimated_world_m=path + 0.02,
            paper_world_m=path + 0.5,
            title="a flight",
        ),
        "map": draw_map(folder / "m.png", cloud),
        "surface": draw_surface(folder / "s.png", volume),
    }


def test_page_needs_nothing_beside_it(tmp_path: Path, cloud: PointMap, measured: VolumeReport) -> None:
    page = write_report_page(tmp_path / "report.html", REPORT, draw_all(tmp_path, cloud, measured)).read_text()
    assert page.count("data:image/png;base64,") == 3
    assert not re.search(r"""(?:src|href)=["'](?!data:)""", page)
    assert "http" not in page
    assert sorted(p.name for p in tmp_path.iterdir()) == ["m.png", "report.html", "s.png", "t.png"]


def test_page_tells_number_interval_warnings_and_paper(tmp_path: Path) -> None:
    page = write_report_page(tmp_path / "report.html", REPORT, {}, bulk_density_t_m3=1.4).read_text()
    for told in ("1,109.2 m³", "1,104.4 to 1,114.1 m³ with 95 % confidence", "1,553 t", "94.7 %", "10.20 %", "0.570 m"):
        assert told in page
    assert "Read this before you use the number" in page


def test_page_escapes_what_comes_from_outside(tmp_path: Path) -> None:
    page = write_report_page(tmp_path / "report.html", REPORT, {}).read_text()
    assert "cement &lt;store&gt;" in page
    assert "not seen &amp; &lt;guessed&gt;" in page
    assert "<store>" not in page


def test_failed_flight_is_plain_to_see(tmp_path: Path) -> None:
    failed = {**REPORT, "state": "aborted", "collision": True, "truth_in_interval": False}
    page = write_report_page(tmp_path / "report.html", failed, {}).read_text()
    assert 'class="badge bad">aborted' in page
    assert "<td>YES</td>" in page
    assert "<td>NO</td>" in page


@pytest.mark.parametrize(
    "report",
    [
        {},
        {"mission": "m", "volume_m3": None, "volume_interval_m3": None, "paper": {"volume_m3": None}},
        {"cloud": "a.ply", "volume_m3": float("nan"), "volume_interval_m3": [0.0, float("inf")], "seen_ratio": None},
        {**REPORT, "volume_m3": 0.0, "volume_interval_m3": [0.0, 0.0]},
    ],
    ids=["nothing", "nulls", "not numbers", "no pile"],
)
def test_what_is_not_known_is_left_out(tmp_path: Path, report: dict[str, Any]) -> None:
    page = write_report_page(tmp_path / "report.html", report, {"map": tmp_path / "missing.png"}).read_text()
    body = page[page.index("<body>") :]
    for odd in ("None", "nan", "inf ", "<img"):
        assert odd not in body
    assert summary(report)


def test_summary_says_it_all_in_text() -> None:
    text = summary(REPORT)
    for told in ("1,109.2 m³", "1,104.4 to 1,114.1", "closed", "true volume", "the paper's pipeline", "warning:"):
        assert told in text


def test_every_key_of_the_budget_has_words() -> None:
    from companion.volume.interval import error_budget
    from stockpilot.report import PARTS

    assert error_budget.__doc__
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(0, 20, (5000, 2)), rng.normal(0, 0.02, 5000)])
    flat = PointMap(
        points_map=points,
        keyframe_id=np.zeros(5000, dtype=np.int64),
        range_m=np.zeros(5000),
        path_map=np.zeros((0, 3)),
    )
    assert {name for name, _ in estimate_volume(flat, VolumeConfig(cell_m=0.5)).error_budget_m3} == set(PARTS)


def test_pictures_are_drawn_and_not_blank(tmp_path: Path, cloud: PointMap, measured: VolumeReport) -> None:
    for path in draw_all(tmp_path, cloud, measured).values():
        pixels = image.imread(path)
        assert pixels.shape[0] > 300
        assert pixels.shape[1] > 600
        assert pixels[..., :3].std() > 0.05


def test_pictures_of_nothing_are_drawn_too(tmp_path: Path) -> None:
    empty = PointMap(
        points_map=np.zeros((0, 3)),
        keyframe_id=np.zeros(0, dtype=np.int64),
        range_m=np.zeros(0),
        path_map=np.zeros((0, 3)),
    )
    assert draw_map(tmp_path / "m.png", empty).is_file()
    assert draw_surface(tmp_path / "s.png", estimate_volume(empty, VolumeConfig())).is_file()
    nowhere = np.zeros((0, 2))
    picture = draw_trajectory(
        tmp_path / "t.png", outlines=[], truth_world_m=nowhere, estimated_world_m=nowhere, paper_world_m=nowhere
    )
    assert picture.is_file()


def test_a_flight_that_was_cut_short_tells_the_least_and_no_most() -> None:
    text = summary(REPORT | {"volume_interval_m3": [1104.4, None]})
    assert "at least 1,104.4 m³" in text
    assert "1,114.1" not in text
