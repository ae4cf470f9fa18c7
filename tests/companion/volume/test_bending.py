"""How the volume follows a map that is bent: against maps that were bent, and by hand."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from companion.config import VolumeConfig
from companion.messages import PointMap
from companion.volume import bending as module
from companion.volume import estimate, estimate_volume
from companion.volume.bending import Bending
from tests.companion.volume.synthetic import Flight, Hall, cone, make_map, rectangle

CFG = VolumeConfig()
HALL = Hall(footprint=rectangle(44, 30), pile=cone(22, 15, 5.0, 0.65))
FLIGHT = Flight(scan_period_s=1.5, noise_m=0.03)


@pytest.fixture(scope="module")
def exact() -> PointMap:
    return make_map(HALL, FLIGHT, 1).point_map


def told(point_map: PointMap, monkeypatch: pytest.MonkeyPatch, **changed: Any) -> tuple[float, Bending]:
    """The volume, and what is said of its bending. changed: of the footprint that is given to it."""
    kept: list[Bending] = []

    def spy(points: PointMap, grid: Any, cells: Any, surface: Any, footprint: Any, *rest: Any) -> Bending | None:
        found = module.bending(points, grid, cells, surface, dataclasses.replace(footprint, **changed), *rest)
        assert found is not None
        kept.append(found)
        return found

    monkeypatch.setattr(estimate, "bending", spy)
    return estimate_volume(point_map, CFG).volume_m3, kept[-1]


def longer(point_map: PointMap, offset_m: float) -> PointMap:
    assert point_map.scan_index is not None
    reach = point_map.points_map - point_map.path_map[point_map.scan_index]
    beam = reach / np.linalg.norm(reach, axis=1)[:, None]
    return dataclasses.replace(point_map, points_map=point_map.points_map + offset_m * beam)


def test_longer_ranges_from_the_same_places_change_the_volume_as_told(
    exact: PointMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without walls nothing moves the body: the beams alone count."""
    before, said = told(exact, monkeypatch, fits=())
    after = estimate_volume(longer(exact, 0.03), CFG).volume_m3
    assert said.per_range_m2 is not None
    assert said.per_range_m2 < -10.0
    assert (after - before) / 0.03 == pytest.approx(said.per_range_m2, rel=0.15)


def test_a_near_wall_turns_the_body_so_that_the_pile_sinks_less(
    exact: PointMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = told(exact, monkeypatch, fits=())[1].per_range_m2
    with_walls = told(exact, monkeypatch)[1].per_range_m2
    assert alone is not None
    assert with_walls is not None
    assert abs(with_walls) < 0.6 * abs(alone)


def test_keyframes_that_stand_too_far_from_near_walls_are_found_out(
    exact: PointMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each scan 10 mm toward the hall's middle, from the wall that it follows, as steps in a wall draw it."""
    assert exact.scan_index is not None
    before, calm = told(exact, monkeypatch)
    to_middle = np.array([22.0, 15.0]) - exact.path_map[:, :2]
    inward = np.zeros_like(exact.path_map)
    along_y = np.abs(to_middle[:, 1]) > 8.0
    inward[along_y, 1] = 0.01 * np.sign(to_middle[along_y, 1])
    inward[~along_y, 0] = 0.01 * np.sign(to_middle[~along_y, 0])
    drawn = dataclasses.replace(
        exact, points_map=exact.points_map + inward[exact.scan_index], path_map=exact.path_map + inward
    )
    after, said = told(drawn, monkeypatch)
    lost = before - after
    assert abs(calm.contradicted_m3) < 0.15 * lost
    assert said.contradicted_m3 == pytest.approx(lost, rel=0.35)


def test_a_map_that_does_not_tell_its_beams_has_none(exact: PointMap) -> None:
    without = dataclasses.replace(exact, scan_index=None)
    budget = dict(estimate_volume(without, CFG).error_budget_m3)
    assert budget["scale"] == 0.0
    assert budget["range"] > 0.0


def test_the_same_map_says_the_same_to_the_last_bit(exact: PointMap, monkeypatch: pytest.MonkeyPatch) -> None:
    assert told(exact, monkeypatch)[1] == told(exact, monkeypatch)[1]
