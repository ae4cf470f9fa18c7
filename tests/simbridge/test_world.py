"""The store is what its mission says, and its true volume is that of the surface the rays meet."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import shapely
import trimesh
import yaml

from simbridge.config import SimConfig, WorldConfig
from simbridge.loop import start_pose
from simbridge.model import RAY_GROUPS
from simbridge.world import World, build_world, widest_wall_distance_m
from tests.simbridge.stores import CONE, HALL, sim_config

CONE_M3 = math.pi * 3.0**3 / (3.0 * math.tan(math.radians(34)) ** 2)
SHIPPED = ["cement_store", "leaning_pile", "l_shaped", "columns", "silo"]


def build(**world: Any) -> World:
    return build_world(WorldConfig.model_validate({**HALL, **world}))


def shipped(name: str) -> tuple[SimConfig, dict[str, Any]]:
    mission = yaml.safe_load((Path("missions") / f"{name}.yaml").read_text(encoding="utf-8"))
    return SimConfig.model_validate({k: mission[k] for k in SimConfig.model_fields if k in mission}), mission


@pytest.fixture(autouse=True)
def _from_the_repository(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(Path(__file__).parents[2])


def test_volume_of_a_cone_is_the_analytic_one() -> None:
    assert build(piles=[CONE], pile_cell_m=0.1).true_volume_m3 == pytest.approx(CONE_M3, rel=1e-3)


def test_wall_halves_a_cone_that_leans_on_it() -> None:
    cone = {**CONE, "center": [10, 0], "leaning": True}
    assert build(piles=[cone], pile_cell_m=0.1).true_volume_m3 == pytest.approx(CONE_M3 / 2, rel=1e-3)


def test_slanting_wall_cuts_exactly() -> None:
    footprint = [[0, 0], [20, 4], [20, 16], [0, 12]]
    cone = {**CONE, "center": [10, 2], "leaning": True}  # on the slanting wall
    assert build(footprint=footprint, piles=[cone], pile_cell_m=0.1).true_volume_m3 == pytest.approx(
        CONE_M3 / 2, rel=1e-3
    )


def test_ridge_is_a_prism_and_a_cone() -> None:
    ridge = {**CONE, "kind": "ridge", "center": [10, 6], "length_m": 6, "yaw_deg": 10}
    prism = 3.0**2 / math.tan(math.radians(34)) * 6.0
    assert build(piles=[ridge], pile_cell_m=0.1).true_volume_m3 == pytest.approx(CONE_M3 + prism, rel=1e-3)


def test_the_same_pile_twice_counts_once() -> None:
    assert build(piles=[CONE, CONE]).true_volume_m3 == pytest.approx(build(piles=[CONE]).true_volume_m3, rel=1e-12)


def test_overlapping_piles_count_as_their_union() -> None:
    two = build(piles=[CONE, {**CONE, "center": [10, 6]}]).true_volume_m3
    x, y = np.meshgrid(np.arange(0.025, 20, 0.05), np.arange(0.025, 12, 0.05))
    slope = math.tan(math.radians(34))
    top = np.maximum.reduce([3 - slope * np.hypot(x - 13, y - 6), 3 - slope * np.hypot(x - 10, y - 6), 0 * x])
    assert two == pytest.approx(float(top.sum()) * 0.05**2, rel=2e-3)


def test_cone_on_a_sloping_floor_counts_from_that_floor() -> None:
    # A plane z = s x cuts a cone of slope t, peak h above it, into V = h^3 pi / (3 t^2 (1 - (s/t)^2)^(3/2)).
    s, t = 0.05, math.tan(math.radians(34))
    wanted = math.pi * 27 / (3 * t**2) / (1 - (s / t) ** 2) ** 1.5
    assert build(piles=[CONE], floor_slope=[s, 0], pile_cell_m=0.1).true_volume_m3 == pytest.approx(wanted, rel=2e-3)


def test_column_displaces_material() -> None:
    column = {"center": [13, 6], "size_m": [0.6, 0.6]}
    missing = CONE_M3 - build(piles=[CONE], columns=[column], pile_cell_m=0.1).true_volume_m3
    mean_height = 3.0 - math.tan(math.radians(34)) * 0.3826 * 0.6  # 0.3826: mean distance from a unit square's centre
    assert missing == pytest.approx(0.36 * mean_height, rel=0.02)


def test_buried_box_displaces_only_its_own_volume() -> None:
    box = {"center": [13, 6], "size_m": [1, 1, 0.5], "yaw_deg": 30}
    missing = build(piles=[CONE]).true_volume_m3 - build(piles=[CONE], boxes=[box]).true_volume_m3
    assert missing == pytest.approx(0.5, rel=0.01)


def test_pile_does_not_come_out_on_the_other_side_of_its_wall() -> None:
    footprint = [[0, 0], [20, 0], [20, 12], [10.5, 12], [10.5, 4], [9.5, 4], [9.5, 12], [0, 12]]  # two arms
    world = build(footprint=footprint, piles=[{**CONE, "center": [8, 10], "leaning": True}])
    assert world.surface_height(9.0, 10.0) > 2.0
    assert world.surface_height(11.0, 10.0) == 0.0  # 3 m from the peak: 1 m high, were there no wall between


def test_gaussian_hills_and_an_expression_agree() -> None:
    hills = {"kind": "gaussians", "hills": [{"center": [10, 6], "height_m": 3, "sigma_m": 1.5}]}
    text = "3 * exp(-((x - 10)**2 + (y - 6)**2) / (2 * 1.5**2)) - 0.05"
    function = {"kind": "function", "expression": text, "center": [10, 6], "radius_m": 5.5}
    assert build(piles=[function]).true_volume_m3 == pytest.approx(build(piles=[hills]).true_volume_m3, rel=1e-3)


def test_mesh_file_becomes_a_pile_of_its_volume(tmp_path: Path) -> None:
    file = tmp_path / "cone.stl"
    trimesh.creation.cone(radius=300.0, height=200.0, sections=64).export(file)  # centimetres
    pile = {"kind": "mesh", "file": str(file), "center": [10, 6], "scale": 0.01}
    assert build(piles=[pile], pile_cell_m=0.1).true_volume_m3 == pytest.approx(math.pi * 9 * 2 / 3, rel=0.01)


def test_rays_meet_the_surface_that_the_volume_is_of() -> None:
    world = build(piles=[{**CONE, "unevenness_m": 0.2}], floor_slope=[0.02, -0.01])
    data, rng = world.new_data(), np.random.default_rng(1)
    for x, y in rng.uniform((0.5, 0.5), (19.5, 11.5), (300, 2)):
        down = mujoco.mj_ray(
            world.model, data, np.array([x, y, 8.0]), np.array([0, 0, -1.0]), RAY_GROUPS, 1, -1, None, None
        )
        assert 8.0 - down == pytest.approx(world.surface_height(x, y), abs=1e-5)


@pytest.mark.parametrize("roughness", [0.0, 0.1])
def test_no_ray_leaves_the_hall(roughness: float) -> None:
    footprint = [[0, 0], [20, 0], [20, 9], [10, 9], [10, 20], [0, 20]]
    world = build(footprint=footprint, wall_roughness={"rms_m": roughness})
    rays = np.random.default_rng(2).normal(size=(20_000, 3))
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    origin, distance, geom = np.array([5.0, 5.0, 4.0]), np.zeros(20_000), np.zeros(20_000, dtype=np.int32)
    mujoco.mj_multiRay(
        world.model, world.new_data(), origin, rays.ravel(), RAY_GROUPS, 1, -1, geom, distance, None, 20_000, 1e3
    )
    hits = origin + rays * distance[:, None]
    assert distance.min() > 0
    assert shapely.contains_xy(world.footprint.buffer(0.001 + 5 * roughness), hits[:, 0], hits[:, 1]).all()
    if roughness == 0.0:
        on_wall = (hits[:, 2] > 0.001) & (hits[:, 2] < 9.999)
        off = shapely.distance(world.footprint.exterior, shapely.points(hits[on_wall, :2]))
        assert off.max() < 1e-6


@pytest.mark.parametrize("footprint", [None, [[0, 0], [0, 20], [20, 20], [20, 8], [9, 8], [9, 0]]])
def test_rays_meet_planes_where_they_would_meet_the_mesh_of_the_walls(
    footprint: list[list[float]] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Corners clockwise in the second: either order is allowed."""
    rays = np.random.default_rng(3).normal(size=(20_000, 3))
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    seen = []
    for most_planes in (16, 0):
        monkeypatch.setattr("simbridge.model.MOST_PLANES", most_planes)
        world = build(**({"footprint": footprint} if footprint else {}))
        distance, normals, geom = np.zeros(20_000), np.zeros(60_000), np.zeros(20_000, dtype=np.int32)
        mujoco.mj_multiRay(
            world.model, world.new_data(), np.array([5.0, 6.0, 4.0]), rays.ravel(), RAY_GROUPS, 1, -1, geom, distance,
            normals, 20_000, 1e3,
        )  # fmt: skip
        seen.append((distance, np.abs(np.sum(rays * normals.reshape(-1, 3), axis=1))))
    (planes, plane_cosines), (mesh, mesh_cosines) = seen
    assert np.abs(planes - mesh).max() < 1e-5
    assert np.abs(plane_cosines - mesh_cosines).max() < 1e-5


def test_clearance_counts_walls_obstacles_ceiling_and_piles_but_not_the_floor() -> None:
    column = {"center": [8, 6], "radius_m": 0.5}
    box = {"center": [4, 10], "size_m": [2, 2, 1]}
    world = build(piles=[CONE], columns=[column], boxes=[box])
    assert world.clearance(np.array([2.0, 6.0, 0.1])) == pytest.approx(2.0)
    assert world.clearance(np.array([7.0, 6.0, 5.0])) == pytest.approx(0.5)
    assert world.clearance(np.array([4.0, 8.0, 2.0])) == pytest.approx(math.hypot(1.0, 1.0))
    assert world.clearance(np.array([10.0, 4.0, 9.5])) == pytest.approx(0.5)
    slope = math.radians(34)  # 2 m above the flank, half way down
    flank = np.array([13 + 1.5 / math.tan(slope), 6.0, 3.5])
    assert world.clearance(flank) == pytest.approx(2.0 * math.cos(slope), abs=0.02)
    assert world.clearance(np.array([13.0, 6.0, 1.0])) == 0.0
    assert world.clearance(np.array([30.0, 6.0, 1.0])) == 0.0


def test_widest_wall_distance_is_half_the_width() -> None:
    assert widest_wall_distance_m(WorldConfig.model_validate(HALL)) == pytest.approx(6.0, abs=0.02)


def test_outlines_hold_walls_and_obstacles() -> None:
    world = build(columns=[{"center": [8, 6], "size_m": [1, 1]}], piles=[CONE])
    walls, column = world.outlines()
    assert sorted(map(tuple, walls.tolist())) == [(0, 0), (0, 12), (20, 0), (20, 12)]
    assert sorted(map(tuple, column.tolist())) == [(7.5, 5.5), (7.5, 6.5), (8.5, 5.5), (8.5, 6.5)]
    assert shapely.Polygon(world.plan.piles[0]).area == pytest.approx(math.pi * (3 / math.tan(0.5934)) ** 2, rel=0.1)


@pytest.mark.parametrize("name", SHIPPED)
def test_lap_of_a_shipped_world_is_clear(name: str) -> None:
    cfg, mission = shipped(name)
    navigator = mission["navigator"]
    world = build_world(cfg.world)
    lap = world.footprint.buffer(-navigator["wall_distance_m"])
    assert lap.geom_type == "Polygon"
    for at in np.arange(0.0, lap.exterior.length, 1.0):
        place = lap.exterior.interpolate(at)
        assert world.clearance(np.array([place.x, place.y, navigator["height_m"]])) > 4.0
    assert 400 < world.true_volume_m3 < 1100
    assert world.surface.z.max() < navigator["height_m"] - 2.0


def test_cement_store_is_as_asked() -> None:
    cfg, _ = shipped("cement_store")
    world = build_world(cfg.world)
    assert world.footprint.bounds == (0, 0, 50, 30)
    assert world.height_m == 15
    assert world.true_volume_m3 == pytest.approx(1000, rel=0.05)


def test_start_in_a_circle_differs_by_seed_and_stays_in_it() -> None:
    start = {"circle": {"center": [4, 6], "radius_m": 2}}
    poses = [start_pose(sim_config(vehicle={"start": start}, seed=seed)) for seed in range(20)]
    assert len(set(poses)) == 20
    assert all(math.hypot(x - 4, y - 6) <= 2 for x, y, _ in poses)
    assert start_pose(sim_config(vehicle={"start": start}, seed=7)) == poses[7]
    fixed = start_pose(sim_config(vehicle={"start": {**start, "yaw_deg": 90}}, seed=7))
    assert fixed[2] == pytest.approx(math.pi / 2)


def test_bumps_by_seed_draw_another_store_for_each_seed() -> None:
    rough = {"piles": [{**CONE, "unevenness_m": 0.2}], "wall_roughness": {"rms_m": 0.1}}

    def of_seed(seed: int, **world: Any) -> World:
        return build_world(sim_config(world={**rough, **world}, seed=seed).store)

    def walls(seed: int) -> Any:
        return of_seed(seed, bumps_by_seed=True, piles=[]).model.mesh_vert

    drawn = [of_seed(seed, bumps_by_seed=True) for seed in (0, 1)]
    assert drawn[0].true_volume_m3 != pytest.approx(drawn[1].true_volume_m3, rel=1e-6)
    assert of_seed(1, bumps_by_seed=True).true_volume_m3 == drawn[1].true_volume_m3
    assert np.abs(walls(0) - walls(1)).max() > 0.1
    assert np.array_equal(walls(1), walls(1))
    plain = [of_seed(seed).true_volume_m3 for seed in (0, 1)]
    assert plain[0] == plain[1]
    assert drawn[0].config.bumps_by_seed is False  # drawn once


def test_bumps_drawn_into_the_ceiling_are_refused_with_their_seed() -> None:
    world = {"piles": [{**CONE, "height_m": 9.6, "repose_deg": 60, "unevenness_m": 0.5}], "height_m": 10}
    refused = []
    for seed in range(12):
        try:
            sim_config(world={**world, "bumps_by_seed": True}, seed=seed)
        except ValueError as error:
            refused.append((seed, str(error)))
    assert 0 < len(refused) < 12
    assert all(f"bumps drawn by seed {seed}" in told and "world.piles.0" in told for seed, told in refused)
