"""Missions: every key can be set, every fault is told by file, line, key, value and what is allowed."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.errors import ConfigError
from stockpilot.mission import load_mission, parse_setting

MISSIONS = Path(__file__).resolve().parents[2] / "missions"
CEMENT = MISSIONS / "cement_store.yaml"
SHIPPED = sorted(p for p in MISSIONS.glob("*.yaml") if "sweep" not in p.name)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda p: p.stem)
def test_shipped_mission_is_valid(path: Path) -> None:
    mission = load_mission(path)
    assert mission.sim is not None
    assert mission.name == path.stem


@pytest.mark.parametrize(
    "setting",
    [
        "seed=7", "world.height_m=16", "vehicle.start=[12, 8]", "lidar.rows=16", "lidar.noise_m=0.05",
        "lidar.max_range_m=40", "navigator.forward_speed_mps=0.31", "navigator.wall_distance_m=5",
        "navigator.height_m=8.5", "odometry.keyframe_period_s=1.6", "volume.cell_m=0.5",
    ],
)  # fmt: skip
def test_every_named_key_can_be_set(setting: str) -> None:
    key, value = parse_setting(setting)
    node = load_mission(CEMENT, [setting]).resolved()
    for part in key:
        node = node[part]
    assert node == pytest.approx(value) if not isinstance(value, list) else list(node) == value


def test_lidar_settings_reach_both_sides() -> None:
    mission = load_mission(CEMENT, ["lidar.rows=16", "lidar.max_range_m=33"])
    assert mission.sim is not None
    assert (mission.companion.lidar.rows, mission.sim.lidar.rows) == (16, 16)
    assert (mission.companion.lidar.max_range_m, mission.sim.lidar.max_range_m) == (33, 33)


@pytest.mark.parametrize(
    ("setting", "told"),
    [
        ("navigator.wall_distance_cm=600", ["navigator.wall_distance_cm", "unknown key", "wall_distance_m"]),
        ("navigator.height_m=9 m", ["navigator.height_m", "'9 m'", "number"]),
        ("navigator.wall_distance_m=20", ["navigator.wall_distance_m", "20", "half the clear width"]),
        ("world.footprint=[[0, 0], [50, 30], [50, 0], [0, 30]]", ["world", "cross"]),
        ("lidar.rows=7", ["lidar.rows", "7", "5, 16, 32 or 64"]),
        ("navigater.height_m=3", ["navigater", "did you mean navigator"]),
        ("navigator.height_m=14", ["navigator.height_m", "must be"]),
        ("seed=-1", ["seed", "-1"]),
        ("lidar.min_range_m=60", ["lidar.min_range_m", "60"]),
        ("vehicle.start=[500, 5]", ["vehicle", "start"]),
        ("guard.max_speed_mps=0.2", ["forward_speed_mps", "max_speed_mps"]),
    ],
)
def test_fault_names_key_value_and_what_is_allowed(setting: str, told: list[str]) -> None:
    with pytest.raises(ConfigError) as error:
        load_mission(CEMENT, [setting])
    text = str(error.value)
    assert str(CEMENT) in text
    for part in told:
        assert part in text


def test_fault_names_the_line(tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text("name: bad\nnavigator:\n  height_m: -3\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"bad\.yaml:3: navigator\.height_m = -3: must be greater than 0"):
        load_mission(path)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[1, 2]", "expected sections"),
        ("name: [", "is not YAML"),
        ("navigator: {height_m: 5, height_m: 6}", "given twice"),
        ("navigator: 5", "navigator"),
        ("vehicle: {start: [1, 2]}", "world"),
    ],
)
def test_unreadable_mission_is_refused_by_name(tmp_path: Path, text: str, told: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as error:
        load_mission(path)
    assert told in str(error.value)


def test_missing_mission_suggests_its_neighbour() -> None:
    with pytest.raises(ConfigError, match=r"did you mean .*cement_store\.yaml"):
        load_mission(MISSIONS / "cement_stor.yaml")


@pytest.mark.parametrize("setting", ["navigator.height_m", "=3", "a: b=[", "world.piles.99.height_m=3"])
def test_malformed_setting_is_refused(setting: str) -> None:
    with pytest.raises(ConfigError):
        load_mission(CEMENT, [setting])


def test_resolved_mission_loads_again_to_the_same(tmp_path: Path) -> None:
    import yaml

    first = load_mission(CEMENT, ["seed=5"])
    path = tmp_path / "again.yaml"
    path.write_text(yaml.safe_dump(first.resolved()), encoding="utf-8")
    assert load_mission(path).resolved() == first.resolved()


def test_mission_without_a_world_is_for_flying_only(tmp_path: Path) -> None:
    path = tmp_path / "real.yaml"
    path.write_text("name: real\nnavigator: {height_m: 5}\n", encoding="utf-8")
    assert load_mission(path).sim is None
