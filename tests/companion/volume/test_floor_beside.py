"""The floor under a pile from the floor around it, and how far the keyframes' disagreement reaches the volume."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.messages import Array
from companion.volume.floor import Floor, floor_beside, waves_m
from companion.volume.grid import Grid, Mask
from companion.volume.keyframes import disagreement, drift_factor, untold_turn
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


def halves_of(height: Array, noise_m: float) -> tuple[Array, Array]:
    """Two halves of a flight that saw the same ground, each with errors of its own, about the mean of both."""
    error = np.random.default_rng(8).normal(0, noise_m, (2, *height.shape))
    return error[0] - error.mean(axis=0), error[1] - error.mean(axis=0)


def test_only_what_both_halves_of_a_flight_show_is_the_grounds() -> None:
    grid = grid_of(40.0, 30.0)
    x, y = grid.centres()
    pile = np.hypot(x - 20, y - 15) < 4.0
    patches = np.random.default_rng(9).normal(0, 0.02, (2, 10, 14))  # of 3 m, as the floor's blocks
    own, ground = (np.kron(p, np.ones((12, 12)))[: grid.ny, : grid.nx] for p in patches)
    floor = flat(~pile, 0.02)
    for height, halves, wanted in (
        (ground, halves_of(ground, 0.01), 0.02),
        (0.5 * own, (0.5 * own, -0.5 * own), 0.0),  # one half errs by `own`, the mean of both by half of it
    ):
        assert waves_m(grid, floor, height, halves) == pytest.approx(wanted, rel=0.25, abs=0.003)
        _, alone = floor_beside(grid, floor, height, pile)
        _, sigma = floor_beside(grid, floor, height, pile, halves)
        assert float(alone[pile].max()) > 0.001
        assert float(sigma[pile].max()) == pytest.approx(
            float(alone[pile].max()) if wanted else 0.0, rel=0.25, abs=5e-4
        )
    assert waves_m(grid, floor, ground, None) == floor.undulation_m
    nowhere = np.full(grid.shape, np.nan)
    assert waves_m(grid, floor, ground, (nowhere, nowhere)) == floor.undulation_m, "halves that never met"


def test_what_noise_explains_is_no_disagreement() -> None:
    each = np.random.default_rng(7).normal(0, 0.02, 400)
    assert disagreement(each, 0.0) == pytest.approx(0.02, rel=0.15)
    assert disagreement(each, 0.02**2 * 1.5) == 0.0


def wandering(rate: float, noise: float, seed: int, length: int = 60) -> list[Array]:
    """What 60 keyframes err by on four walls and the floor: each error is `rate` of the one before and something new."""
    rng = np.random.default_rng(seed)
    series = rng.normal(0, 1.0, (5, length))
    for k in range(1, length):
        series[:, k] = rate * series[:, k - 1] + math.sqrt(1 - rate**2) * series[:, k]
    return list(series + rng.normal(0, noise, series.shape))


def test_a_drift_that_goes_on_from_stretch_to_stretch_is_told_by_the_keyframes() -> None:
    def mean_factor(rate: float, noise: float) -> float:
        return float(np.mean([drift_factor(wandering(rate, noise, seed), 8) for seed in range(20)]))

    assert mean_factor(0.0, 0.0) < 1.03
    assert mean_factor(0.9, 3.0) < mean_factor(0.9, 0.0), "noise is no drift"
    # True: 1.78. Of a single lap no more can be read: its own mean hides some of it.
    assert 1.25 < mean_factor(0.9, 0.0) < 1.8
    assert mean_factor(0.5, 0.0) < mean_factor(0.8, 0.0) < mean_factor(0.9, 0.0)


def test_where_little_was_seen_no_drift_is_told() -> None:
    assert drift_factor([], 8) == 1.0
    assert drift_factor([np.full(60, np.nan)], 8) == 1.0
    assert drift_factor([np.zeros(60)], 8) == 1.0
    assert drift_factor([np.arange(20.0)], 8) == 1.0, "shorter than the stretches are to be told"
    some = wandering(0.9, 0.0, 3)
    for series in some:
        series[np.random.default_rng(4).random(60) < 0.3] = np.nan  # walls are not seen from everywhere
    assert 1.0 < drift_factor(some, 8) < 2.0


def test_only_round_walls_hide_a_turn() -> None:
    assert untold_turn(circle()) > 0.95
    assert untold_turn(rectangle()) == untold_turn(rectangle(20, 20)) == untold_turn(l_shape()) == 0.0
