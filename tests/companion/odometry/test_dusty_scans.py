"""Dust is told from surfaces scan by scan; a clean scan loses nothing, whatever is in it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.odometry.ranges import NEAR_M, THICK_BESIDE_COLUMNS, THICK_COMPANIONS, _specks
from companion.odometry.specks import DUSTY_RATIO, lone_returns, off_surface

COLUMNS = 512
NOISE_M = 0.12


def hall(rng: np.random.Generator) -> NDArray[np.float32]:
    """(5, 512) ranges in a hall of 50 x 30 m, 9 m above its floor, a column 4 m off: layers down to 45 deg."""
    bearing = 2 * np.pi * np.arange(COLUMNS) / COLUMNS
    c, s = np.cos(bearing), np.sin(bearing)
    with np.errstate(divide="ignore"):
        wall = np.minimum(
            np.where(c > 0, 38 / np.maximum(c, 1e-9), 12 / np.maximum(-c, 1e-9)),
            np.where(s > 0, 22 / np.maximum(s, 1e-9), 8 / np.maximum(-s, 1e-9)),
        )
    wall[np.abs(bearing - 1.0) < 0.06] = 4.0
    rows = []
    for down in np.radians([0, 11.25, 22.5, 33.75, 45]):
        flat = wall / math.cos(down)
        rows.append(flat if down == 0 else np.minimum(flat, 9.0 / math.sin(down)))
    return (np.array(rows) + NOISE_M * rng.standard_normal((5, COLUMNS))).astype(np.float32)


def dusty(clean: NDArray[np.float32], free_path_m: float, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Put dust into the ranges, a third of what it catches lost; which of them are dust."""
    reach = rng.exponential(free_path_m, clean.shape)
    caught = reach < clean
    lost = caught & (rng.random(clean.shape) < 0.3)
    clean[caught] = reach[caught]
    clean[lost] = 0.0
    return np.asarray(caught & ~lost)


def test_a_clean_scan_is_not_taken_for_a_dusty_one_and_keeps_its_column() -> None:
    ranges = hall(np.random.default_rng(0))
    is_lone, in_front = lone_returns(ranges)
    assert in_front <= 0.2 * DUSTY_RATIO * ranges.size
    assert not is_lone[0][np.abs(ranges[0] - 4.0) < 0.5].any()


def test_returns_whose_neighbours_got_lost_are_no_sign_of_dust() -> None:
    rng = np.random.default_rng(1)
    ranges = hall(rng)
    ranges[rng.random(ranges.shape) < 0.6] = 0.0
    is_lone, in_front = lone_returns(ranges)
    assert is_lone.mean() > 0.05
    assert in_front <= DUSTY_RATIO * np.count_nonzero(ranges)


@pytest.mark.parametrize(("free_path_m", "left", "kept"), [(200.0, 0.06, 0.97), (60.0, 0.1, 0.95), (30.0, 0.16, 0.85)])
def test_dust_goes_and_surfaces_stay(free_path_m: float, left: float, kept: float) -> None:
    rng = np.random.default_rng(2)
    ranges = hall(rng)
    is_dust = dusty(ranges, free_path_m, rng)
    is_lone, in_front = lone_returns(ranges)
    assert in_front > DUSTY_RATIO * np.count_nonzero(ranges)
    assert (~is_lone[is_dust]).mean() < left
    assert (~is_lone[~is_dust & (ranges > 0)]).mean() > kept


def test_what_never_returned_is_neither() -> None:
    ranges = np.zeros((2, COLUMNS), np.float32)
    ranges[1] = np.inf
    ranges[1, 5] = np.nan
    is_lone, in_front = lone_returns(ranges)
    assert not is_lone.any()
    assert in_front == 0
    assert 2 * THICK_BESIDE_COLUMNS > THICK_COMPANIONS


@pytest.mark.parametrize("free_path_m", [100.0, 60.0])
def test_specks_stop_nobody_where_a_thing_does(free_path_m: float) -> None:
    """Of four scans in dust: a post of a hand's breadth and a wire that stays are seen, nearly all dust is not."""
    rng = np.random.default_rng(3)
    layers = []
    dust = np.zeros(COLUMNS, np.bool_)
    for _ in range(4):
        ranges = hall(rng)
        dust = dusty(ranges, free_path_m, rng)[0]
        layer = np.where(ranges[0] > 0, ranges[0], np.inf).astype(np.float64)
        layer[200:206] = 2.0 + NOISE_M * rng.standard_normal(6)  # a post: 4 deg at 2 m
        layer[300] = 2.0 + 0.05 * rng.standard_normal()  # a wire
        dust[200:206] = dust[300] = False
        layers.insert(0, layer)
    is_speck = _specks(np.stack(layers), True)
    assert not is_speck[200:206].any()
    assert not is_speck[300]
    near = dust & (layers[0] < 2.5)
    assert near.sum() >= 5
    assert is_speck[near].mean() > 0.9


def layers_in(free_path_m: float, seed: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(4, 512) layers of four scans, newest first, and which returns of the newest are dust."""
    rng = np.random.default_rng(seed)
    layers, dust = [], np.zeros(COLUMNS, np.bool_)
    for _ in range(4):
        ranges = hall(rng)
        dust = dusty(ranges, free_path_m, rng)[0]
        layers.insert(0, np.where(ranges[0] > 0, ranges[0], np.inf).astype(np.float64))
    return np.stack(layers), dust


def test_in_the_thickest_dust_every_near_return_stops() -> None:
    layers, _ = layers_in(12.0, 4)
    near = layers[0] < NEAR_M
    assert near.sum() > 0.2 * COLUMNS
    assert not _specks(layers, True)[near].any()


def test_dust_farther_off_is_no_wall_to_brake_before() -> None:
    layers, dust = layers_in(60.0, 5)
    far = (layers[0] > NEAR_M) & (layers[0] < 8.0)
    assert (dust & far).sum() >= 10
    assert _specks(layers, True)[dust & far].mean() > 0.85
    assert not _specks(layers, False)[far].any()  # clean air: what stands alone there may be a wire
    assert _specks(layers, True)[~dust & np.isfinite(layers[0])].mean() < 0.03


@pytest.mark.parametrize("free_path_m", [60.0, 30.0])
def test_what_hangs_close_before_a_surface_is_told_by_it(free_path_m: float) -> None:
    rng = np.random.default_rng(6)
    clean = hall(rng)
    ranges = clean.copy()
    is_dust = dusty(ranges, free_path_m, rng)
    before = is_dust & (clean - ranges < 2.0)
    is_lone, _ = lone_returns(ranges)
    is_off = off_surface(ranges, is_lone, 3.0 * NOISE_M)
    kept = ~is_lone & ~is_off & (ranges > 0)
    shift = np.where(before, ranges - clean, 0.0)
    assert (~is_lone & before).sum() > 10
    assert abs(shift[kept].mean()) < 0.5 * abs(shift[~is_lone & (ranges > 0)].mean())
    assert is_off[~is_dust & ~is_lone & (ranges > 0)].mean() < 0.05


def test_a_clean_slope_seen_at_a_flat_angle_keeps_its_returns() -> None:
    rng = np.random.default_rng(7)
    ranges = hall(rng)
    is_off = off_surface(ranges, np.zeros(ranges.shape, np.bool_), 3.0 * NOISE_M)
    assert is_off.mean() < 0.02
