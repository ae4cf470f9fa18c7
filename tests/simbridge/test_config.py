"""Bad worlds are refused, and the text says where, and what is allowed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import trimesh
import yaml
from pydantic import ValidationError

from simbridge.config import LidarSimConfig, SimConfig, WorldConfig
from tests.simbridge.stores import CONE, HALL, sim_config

BAD_WORLDS: list[tuple[dict[str, Any], str, str]] = [
    ({"footprint": [[0, 0], [20, 0], [0, 12], [20, 12]]}, "footprint", "simple polygon"),
    ({"footprint": [[0, 0], [20, 0]]}, "footprint", "at least 3"),
    ({"footprint": [[0, 0], [20, 0], [20, float("nan")]]}, "footprint", "finite"),
    ({"footprint": "round"}, "footprint", "{circle: {center"),
    ({"footprint": {"circle": {"center": [0, 0]}}}, "footprint.round.circle.radius_m", "required"),
    ({"height": 10}, "height", "not permitted"),
    ({"height_m": -3}, "height_m", "greater than"),
    ({"height_m": "10 ft"}, "height_m", "number"),
    ({"piles": [{**CONE, "center": [60, 6]}]}, "piles.0", "outside the footprint"),
    ({"piles": [{**CONE, "center": [19, 6]}]}, "piles.0", "leaning: true"),
    ({"piles": [{**CONE, "kind": "pyramid"}]}, "piles", "'cone', 'ridge', 'gaussians', 'function', 'mesh'"),
    ({"piles": [{**CONE, "repose_deg": 80}]}, "repose_deg", "less than or equal to 60"),
    ({"piles": [{"kind": "mesh", "file": "nowhere.stl"}]}, "piles", "no such file: nowhere.stl"),
    ({"columns": [{"center": [21, 5], "radius_m": 0.3}]}, "columns.0", "within the walls"),
    ({"columns": [{"center": [5, 5]}]}, "columns", "radius_m (round) or size_m"),
    ({"boxes": [{"center": [0, 5], "size_m": [1, 1, 1]}]}, "boxes.0", "within the walls"),
    ({"pilasters": [{"wall": 4}]}, "pilasters.0.wall", "0 to 3, or all"),
]


@pytest.mark.parametrize(("change", "key", "allowed"), BAD_WORLDS, ids=[key for _, key, _ in BAD_WORLDS])
def test_bad_world_is_refused_with_key_and_what_is_allowed(change: dict[str, Any], key: str, allowed: str) -> None:
    with pytest.raises(ValidationError) as refusal:
        WorldConfig.model_validate({**HALL, **change})
    assert key in str(refusal.value)
    assert allowed in str(refusal.value)


@pytest.mark.parametrize(
    ("start", "reason"),
    [
        ([30, 6], "outside the footprint"),
        ([0.5, 6], "0.50 m from a wall"),
        ([13, 6, 90], "on a pile"),
        ([6, 3], "from columns[0]"),
        ({"circle": {"center": [13, 6], "radius_m": 1}}, "on a pile"),
        ({"circle": {"center": [50, 6], "radius_m": 1}}, "outside the footprint"),
        ("here", "[x, y, yaw_deg] or {circle"),
        ([1, 2, 3, 4], "[x, y, yaw_deg] or {circle"),
    ],
)
def test_start_where_nothing_can_stand_is_refused(start: Any, reason: str) -> None:
    world = {"piles": [CONE], "columns": [{"center": [6, 3.5], "radius_m": 0.3}]}
    with pytest.raises(ValidationError, match=r"vehicle\.start") as refusal:
        sim_config(world=world, vehicle={"start": start})
    assert reason in str(refusal.value)


@pytest.mark.parametrize(
    "expression", ["__import__('os')", "x.__class__", "open('f')", "lambda: 1", "'text'", "x +", "[x for x in y]"]
)
def test_expression_that_is_not_arithmetic_is_refused(expression: str) -> None:
    pile = {"kind": "function", "expression": expression, "center": [13, 6], "radius_m": 3}
    with pytest.raises(ValidationError, match=r"allowed|not an expression|may be called"):
        WorldConfig.model_validate({**HALL, "piles": [pile]})


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"rows_off": [5]}, "allowed are 0 to 4"),
        ({"rows": 7}, "5, 16, 32 or 64"),
        ({"elevation_min_deg": 10.0}, "must be below elevation_max_deg, 0"),
        ({"min_range_m": 60.0}, "must be below max_range_m, 50"),
        ({"noise_mm": 3}, "not permitted"),
    ],
)
def test_bad_lidar_is_refused(change: dict[str, Any], text: str) -> None:
    with pytest.raises(ValidationError, match=text):
        LidarSimConfig.model_validate(change)


def test_config_cannot_be_changed_after_loading() -> None:
    cfg = sim_config()
    with pytest.raises(ValidationError, match="frozen"):
        cfg.world.height_m = 3.0  # type: ignore[misc]


def test_config_survives_a_round_trip_through_json() -> None:
    cfg = sim_config(world={"piles": [CONE], "columns": [{"center": [6, 3.5], "radius_m": 0.3}]})
    assert SimConfig.model_validate_json(cfg.model_dump_json()) == cfg


def test_store_described_in_the_documentation_is_accepted(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "worlds.md").read_text(encoding="utf-8")
    example = yaml.safe_load(page.split("```yaml\n")[1].split("```")[0])
    trimesh.creation.cone(radius=3000.0, height=2000.0).export(tmp_path / "heap.stl")
    for pile in example["world"]["piles"]:
        if pile["kind"] == "mesh":
            pile["file"] = str(tmp_path / pile["file"])
    cfg = SimConfig.model_validate(example)
    assert {pile.kind for pile in cfg.world.piles} == {"cone", "ridge", "gaussians", "function", "mesh"}
