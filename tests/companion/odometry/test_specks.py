"""Dust near the vehicle: specks that stand alone do not stop it, things do, in the scan in which they show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config import LidarConfig
from companion.messages import LidarScan, WallRanges
from companion.odometry.attitude import AttitudeHistory
from companion.odometry.level import Leveller
from companion.odometry.ranges import (
    THICK_BESIDE_COLUMNS,
    TOGETHER_M,
    beside,
    has_beside,
    layer_ranges,
    wall_ranges,
)
from companion.odometry.specks import LEANING
from tests.companion.odometry.test_level import _last_scan

COLUMNS = 512


def with_returns(scan: LidarScan, returns: dict[int, float]) -> LidarScan:
    """The scan with other ranges in some columns of its horizontal layer; 0: nothing came back."""
    ranges = scan.range_m.copy()
    for column, reach in returns.items():
        ranges[scan.geometry.horizontal_row, column % COLUMNS] = reach
    return replace(scan, range_m=ranges)


def seen(scan: LidarScan, history: AttitudeHistory, before: tuple[LidarScan, LidarScan]) -> WallRanges:
    _, every = Leveller(LidarConfig()).level(scan, history, np.zeros(3))
    return wall_ranges(scan, every, np.eye(3), 0.5, [layer_ranges(each) for each in (scan, *before, before[-1])])


def bearing(column: int, scan: LidarScan) -> int:
    x, y, _ = scan.geometry.directions[scan.geometry.horizontal_row, column]
    return round(np.degrees(np.arctan2(y, x))) % 360


@pytest.fixture(scope="module")
def clear() -> tuple[LidarScan, AttitudeHistory]:
    scan, history, _ = _last_scan((0.0, 0.0, 0.0), 0.0, 0.0, 0.0)
    return scan, history


@pytest.mark.parametrize("reach", [0.6, 1.5, 3.9])
def test_a_speck_that_stands_alone_is_no_obstacle_and_hides_what_is_behind(
    clear: tuple[LidarScan, AttitudeHistory], reach: float
) -> None:
    scan, history = clear
    dusty = with_returns(scan, {100: reach, 101: 0.0, 99: 0.0})
    told = seen(dusty, history, (scan, scan))
    assert told.ranges_m[bearing(100, scan)] > 4.0
    assert told.ranges_m.min() > 4.0


def test_a_hands_breadth_is_an_obstacle_at_once(clear: tuple[LidarScan, AttitudeHistory]) -> None:
    scan, history = clear
    told = seen(with_returns(scan, {100: 2.0, 101: 2.1, 102: 1.95}), history, (scan, scan))
    assert told.ranges_m[bearing(101, scan)] < 2.2


def test_a_wire_is_an_obstacle_from_its_third_scan(clear: tuple[LidarScan, AttitudeHistory]) -> None:
    scan, history = clear
    first, second, third = (with_returns(scan, {column: 2.0}) for column in (100, 102, 104))
    assert seen(second, history, (first, scan)).ranges_m.min() > 4.0
    assert seen(third, history, (second, first)).ranges_m[bearing(104, scan)] < 2.2


def test_what_stands_alone_far_away_counts_as_ever(clear: tuple[LidarScan, AttitudeHistory]) -> None:
    scan, history = clear
    told = seen(with_returns(scan, {100: 4.5, 101: 0.0, 99: 0.0}), history, (scan, scan))
    assert told.ranges_m[bearing(100, scan)] == pytest.approx(4.5, abs=0.1)


def test_until_two_scans_came_before_every_return_counts(clear: tuple[LidarScan, AttitudeHistory]) -> None:
    scan, history = clear
    dusty = with_returns(scan, {100: 1.5})
    _, every = Leveller(LidarConfig()).level(dusty, history, np.zeros(3))
    assert wall_ranges(dusty, every, np.eye(3), 0.5).ranges_m[bearing(100, scan)] < 2.0


@pytest.mark.parametrize(
    ("visibility_m", "least", "most"), [(200.0, 0.0, 0.05), (100.0, 0.0, 0.15), (60.0, 0.0, 0.3), (12.0, 0.95, 1.0)]
)
def test_haze_is_flown_through_and_thick_dust_stops(
    clear: tuple[LidarScan, AttitudeHistory], visibility_m: float, least: float, most: float
) -> None:
    scan, history = clear
    rng = np.random.default_rng(6)
    dusty, clean = [], layer_ranges(scan)
    for _ in range(102):
        caught = rng.exponential(visibility_m, COLUMNS)
        hit = np.flatnonzero((caught < clean) & (caught > 0.5) & (rng.random(COLUMNS) > 0.33))
        dusty.append(with_returns(scan, {int(c): float(caught[c]) for c in hit}))
    shown = [seen(dusty[n], history, (dusty[n - 1], dusty[n - 2])).ranges_m.min() < 2.5 for n in range(2, 102)]
    raw = [layer_ranges(each).min() < 2.5 for each in dusty[2:]]
    assert np.mean(raw) > 0.9
    assert least <= np.mean(shown) <= most


@given(st.integers(0, 1 << 32), st.integers(1, 30), st.integers(1, 4), st.sampled_from([0.0, LEANING]))
@settings(max_examples=60, deadline=None)
def test_companions_are_counted_only_until_there_are_enough_and_come_out_the_same(
    seed: int, columns: int, companions: int, leaning: float
) -> None:
    """In rows of any length, also shorter than what is looked at: then a return is its own neighbour."""
    rng = np.random.default_rng(seed)
    row = rng.choice(np.array([0.0, np.inf, np.nan, 3.0, 3.1, 3.3, 9.0], dtype=np.float32), columns)
    for c in range(columns):
        own = float(row[c])
        together = 0
        for k in range(1, THICK_BESIDE_COLUMNS + 1):
            for neighbour in (float(row[(c - k) % columns]), float(row[(c + k) % columns])):
                together += neighbour > 0.0 and abs(neighbour - own) <= TOGETHER_M + leaning * k * own
        assert beside(row, c, THICK_BESIDE_COLUMNS, leaning)[0] == together
        assert has_beside(row, c, THICK_BESIDE_COLUMNS, leaning, companions) == (together >= companions)
