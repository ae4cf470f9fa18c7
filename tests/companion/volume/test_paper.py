"""The paper's volume, as it says it and with its faults."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from companion.volume.paper import bounding_rectangle, paper_volume
from tests.companion.volume.synthetic import Flight, Hall, make_map, rectangle, ridge, rotated

HALL = Hall(footprint=rectangle(), pile=ridge(25, 15, 6, 6.0, 0.7))
KEYFRAMES_ONLY = Flight(scan_period_s=6.4)


def test_walls_left_in_the_region_make_the_volume_too_large() -> None:
    """Section 4: always more than the truth, because of walls and ground that need to be excluded."""
    synthetic = make_map(HALL, KEYFRAMES_ONLY, 1)
    points = synthetic.point_map.points_map
    with_walls = paper_volume(points, ground_z_m=0.0, wall_band_m=0.0)
    assert with_walls > 1.3 * synthetic.true_volume_m3
    assert paper_volume(points, ground_z_m=0.0) == pytest.approx(synthetic.true_volume_m3, rel=0.08)


def test_drift_brings_the_walls_in() -> None:
    drifted = make_map(HALL, dataclasses.replace(KEYFRAMES_ONLY, position_sigma_m=0.4), 1)
    assert paper_volume(drifted.point_map.points_map, ground_z_m=0.0) > 1.1 * drifted.true_volume_m3


def test_ground_is_found_when_nobody_says_where_it_is() -> None:
    synthetic = make_map(HALL, KEYFRAMES_ONLY, 2)
    raised = synthetic.point_map.points_map + np.array([0.0, 0.0, -7.3])
    assert paper_volume(raised) == pytest.approx(synthetic.true_volume_m3, rel=0.08)


def test_plane_is_integrated_exactly() -> None:
    x, y = np.meshgrid(np.linspace(0, 10, 41), np.linspace(0, 6, 25))
    points = np.column_stack([x.ravel(), y.ravel(), 1.0 + 0.1 * x.ravel()])
    assert paper_volume(points, ground_z_m=0.0, wall_band_m=0.0) == pytest.approx(10 * 6 * 1.5, rel=0.01)


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.zeros((50, 3)), np.full((9, 3), np.nan)])
def test_no_surface_gives_nan(points: np.ndarray) -> None:
    assert np.isnan(paper_volume(points))


def test_bounding_rectangle_turns_with_the_hall() -> None:
    xy = np.random.default_rng(0).uniform([0, 0], [50, 30], (5000, 2))
    corner, axes, size = bounding_rectangle(rotated(xy, 0.7))
    assert np.sort(size) == pytest.approx([30, 50], abs=0.2)
    inside = (rotated(xy, 0.7) - corner) @ axes.T
    assert (inside > -1e-9).all()
    assert (inside < size + 1e-9).all()
