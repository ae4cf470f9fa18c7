"""The floor under a pile from the floor around it, and how far the keyframes' disagreement reaches the volume."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.messages import Array
from companion.volume.floor import Floor, floor_beside
from companion.volume.grid import Grid, Mask
from companion.volume.keyframes import DRIFTS, disagreement, untold_turn
from tests.companion.volume.synthetic import circle, l_shape, rectangle


def grid_of(x_m: float, y_m: float) -> Grid:
    return Grid(x0_m=0.0, y0_m=0.0, cell_m=0.25, nx=round(4 * x_m), ny=round(4 * y_m))


def flat(cells: Mask, undulation_m: float) -> Floor:
    return Floor(
        plane=np.zeros(3), centre_m=np.zeros(2), covariance=np.eye(3), cells=cells, undulation_m=undulation_m,
        residual_m=0.01, found=True,
    )  # fmt: skip


def bowl(grid: Grid, sink_m: float, noise_m: float = 0.01) -> tuple[Array, Mask]:
    """Heights above the plane of a map that is bent down in its middle, with a pile there; and where the pile lies."""
    x, y = grid.centres()
    r = np.hypot(x - x.mean(), y - y.mean())
    pile = r < 5.0
    bent = -sink_m * np.exp(-((r / 12.0) ** 2))
    return bent + np.where(pile, 3.0, 0.0) + np.random.default_rng(5).normal(0, noise_m, r.shape), pile


def test_a_bent_maps_floor_beneath_a_pile_is_told_by_the_floor_around_it() -> None:
    grid = grid_of(40.0, 30.0)
    height, pile = bowl(grid, 0.05)
    rise, sigma = floor_beside(grid, flat(~pile, 0.03), height, pile)
    beneath = -0.05 * math.exp(-((3.5 / 12.0) ** 2))  # at the pile's middle radius
    assert float(rise[pile].mean()) == pytest.approx(beneath, abs=0.012)
    assert np.ptp(rise[pile]) == 0.0
    assert np.all(rise[~pile] == 0.0)
    assert 0.0 < float(sigma[pile].max()) < 0.01
    assert np.isnan(sigma[~pile]).all()


def test_what_a_ring_tells_by_chance_is_not_believed() -> None:
    grid = grid_of(40.0, 30.0)
    height, pile = bowl(grid, 0.0, noise_m=0.1)
    told, _ = floor_beside(grid, flat(~pile, 0.05), height, pile)
    rise, _ = floor_beside(grid, flat(~pile, 0.0), height, pile)
    assert float(abs(told[pile]).max()) > 0.0
    assert np.all(rise == 0.0), "a floor that is a plane"


def test_each_pile_has_a_floor_of_its_own_and_one_between_walls_has_the_planes() -> None:
    grid = grid_of(60.0, 20.0)
    x, y = grid.centres()
    first, second = np.hypot(x - 12, y - 10) < 4, np.hypot(x - 45, y - 10) < 4
    pile = first | second
    height = np.where(x < 30, 0.03, -0.02) + np.where(pile, 2.0, 0.0)
    height += np.random.default_rng(6).normal(0, 0.005, height.shape)
    rise, sigma = floor_beside(grid, flat(~pile, 0.03), height, pile)
    assert float(rise[first].mean()) == pytest.approx(0.03, abs=0.003)
    assert float(rise[second].mean()) == pytest.approx(-0.02, abs=0.003)
    _, alone = floor_beside(grid, flat(np.zeros_like(pile), 0.03), height, pile)
    assert np.isnan(alone).all()
    assert np.isfinite(sigma[pile]).all()


def test_errors_of_each_keyframe_average_out_and_drift_does_not() -> None:
    rng = np.random.default_rng(7)
    count = 400
    each = rng.normal(0, 0.02, count)
    drift = 0.02 * math.sqrt(2) * np.sin(np.linspace(0, 2 * np.pi, count))
    single, lap = disagreement(each, 0.0)
    assert single == pytest.approx(0.02, rel=0.15)
    assert lap < 0.3 * single
    single, lap = disagreement(drift, 0.0)
    assert lap == pytest.approx(single / math.sqrt(DRIFTS), rel=0.01)
    assert disagreement(each, 0.02**2 * 1.5) == (0.0, 0.0), "no more than noise explains"


def test_only_round_walls_hide_a_turn() -> None:
    assert untold_turn(circle()) > 0.95
    assert untold_turn(rectangle()) == untold_turn(rectangle(20, 20)) == untold_turn(l_shape()) == 0.0
