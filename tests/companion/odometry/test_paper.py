"""The paper's pipeline does what the paper says, with the signs of docs/paper.md."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.config import CompanionConfig
from companion.messages import LidarScan
from companion.odometry.paper import PaperPipeline, register_paper
from tests.companion.odometry.hall import Hall, lidar_geometry, rectangle

HALL = Hall([rectangle(40, 25)])


def _layer(x: float, y: float, yaw: float, noise_m: float = 0.0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    a = np.arange(512) * 2 * math.pi / 512
    d = np.stack((np.cos(a + yaw), np.sin(a + yaw), np.zeros(512)), axis=1)
    r = HALL.cast(np.tile([x, y, 5.0], (512, 1)), d) + np.random.default_rng(seed).normal(size=512) * noise_m
    return np.stack((r * np.cos(a), r * np.sin(a)), axis=1), r


def test_rotation_and_translation_bring_the_current_scan_onto_the_previous() -> None:
    previous, _ = _layer(15.0, 10.0, 0.0)
    current, ranges = _layer(15.3, 10.1, 0.05)
    found = register_paper(previous, current, ranges, threshold=0.0)
    assert found.iterations == 50
    assert math.atan2(found.rotation[1, 0], found.rotation[0, 0]) == pytest.approx(0.05, abs=0.02)
    assert found.translation[0] > 0.05  # q = R p + t: forward motion is positive
    assert np.allclose(found.rotation @ found.rotation.T, np.eye(2))


def test_scans_that_agree_stop_at_the_threshold_at_once() -> None:
    layer, ranges = _layer(15.0, 10.0, 0.0)
    found = register_paper(layer, layer, ranges, threshold=2.0)
    assert found.iterations == 1
    assert found.error == pytest.approx(0.0, abs=1e-12)
    assert np.allclose(found.translation, 0.0)


def test_points_at_maximum_range_weigh_nothing() -> None:
    """Moving them by an arm's length, without any becoming the nearest of others, changes no bit of the result."""
    previous, _ = _layer(15.0, 10.0, 0.0)
    current, ranges = _layer(15.1, 10.0, 0.0)
    ranges = ranges.copy()
    ranges[0:40] = 50.0
    pairs = (current, current.copy())
    pairs[1][0:40, 0] += 0.03
    with_weight = [register_paper(previous, p, np.full(512, 10.0), threshold=0.0, max_iterations=1) for p in pairs]
    without = [register_paper(previous, p, ranges, threshold=0.0, max_iterations=1) for p in pairs]
    moved = np.linalg.norm(with_weight[0].translation - with_weight[1].translation)
    assert np.linalg.norm(without[0].translation - without[1].translation) < 0.2 * moved


def test_nothing_to_match_is_a_result() -> None:
    found = register_paper(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    assert found.iterations == 0
    assert np.array_equal(found.rotation, np.eye(2))


def _scan(x: float, y: float, yaw: float, t_ns: int) -> LidarScan:
    geometry = lidar_geometry()
    c, s = math.cos(yaw), math.sin(yaw)
    d = geometry.directions.reshape(-1, 3) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
    r = HALL.cast(np.tile([x, y, 5.0], (len(d), 1)), d).reshape(5, 512)
    return LidarScan(
        t_ns=t_ns,
        frame_id=t_ns,
        t_column_ns=np.full(512, t_ns, np.int64),
        range_m=r.astype(np.float32),
        signal=np.ones((5, 512), np.float32),
        column_valid=np.ones(512, bool),
        geometry=geometry,
    )


def test_the_chain_is_pinned_to_the_given_start_and_adds_up() -> None:
    """Eq. 2 and 3, with the double R2 of the third row read as R1 (R2 Q3 + t2) + t1."""
    cfg = CompanionConfig.model_validate({"lidar": {"mount_position_m": (0.0, 0.0, 0.0)}})
    paper = PaperPipeline(cfg)
    start = (3.0, -2.0, 0.4)
    steps = []
    for k, (x, y, yaw) in enumerate([(15, 10, 0.0), (15.2, 10, 0.02), (15.4, 10.1, 0.04)]):
        steps.append(paper.on_keyframe_scan(_scan(x, y, yaw, k), start, height_m=5.0))
    assert steps[0] is None
    assert paper.poses[0] == (3.0, -2.0, 5.0, 0.4)
    first, second = steps[1], steps[2]
    assert first is not None
    assert second is not None
    r0 = np.array([[math.cos(0.4), -math.sin(0.4)], [math.sin(0.4), math.cos(0.4)]])
    inner = first.rotation @ second.translation + first.translation
    assert np.allclose(paper.poses[2][:2], r0 @ inner + start[:2])
    assert paper.c_c == first.iterations + second.iterations
    assert paper.map_points.shape == (3 * 5 * 512, 3)
    assert paper.map_points[:, 2].min() == pytest.approx(0.0, abs=0.02)
