"""The map: by keyframe, without dust, never painted with bad scans, bounded."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from companion.config import CompanionConfig
from companion.geometry import quat_from_rpy
from companion.mapping import Mapper
from companion.messages import LevelledScan, OdometryEstimate
from companion.volume import estimate_volume

CFG = CompanionConfig()
ROWS, COLUMNS = 5, 512


def estimate(
    x: float = 0.0, y: float = 0.0, z: float = 5.0, yaw: float = 0.0, keyframe: int = 0, **changes: object
) -> OdometryEstimate:
    base = OdometryEstimate(
        t_ns=0,
        t_scan_ns=0,
        position_map_m=np.array([x, y, z]),
        q_map_body_wxyz=quat_from_rpy(0.02, -0.03, yaw),
        velocity_body_mps=np.zeros(3),
        rate_body_radps=np.zeros(3),
        pose_covariance=np.diag([4e-4, 4e-4, 1e-4, 1e-6, 1e-6, 1e-6]),
        velocity_covariance=np.eye(3) * 0.01,
        quality=90,
        reset_counter=0,
        converged=True,
        is_degenerate=False,
        inliers=400,
        iterations=5,
        keyframe_id=keyframe,
        is_keyframe=False,
    )
    return dataclasses.replace(base, **changes)  # type: ignore[arg-type]


def room_scan(noise_m: float = 0.05, half: float = 10.0, height: float = 5.0, seed: int = 0) -> LevelledScan:
    """A scan from the middle of a square room without a ceiling, seen level, heading along x."""
    rng = np.random.default_rng(seed)
    elevation = np.radians(np.linspace(0, -45, ROWS))[:, None]
    azimuth = (2 * np.pi * np.arange(COLUMNS) / COLUMNS)[None, :]
    d = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation) + 0 * azimuth], -1
    )
    with np.errstate(divide="ignore"):
        to_wall = half / np.maximum(np.abs(d[..., 0]), np.abs(d[..., 1]))
        to_floor = np.where(d[..., 2] < -1e-9, height / np.maximum(-d[..., 2], 1e-9), np.inf)
    distance = np.minimum(to_wall, to_floor) + rng.normal(0, noise_m, d.shape[:2])
    row, column = np.indices(d.shape[:2])
    return LevelledScan(
        t_ns=0,
        points_level=(d * distance[..., None]).reshape(-1, 3),
        range_m=distance.ravel(),
        row=row.ravel().astype(np.int64),
        column=column.ravel().astype(np.int64),
    )


def with_dust(scan: LevelledScan, share: float, seed: int = 1) -> tuple[LevelledScan, np.ndarray]:
    rng = np.random.default_rng(seed)
    dusty = rng.random(len(scan.range_m)) < share
    factor = np.where(dusty, rng.uniform(0.1, 0.8, len(scan.range_m)), 1.0)
    return (
        dataclasses.replace(scan, points_level=scan.points_level * factor[:, None], range_m=scan.range_m * factor),
        dusty,
    )


def test_points_land_where_the_pose_puts_them() -> None:
    mapper = Mapper(CFG)
    scan = room_scan(noise_m=0.0)
    assert mapper.add(scan, estimate(x=3.0, y=-2.0, yaw=np.pi / 2))
    points = mapper.point_map().points_map
    walls = points[points[:, 2] > 4.9]
    assert np.abs(np.abs(walls[:, 0] - 3.0).max() - 10.0) < 1e-3
    assert points[:, 2].min() == pytest.approx(0.0, abs=1e-3)
    single = LevelledScan(
        t_ns=0,
        points_level=np.array([[2.0, 0.0, -1.0], [2.0, 0.05, -1.0], [2.0, -0.05, -1.0]]),
        range_m=np.full(3, 2.24),
        row=np.zeros(3, dtype=np.int64),
        column=np.array([0, 1, 2]),
    )
    mapper = Mapper(CFG)
    assert mapper.add(single, estimate(x=1.0, y=1.0, z=5.0, yaw=np.pi / 2))
    assert mapper.point_map().points_map[0] == pytest.approx([1.0, 3.0, 4.0], abs=1e-5)


def test_correction_of_a_keyframe_moves_its_points_and_no_others() -> None:
    mapper = Mapper(CFG)
    mapper.add(room_scan(), estimate(keyframe=0))
    mapper.add(room_scan(), estimate(x=1.0, keyframe=7))
    before = mapper.point_map()
    mapper.correct(7, np.array([1.5, -0.25, 5.0]), quat_from_rpy(0.02, -0.03, 0.0))
    mapper.correct(99, np.zeros(3), np.array([1.0, 0, 0, 0]))
    after = mapper.point_map()
    moved = after.points_map - before.points_map
    assert moved[after.keyframe_id == 7] == pytest.approx(np.tile([0.5, -0.25, 0.0], (2560, 1)), abs=1e-5)
    assert not moved[after.keyframe_id == 0].any()
    assert after.path_map[1] == pytest.approx([1.5, -0.25, 5.0], abs=1e-6)


def test_scans_within_a_keyframe_keep_their_own_poses() -> None:
    mapper = Mapper(CFG)
    for step in range(4):
        mapper.add(room_scan(), estimate(x=0.3 * step, keyframe=0))
    path = mapper.point_map().path_map
    assert path[:, 0] == pytest.approx([0.0, 0.3, 0.6, 0.9], abs=1e-9)


@pytest.mark.parametrize(
    "changes",
    [
        {"converged": False},
        {"quality": -1},
        {"position_map_m": np.array([np.nan, 0, 0])},
        {"pose_covariance": np.diag([9.0, 9.0, 1, 1, 1, 1])},
    ],
    ids=["not converged", "failed", "not a number", "unsure"],
)
def test_bad_pose_paints_nothing(changes: dict[str, object]) -> None:
    mapper = Mapper(CFG)
    assert not mapper.add(room_scan(), estimate(**changes))  # type: ignore[arg-type]
    assert mapper.size == 0
    assert mapper.scans_refused == 1


def test_dust_is_left_out_and_surfaces_kept() -> None:
    scan, dusty = with_dust(room_scan(noise_m=0.12), 0.05)
    mapper = Mapper(CFG)
    mapper.add(scan, estimate())
    kept = mapper.size
    assert kept > 0.97 * (~dusty).sum()
    assert mapper.points_dropped_as_dust > 0.8 * dusty.sum()


def test_noise_of_a_third_of_a_metre_is_not_taken_for_dust() -> None:
    mapper = Mapper(CFG)
    mapper.add(room_scan(noise_m=0.3), estimate())
    assert mapper.points_dropped_as_dust < 0.05 * ROWS * COLUMNS


def test_returns_that_are_not_numbers_or_out_of_range_are_left_out() -> None:
    scan = room_scan()
    points, ranges = scan.points_level.copy(), scan.range_m.copy()
    points[::10] = np.nan
    ranges[5::10] = 1000.0
    mapper = Mapper(CFG)
    mapper.add(dataclasses.replace(scan, points_level=points, range_m=ranges), estimate())
    point_map = mapper.point_map()
    assert np.isfinite(point_map.points_map).all()
    assert point_map.range_m.max() <= CFG.mapping.max_range_m


def test_empty_scan_is_refused() -> None:
    nothing = LevelledScan(
        t_ns=0,
        points_level=np.zeros((0, 3)),
        range_m=np.zeros(0),
        row=np.zeros(0, dtype=np.int64),
        column=np.zeros(0, dtype=np.int64),
    )
    assert not Mapper(CFG).add(nothing, estimate())


def test_memory_is_bounded_and_the_map_still_measures() -> None:
    mapper = Mapper(CFG, max_points=60_000)
    for step in range(60):
        mapper.add(room_scan(seed=step), estimate(x=0.05 * step, keyframe=step // 10))
        assert mapper.size <= 60_000
    assert mapper.points_thinned > 0
    point_map = mapper.point_map()
    assert len(point_map.points_map) == mapper.size == len(point_map.range_m) == len(point_map.keyframe_id)
    assert sorted(set(point_map.keyframe_id.tolist())) == list(range(6))
    assert abs(estimate_volume(point_map, CFG.volume).volume_m3) < 2.0


def test_a_full_map_is_thinned_evenly() -> None:
    """All scans keep the same share of their returns, first and last, near and far: nothing seen weighs more than before."""
    full, thin = Mapper(CFG), Mapper(CFG, max_points=40_000)
    for step in range(60):
        for mapper in (full, thin):
            mapper.add(room_scan(noise_m=0.12, seed=step), estimate(x=0.05 * step, keyframe=step // 10))
    all_points, kept = full.point_map(), thin.point_map()
    share = mapper.size / full.size
    assert share < 0.3
    each = np.bincount(kept.scan_index, minlength=60) / np.bincount(all_points.scan_index, minlength=60)
    assert np.all(np.abs(each / share - 1.0) < 0.1)
    for low, high in (
        (-0.5, -0.12),
        (-0.12, 0.12),
        (0.12, 0.5),
    ):  # below, on and above the floor: the noise keeps its shape
        of_all, of_kept = (np.sum((m.points_map[:, 2] > low) & (m.points_map[:, 2] < high)) for m in (all_points, kept))
        assert of_kept / of_all == pytest.approx(share, rel=0.1)


def test_map_tells_the_typical_sigma_of_its_poses() -> None:
    mapper = Mapper(CFG)
    mapper.add(room_scan(), estimate())
    point_map = mapper.point_map()
    assert point_map.position_sigma_m == pytest.approx(0.02)
    assert point_map.height_sigma_m == pytest.approx(0.01)


def test_map_without_scans_is_empty() -> None:
    point_map = Mapper(CFG).point_map()
    assert point_map.points_map.shape == (0, 3)
    assert point_map.path_map.shape == (0, 3)
