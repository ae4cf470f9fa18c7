"""Odometry on other people's recordings: trajectories with the scans' own times, and maps."""

from __future__ import annotations

import json
import math
from itertools import islice
from pathlib import Path

import numpy as np
import typer
from typer.testing import CliRunner

from benchmarks.scans2d import relation_errors
from companion.mapping.export import load_point_map
from companion.odometry.planar import PlanarMatcher
from stockpilot.file_scan import FileScan
from stockpilot.odometry_cli import odometry_command, track
from stockpilot.scan_files import open_scans
from tests.shared_data import shared_data

RUNNER = CliRunner()
BEAMS = np.linspace(-math.pi, math.pi, 360, endpoint=False)


def room_scan(x: float, y: float, yaw: float, rng: np.random.Generator) -> np.ndarray:
    """Points that a scanner sees from a pose in a room of 12 x 8 m with a pillar, in its own frame."""
    angles = BEAMS + yaw
    with np.errstate(divide="ignore"):
        along_x = np.where(np.cos(angles) > 0, (12 - x), x) / np.abs(np.cos(angles))
        along_y = np.where(np.sin(angles) > 0, (8 - y), y) / np.abs(np.sin(angles))
    ranges = np.minimum(along_x, along_y)
    to_pillar = np.array([8.0 - x, 5.0 - y])
    ahead = to_pillar[0] * np.cos(angles) + to_pillar[1] * np.sin(angles)
    aside = to_pillar[1] * np.cos(angles) - to_pillar[0] * np.sin(angles)
    hits = (ahead > 0) & (np.abs(aside) < 0.5)
    ranges = np.where(hits, np.minimum(ranges, ahead - np.sqrt(np.maximum(0.25 - aside**2, 0))), ranges)
    ranges += rng.normal(0, 0.01, len(ranges))
    return np.stack([ranges * np.cos(BEAMS), ranges * np.sin(BEAMS)], axis=1)


def test_walk_through_a_room_comes_out_where_it_went() -> None:
    rng = np.random.default_rng(0)
    matcher = PlanarMatcher()
    path = [(2 + 0.04 * n, 2 + 0.02 * n, 0.02 * n) for n in range(120)]
    poses = [matcher.match(room_scan(*p, rng), n * 100_000_000) for n, p in enumerate(path)]
    assert all(p.converged for p in poses)
    moved = np.array([p.pose for p in poses])
    np.testing.assert_allclose(moved[:, 0], [p[0] - 2 for p in path], atol=0.05)
    np.testing.assert_allclose(moved[:, 1], [p[1] - 2 for p in path], atol=0.05)
    np.testing.assert_allclose(moved[:, 2], [p[2] for p in path], atol=0.01)


def test_empty_scans_keep_the_pose_and_are_told() -> None:
    rng = np.random.default_rng(0)
    matcher = PlanarMatcher()
    matcher.match(room_scan(4, 4, 0, rng), 0)
    lost = matcher.match(np.zeros((0, 2)), 100_000_000)
    assert not lost.converged
    assert np.allclose(lost.pose, 0.0)
    assert matcher.match(room_scan(4, 4, 0, rng), 200_000_000).converged


def test_scans_whose_time_does_not_go_on_are_left_out() -> None:
    rng = np.random.default_rng(0)
    points = room_scan(4, 4, 0, rng)
    cloud = np.column_stack([points, np.zeros(len(points))])
    scans = [FileScan(t_ns=t, points=points, points_3d=cloud) for t in (0, 10, 10, 5, 20)]
    found = track(iter(scans))
    assert found.t_ns == [0, 10, 20]
    assert found.out_of_order == 2


def test_command_writes_trajectory_and_map(tmp_path: Path) -> None:
    log = shared_data("scans2d", "aces-corrected.log.gz")
    app = typer.Typer()
    app.command()(odometry_command)
    tum, cloud = tmp_path / "t.tum", tmp_path / "map.ply"
    result = RUNNER.invoke(app, [str(log), "--tum", str(tum), "--map", str(cloud), "--json"])
    assert result.exit_code == 0, result.output
    said = json.loads(result.stdout)
    lines = [line.split() for line in tum.read_text().splitlines()]
    assert len(lines) == said["scans"]
    assert lines[0] == ["21.019900000", "0.0", "0.0", "0.0", "0.0", "0.0", "0.0", "1.0"]
    assert all(len(line) == 8 for line in lines)
    assert len(load_point_map(cloud).points_map) == said["map_points"] > 1000


def first_scans(name: str, count: int) -> list[FileScan]:
    return list(islice(open_scans(shared_data("scans2d", name)).scans, count))


def test_recorded_building_is_followed_between_hand_made_relations(tmp_path: Path) -> None:
    """The first 1500 scans of the ACES log against Freiburg's relations (shared/data/README.md)."""
    found = track(iter(first_scans("aces.orig.bag", 1500)))
    errors = relation_errors(found.t_ns, np.stack(found.poses), shared_data("scans2d", "aces.relations"))
    assert errors.relations > 150
    assert errors.median_m < 0.04
    assert errors.mean_m < 0.05  # measured 0.036


def test_scans_stamped_in_bursts_do_not_throw_it_off() -> None:
    """Intel's log writes scans down late and two at once: 6 us to 3 s apart. A speed taken from two of them flew off."""
    found = track(iter(first_scans("intel.orig.bag", 1000)), with_loops=False)
    assert np.mean(found.converged) == 1.0
    errors = relation_errors(found.t_ns, np.stack(found.poses), shared_data("scans2d", "intel.relations"))
    assert errors.relations > 80
    assert errors.mean_m < 0.04  # measured 0.021
