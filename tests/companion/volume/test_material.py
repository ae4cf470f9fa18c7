"""Where material lies: feet that run out thin are followed, noise and a floor's waves are not."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from companion.config import VolumeConfig
from companion.messages import Array
from companion.volume import estimate_volume
from companion.volume.floor import Floor
from companion.volume.grid import Grid, Mask
from companion.volume.material import RIM_M, pile_mask
from companion.volume.surface import Cells
from tests.companion.volume.synthetic import Flight, Hall, make_map, rectangle

GRID = Grid(x0_m=0.0, y0_m=0.0, cell_m=0.25, nx=200, ny=120)
NOISE_M = 0.03


def floor_of(cells: Mask, undulation_m: float) -> Floor:
    return Floor(
        plane=np.zeros(3), centre_m=np.zeros(2), covariance=np.eye(3) * 1e-8, cells=cells, undulation_m=undulation_m,
        residual_m=NOISE_M, found=True,
    )  # fmt: skip


def mask_of(height: Array, undulation_m: float = 0.001) -> Mask:
    """Of these heights, each cell with its noise."""
    x, y = GRID.centres()
    noisy = height + np.random.default_rng(4).normal(0.0, NOISE_M, height.shape)
    cells = Cells(
        x=x, y=y, z=noisy, sigma_m=np.full(GRID.shape, NOISE_M), kept=np.full(GRID.shape, 20.0),
        dropped_ratio=0.0, of_point=np.zeros(0, dtype=np.int64),
    )  # fmt: skip
    inside = np.ones(GRID.shape, dtype=np.bool_)
    return pile_mask(noisy, inside, cells, floor_of(height < 0.02, undulation_m), GRID)


def radius() -> Array:
    x, y = GRID.centres()
    return np.asarray(np.hypot(x - 25.0, y - 15.0))


def test_a_bells_foot_is_followed_until_it_is_a_centimetre_thin() -> None:
    r = radius()
    mask = mask_of(3.0 * np.exp(-0.5 * (r / 3.0) ** 2))
    thin_m = 3.0 * np.sqrt(2.0 * np.log(3.0 / 0.012))
    assert mask[r < thin_m].all()


def test_a_sharp_foot_has_its_rim_and_no_more() -> None:
    r = radius()
    mask = mask_of(np.maximum(4.0 - 0.65 * r, 0.0))
    foot_m = 4.0 / 0.65
    assert mask[r < foot_m + RIM_M - 0.5].all()
    assert not mask[r > foot_m + RIM_M + 1.0].any()


def test_what_the_floors_own_waves_could_be_is_not_followed() -> None:
    r = radius()
    bell = 3.0 * np.exp(-0.5 * (r / 3.0) ** 2)
    assert mask_of(bell, undulation_m=0.02).sum() < mask_of(bell).sum() - 300


@pytest.mark.parametrize(("width_m", "most_percent"), [(3.0, 0.5), (4.0, 0.9)])
def test_bell_in_noise_is_counted(width_m: float, most_percent: float) -> None:
    """Cut off where single cells show it no more, and with its foot taken for floor, they read 1.2 and 2.5 % too little."""
    hall = Hall(
        footprint=rectangle(), pile=lambda x, y: 3.0 * np.exp(-0.5 * ((x - 25.0) ** 2 + (y - 15.0) ** 2) / width_m**2)
    )
    flight = dataclasses.replace(Flight(scan_period_s=1.5), noise_m=0.12)
    for seed in (3, 4):
        synthetic = make_map(hall, flight, seed)
        report = estimate_volume(synthetic.point_map, VolumeConfig())
        assert abs(100.0 * (report.volume_m3 / synthetic.true_volume_m3 - 1.0)) < most_percent
