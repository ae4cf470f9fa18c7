"""Noise along the beam does not bend the surface."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from companion.config import VolumeConfig
from companion.messages import VolumeReport
from companion.volume import estimate_volume
from tests.companion.volume.synthetic import Hall, circle, cone, make_map
from tests.companion.volume.test_volume import GOOD_POSES, HALLS

EXACT = dataclasses.replace(GOOD_POSES, position_sigma_m=0.0, height_sigma_m=0.0, noise_m=0.12)


@pytest.mark.parametrize("name", ["free-standing", "silo"])
def test_knowing_the_beams_takes_the_noise_out_of_the_surface(name: str) -> None:
    made = make_map(HALLS[name], EXACT, 3)
    with_beams = estimate_volume(made.point_map, VolumeConfig())
    without = estimate_volume(dataclasses.replace(made.point_map, scan_index=None), VolumeConfig())
    perfect = estimate_volume(dataclasses.replace(made.point_map, points_map=made.true_points), VolumeConfig())

    def rms(report: VolumeReport) -> float:
        x, of_x, of_perfect_x = np.intersect1d(report.x_m, perfect.x_m, return_indices=True)
        y, of_y, of_perfect_y = np.intersect1d(report.y_m, perfect.y_m, return_indices=True)
        assert len(x) > 100
        assert len(y) > 100
        there = np.ix_(of_perfect_y, of_perfect_x)
        off = report.surface_z_m[np.ix_(of_y, of_x)] - perfect.surface_z_m[there]
        return float(np.sqrt(np.nanmean(off[perfect.cell_state[there] == 1] ** 2)))

    assert rms(with_beams) < 0.98 * rms(without)
    assert abs(with_beams.volume_m3 / made.true_volume_m3 - 1) < 0.0025


def test_returns_that_noise_throws_into_a_gap_do_not_fill_it() -> None:
    """In a round hall the rings that a layer draws leave others bare; noise throws returns there, and they are of neither."""
    silo = Hall(footprint=circle(16), pile=cone(0.8, -0.5, 6.0, 0.67))
    made = make_map(silo, dataclasses.replace(EXACT, noise_m=0.2, scan_period_s=1.0, yaw_sigma_rad=0.0), 1)
    report = estimate_volume(made.point_map, VolumeConfig())
    assert abs(report.volume_m3 / made.true_volume_m3 - 1) < 0.002  # 0.004 too little while they counted
    bare = estimate_volume(dataclasses.replace(made.point_map, scan_index=None), VolumeConfig())
    assert report.interpolated_ratio > bare.interpolated_ratio


def test_what_was_seen_in_the_climb_with_a_tilted_attitude_does_not_count() -> None:
    made = make_map(HALLS["free-standing"], EXACT, 5).point_map
    assert made.scan_index is not None
    low = made.path_map[made.scan_index, 2] < 4.0
    assert 0.01 < low.mean() < 0.5
    tilted = made.points_map.copy()
    tilted[low, 2] += 0.02 * (made.points_map[low, 0] - made.path_map[0, 0])
    volume = estimate_volume(made, VolumeConfig()).volume_m3
    assert estimate_volume(dataclasses.replace(made, points_map=tilted), VolumeConfig()).volume_m3 == volume


def test_an_index_of_another_path_is_not_used() -> None:
    made = make_map(HALLS["free-standing"], EXACT, 6).point_map
    assert made.scan_index is not None
    none = estimate_volume(dataclasses.replace(made, scan_index=None), VolumeConfig())
    beyond = dataclasses.replace(made, scan_index=made.scan_index + len(made.path_map))
    fewer = dataclasses.replace(made, scan_index=made.scan_index[:-1])
    assert estimate_volume(beyond, VolumeConfig()).volume_m3 == none.volume_m3
    assert estimate_volume(fewer, VolumeConfig()).volume_m3 == none.volume_m3
