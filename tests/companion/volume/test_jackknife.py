"""What stretches of a flight disagree by, in the volume."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from companion.config import VolumeConfig
from companion.messages import Array
from companion.volume import estimate_volume
from companion.volume.edges import EdgeFit
from companion.volume.grid import Mask
from companion.volume.jackknife import LEAST_KEYFRAMES, STRETCHES, Stretches, stretch_of
from tests.companion.volume.synthetic import Flight, Hall, circle, cone, make_map, rectangle, ridge

SHAPE = (20, 30)
AREA = np.full(SHAPE, 0.25)
PILE = np.zeros(SHAPE, dtype=np.bool_)
PILE[5:15, 10:20] = True
PILE_M2 = float(AREA[PILE].sum())
KEYFRAMES = 96


def stretches(above_m: Array, seen: Mask | None = None) -> Stretches:
    """above_m, seen: (KEYFRAMES, ny, nx), one return of each keyframe in each cell."""
    keep = np.ones(above_m.shape, dtype=np.bool_) if seen is None else seen
    keyframe, *at = np.nonzero(keep)
    return Stretches(
        shape=SHAPE,
        cell=np.ravel_multi_index(tuple(at), SHAPE),
        above_m=above_m[keep],
        of_point=stretch_of(keyframe, KEYFRAMES),
        of_wall=stretch_of(np.arange(KEYFRAMES), KEYFRAMES),
    )


def spread(above_m: Array, seen: Mask | None = None) -> float:
    return stretches(above_m, seen).spread_m3(AREA, [(PILE, ~PILE)], [])


def test_it_is_what_the_mean_of_so_many_errors_is_known_to() -> None:
    rng = np.random.default_rng(1)
    told, true = [], []
    for _ in range(20):
        noise = rng.normal(0, 0.1, (KEYFRAMES, *SHAPE))
        told.append(spread(noise))
        true.append(PILE_M2 * (noise[:, PILE].mean() - noise[:, ~PILE].mean()))
    assert np.sqrt(np.mean(np.square(told))) == pytest.approx(float(np.std(true)), rel=0.35)


def test_what_moves_pile_and_floor_alike_moves_nothing_and_what_parts_them_counts() -> None:
    height = np.repeat(np.random.default_rng(2).normal(0, 0.02, STRETCHES), KEYFRAMES // STRETCHES)[:, None, None]
    alike = height * np.ones((KEYFRAMES, *SHAPE))
    parted = height * PILE
    assert spread(alike) == pytest.approx(0.0, abs=1e-9)
    expected = PILE_M2 * float(np.std(height, ddof=1)) / np.sqrt(STRETCHES)
    assert spread(parted) == pytest.approx(expected, rel=0.15)


def test_what_one_stretch_alone_saw_is_taken_to_err_as_the_rest_of_it_does() -> None:
    high = np.zeros((KEYFRAMES, *SHAPE))
    high[: KEYFRAMES // STRETCHES] = 0.05 * PILE
    seen = np.ones(high.shape, dtype=np.bool_)
    all_round = spread(high, seen)
    seen[KEYFRAMES // STRETCHES :, :, 10:15] = False  # half of the pile
    assert spread(high, seen) > 2.0 * all_round
    seen[:, :, 10:15] = False  # nobody: the rest stands for it
    assert spread(high, seen) == pytest.approx(all_round)


def test_a_wall_that_stretches_place_elsewhere_counts_with_the_face_on_it() -> None:
    offsets = np.random.default_rng(3).normal(0, 0.02, KEYFRAMES)
    fit = EdgeFit(
        point=np.zeros(2), direction=np.array([1.0, 0.0]), length_m=30.0, noise_m=0.0, waviness_m=0.0,
        members=np.arange(KEYFRAMES), offsets_m=offsets,
    )  # fmt: skip
    calm = stretches(np.zeros((KEYFRAMES, *SHAPE)))
    once, twice = (calm.spread_m3(AREA, [(PILE, ~PILE)], [(fit, face)]) for face in (20.0, 40.0))
    assert once == pytest.approx(20.0 * 0.02 / np.sqrt(KEYFRAMES), rel=0.6)
    assert twice == pytest.approx(2.0 * once)


def test_halves_are_told_about_the_mean_of_both() -> None:
    above = np.zeros((KEYFRAMES, *SHAPE))
    above[stretch_of(np.arange(KEYFRAMES), KEYFRAMES)[0] % 2 == 0] = 0.04
    even, odd = stretches(above).halves_m()
    assert even == pytest.approx(np.full(SHAPE, 0.02))
    assert odd == pytest.approx(np.full(SHAPE, -0.02))
    nobody = np.ones(above.shape, dtype=np.bool_)
    nobody[:, 3, 4] = False
    assert np.isnan(stretches(above, nobody).halves_m()[0][3, 4])


POSES = Flight(scan_period_s=1.5, position_sigma_m=0.015, height_sigma_m=0.008, tilt_sigma_rad=0.001)


def test_poses_count_by_what_they_did_to_the_map_and_by_the_odometrys_word_where_too_few_tell() -> None:
    hall = Hall(footprint=rectangle(), pile=ridge(25, 15, 6, 6.0, 0.7))
    good, poor = (
        make_map(hall, flight, 1).point_map for flight in (dataclasses.replace(POSES, position_sigma_m=0.0), POSES)
    )
    still = make_map(hall, Flight(scan_period_s=1.5), 1).point_map
    told = {
        name: dict(estimate_volume(m, VolumeConfig()).error_budget_m3)["poses"]
        for name, m in {
            "still": still,
            "still, told poor": dataclasses.replace(still, position_sigma_m=0.2),
            "tilted": good,
            "poor": poor,
            "few": dataclasses.replace(still, keyframe_id=still.keyframe_id % (LEAST_KEYFRAMES - 1)),
            "few, told poor": dataclasses.replace(
                still, keyframe_id=still.keyframe_id % (LEAST_KEYFRAMES - 1), position_sigma_m=0.2
            ),
        }.items()
    }
    assert told["still"] == told["still, told poor"]
    assert told["poor"] > 1.5 * told["still"]
    assert told["tilted"] > told["still"]
    assert told["few"] == 0.0
    assert told["few, told poor"] > 5.0


def test_a_turn_that_round_walls_hide_moves_no_heap_that_is_round_about_the_middle() -> None:
    turns = {
        off_m: dict(
            estimate_volume(
                make_map(Hall(footprint=circle(), pile=cone(off_m, 0.0, 5.0, 0.6)), POSES, 2).point_map, VolumeConfig()
            ).error_budget_m3
        )["turns"]
        for off_m in (0.0, 5.0)
    }
    assert 0.0 < turns[0.0] < 0.25 * turns[5.0]
