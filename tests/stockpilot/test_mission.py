"""Missions: every key can be set, every fault is told by file, line, key, value and what is allowed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from companion.errors import ConfigError
from stockpilot.cli import main
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
        ("navigator.height_m=yes", ["navigator.height_m = True", "must be a number"]),
        ("world.piles.0.length_m=true", ["world.piles.0.length_m = True", "must be a number"]),
        ("navigator.height_m=.nan", ["navigator.height_m = nan", "finite"]),
        ("navigator.turn_rate_dps=.inf", ["navigator.turn_rate_dps = inf"]),
        ("lidar.max_range_m=0", ["lidar.max_range_m = 0", "greater than 0"]),
        ("lidar.elevation_max_deg=-20", ["lidar.elevation_max_deg = -20", "horizon"]),
        ("lidar.mount_rpy_deg=[0, 90, 0]", ["lidar.mount_rpy_deg", "within 15 deg"]),
        ("lidar=5", ["lidar = 5", "section of keys and values"]),
        ("navigator=[1]", ["navigator = [1]", "section of keys and values"]),
        ("world.piles=cone", ["world.piles = 'cone'", "must be a list"]),
        ("world.piles.0.kind=cube", ["world.piles.0.kind = 'cube'", "'cone', 'ridge', 'gaussians'"]),
        ("world.piles=[{center: [27, 15], height_m: 3}]", ["world.piles.0.kind", "is missing", "cone, ridge"]),
        ("world.piles.0.foo=1", ["world.piles.0.foo = 1", "unknown key", "repose_deg"]),
        ("world.piles.0.repose_deg=0.6", ["world.piles.0.repose_deg = 0.6", "greater than or equal to 5"]),
        ("world.piles.0.center=[80, 15]", ["world.piles.0", "outside the footprint"]),
        (
            "world.piles=[{kind: cone, center: [27, 15], repose_deg: 50, height_m: 16}]",
            ["world.piles.0", "ceiling at 15 m"],
        ),
        (
            "world.piles=[{kind: cone, center: [27, 15], repose_deg: 50, height_m: 9}]",
            ["navigator.height_m = 9", "world.piles.0, which reaches to", "fly round it"],
        ),
        ("world.boxes=[{center: [20, 5], size_m: [2, 2, 8.7]}]", ["navigator.height_m = 9", "boxes[0]", "8.7 m"]),
        ("world.floor_slope=[0.6, 0]", ["world.floor_slope", "the floor rises to 15.0 m"]),
        ("world.floor_slope=[0.25, 0]", ["navigator.height_m = 9", "floor rises to 11.4 m above the start"]),
        ("world.footprint=[[0, 0], [0, 0], [50, 0], [50, 30], [0, 30]]", ["world.footprint", "corners 0 and 1"]),
        ("world.footprint=[[0, 0], [50, 30]]", ["world.footprint", "must be a list of at least 3, not 2"]),
        (
            "world.footprint=[[0, 0], [1.0e+7, 0], [1.0e+7, 1.0e+7], [0, 1.0e+7]]",
            ["world.footprint", "cells of pile_cell_m"],
        ),
        ("world.wind.mean_mps=[50, 0, 0]", ["world.wind.mean_mps.0 = 50", "15"]),
        ("vehicle.mass_kg=20", ["vehicle.max_thrust_n = 20.6", "63.8"]),
        ("vehicle.start=[0.5, 10]", ["vehicle.start", "0.50 m from a wall"]),
        ("vehicle.start=[27, 15]", ["vehicle.start", "on a pile"]),
        ("autopilot.params.NOPE=1", ["autopilot.params.NOPE = 1", "emulated PX4 carries"]),
        ("autopilot.params.EKF2_EV_DELAY=.nan", ["autopilot.params.EKF2_EV_DELAY = nan", "finite number"]),
        ("name=../../elsewhere", ["name = '../../elsewhere'", "letters, digits"]),
        ("name=[1, 2]", ["name = [1, 2]", "letters, digits"]),
    ],
)
def test_fault_names_key_value_and_what_is_allowed(setting: str, told: list[str]) -> None:
    with pytest.raises(ConfigError) as error:
        load_mission(CEMENT, [setting])
    text = str(error.value)
    assert str(CEMENT) in text
    for part in told:
        assert part in text


@pytest.mark.parametrize(
    ("expression", "told"),
    [
        ("__import__('os').system('true')", "only the named functions may be called"),
        ("z + 1", "unknown name 'z'"),
        ("1 / 0", "cannot be computed"),
        ("9**9**9**9", "cannot be computed"),
        ("sin()", "cannot be computed"),
        ("not x", "cannot be computed"),
        ("(" * 300 + "x" + ")" * 300, "not an expression"),
        ("-1", "holds no material"),
        ("x * 0 / 0", "holds no material"),
        ("1e300", "reaches the ceiling"),
    ],
)
def test_an_expression_that_makes_no_pile_is_refused_at_once(expression: str, told: str) -> None:
    pile = {"kind": "function", "expression": expression, "center": [27, 15], "radius_m": 5}
    with pytest.raises(ConfigError, match=r"cement_store\.yaml:\d+: world\.piles\.0") as error:
        load_mission(CEMENT, [f"world.piles={json.dumps([pile])}"])
    assert told in str(error.value)


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("missing.stl", None, "no such file"),
        ("words.stl", b"this is not a mesh\n", "holds no triangles"),
        ("empty.obj", b"", "holds no triangles"),
        ("heap.docx", b"abc", "cannot be read as a mesh"),
        ("sunken.obj", b"v 0 0 -1\nv 1 0 -1\nv 0 1 -1\nf 1 2 3\n", "below z = 0"),
        ("tower.obj", b"v 0 0 0\nv 3 0 0\nv 0 3 20\nf 1 2 3\n", "reaches the ceiling"),
    ],
)
def test_a_mesh_that_is_none_is_refused_by_its_key(tmp_path: Path, name: str, content: bytes | None, told: str) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    pile = {"kind": "mesh", "file": str(tmp_path / name), "center": [27, 15]}
    with pytest.raises(ConfigError, match=r"world\.piles\.0") as error:
        load_mission(CEMENT, [f"world.piles={json.dumps([pile])}"])
    assert told in str(error.value)


def test_a_pile_that_rises_well_above_the_flight_is_allowed_since_it_is_seen_and_flown_round() -> None:
    assert (
        load_mission(CEMENT, ["world.piles=[{kind: cone, center: [27, 15], repose_deg: 50, height_m: 10.5}]"]).sim
        is not None
    )


def test_a_footprint_may_go_clockwise_and_may_repeat_its_first_corner() -> None:
    for corners in ("[[0, 0], [0, 30], [50, 30], [50, 0]]", "[[0, 0], [50, 0], [50, 30], [0, 30], [0, 0]]"):
        assert load_mission(CEMENT, [f"world.footprint={corners}"]).sim is not None


@pytest.mark.parametrize("what", ["directory", "binary", "empty", "loop", "missing"])
def test_the_command_refuses_what_is_no_mission_with_exit_code_2_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], what: str
) -> None:
    path = tmp_path / "bad.yaml"
    if what == "directory":
        path.mkdir()
    elif what != "missing":
        path.write_bytes({"binary": bytes(range(256)), "empty": b"", "loop": b"a: &a [*a]\n"}[what])
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["stockpilot", "run", str(path)])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith(f"error: {path}")
    assert len(err.splitlines()) == 1
    assert sorted(tmp_path.rglob("*")) == before


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
        ("seed: 2020-01-01", "seed = datetime.date(2020, 1, 1): must be a whole number"),
        ("a: &a [*a]", "holds itself"),
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


@pytest.mark.parametrize("command", ["run", "sim"])
def test_the_mission_says_which_flight_controller_flies(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """px4 asks for its binary; the emulated one would not look at that path."""
    silo = str(MISSIONS / "silo.yaml")
    arguments = [command, silo, "--set", "autopilot.kind=px4", "--autopilot-binary", str(tmp_path / "none")]
    monkeypatch.setattr("sys.argv", ["stockpilot", *arguments, *(["--out", str(tmp_path)] if command == "run" else [])])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 2
    assert "not an executable file; give the SITL binary" in capsys.readouterr().err
