"""From any start in each hall: round the wall once, home, landed, nothing touched."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from companion.config import CompanionConfig
from companion.navigator import NavigatorState as S
from tests.companion.navigator.halls import HALLS, MS, Hall, Rig, circle, column, rectangle

# hall, speed, seed of the start: each hall, each speed; more seeds by sweeping this with a wider range.
FLIGHTS = [
    ("cement_store", 0.31, 2), ("cement_store", 0.43, 0), ("cement_store", 0.55, 1), ("leaning_pile", 0.55, 1),
    ("l_shaped", 0.55, 4), ("columns", 0.55, 6), ("silo", 0.43, 5), ("clutter", 0.55, 21),
]  # fmt: skip


def fly(hall: str, speed: float, seed: int, clearance_m: float = 1.2, **navigator: object) -> Rig:
    config = CompanionConfig.model_validate({"navigator": {"forward_speed_mps": speed, **navigator}})
    world = Hall(HALLS[hall])
    rig = Rig(world, world.random_start(np.random.default_rng(seed), clearance_m), config, seed)
    rig.fly(2400)
    return rig


@pytest.mark.parametrize(("hall", "speed", "seed"), FLIGHTS)
def test_a_lap_closes_from_any_start_and_ends_where_it_began(hall, speed, seed):
    rig = fly(hall, speed, seed)
    end = rig.output
    assert end is not None
    assert (end.state, end.outcome, end.lap_closed) == (S.DONE, "completed", True), end.reason
    assert rig.from_start_m() < 1.0
    start_clearance = rig.hall.clearance(*rig.start[:2])
    assert rig.min_clearance > min(start_clearance - 0.2, 3.0)  # nearer than 3 m only where it began there
    assert end.progress_ratio == 1.0
    round_the_hall = np.ptp(rig.log.x) > 0.5 * np.ptp(rig.hall.rings[0][:, 0])
    assert round_the_hall
    if hall in ("cement_store", "l_shaped", "silo"):
        assert rig.wall_distance_rms_m() < 0.1


# A hall, a start in it where nothing is 2 m away, D, and what is nearest: each 1.1 m off.
TIGHT = {
    "corner": ([rectangle(0, 0, 16, 12)], (1.1, 1.1, -2.8), 4.0),
    "wall behind": ([rectangle(0, 0, 16, 12)], (1.1, 6.0, 0.0), 4.0),
    "wall ahead": ([rectangle(0, 0, 16, 12)], (8.0, 10.9, 1.6), 4.0),
    "inner corner": ([[(0, 0), (18, 0), (18, 9), (9, 9), (9, 17), (0, 17)]], (8.2, 9.9, 3.5), 3.6),
    "round wall": ([circle(8, 8, 8)], (8.0, 1.1, 0.2), 4.0),
    "between columns": ([rectangle(0, 0, 18, 14), column(7.5, 4.4), column(10.5, 4.4)], (9.0, 4.4, 1.6), 4.0),
    "sharp corner": ([[(0, 0), (22, 0), (11, 20)]], (11.0, 15.5, 0.0), 4.0),
}


@pytest.mark.parametrize("name", TIGHT)
def test_a_start_nearer_than_the_guards_stop_distance_is_left_and_come_back_to(name):
    rings, start, distance = TIGHT[name]
    navigator = {"forward_speed_mps": 0.55, "wall_distance_m": distance, "height_m": 4.0}
    rig = Rig(Hall(rings), start, CompanionConfig.model_validate({"navigator": navigator}))
    end = rig.fly(900)
    assert (end.outcome, end.lap_closed) == ("completed", True), end.reason
    assert rig.from_start_m() < 0.3
    assert rig.min_clearance > rig.hall.clearance(*start[:2]) - 0.25


def test_a_way_farther_than_the_mission_allows_is_broken_off_and_leads_home():
    config = CompanionConfig.model_validate(
        {"navigator": {"forward_speed_mps": 0.55, "max_distance_from_start_m": 20.0, "height_m": 4.0}}
    )
    rig = Rig(Hall(HALLS["cement_store"]), (8.0, 8.0, 0.0), config)
    end = rig.fly(600)
    assert (end.outcome, end.lap_closed) == ("too_far", False)
    assert rig.from_start_m() < 0.5
    assert np.hypot(np.array(rig.log.x) - 8.0, np.array(rig.log.y) - 8.0).max() < 21.0


def test_two_laps_are_two_laps_and_progress_rises_to_one():
    config = CompanionConfig.model_validate({"navigator": {"forward_speed_mps": 0.55, "laps": 2}})
    rig = Rig(Hall(HALLS["silo"]), (16.0, 22.0, 0.0), config)
    seen = []
    while not rig.step().finished:
        if rig.t % (5_000 * MS) == 0:
            seen.append(rig.output.progress_ratio)
    assert rig.output.outcome == "completed"
    assert 2 * 2 * np.pi * 10.0 - 3 < rig.output.path_length_m < 2 * 2 * np.pi * 10.0 + 15
    assert all(b >= a - 0.05 for a, b in pairwise(seen))
    assert rig.output.progress_ratio == 1.0


def test_the_same_seed_flies_the_same_path_to_the_last_bit():
    config = CompanionConfig()
    world = Hall(HALLS["cement_store"])
    rigs = [Rig(world, (9.0, 9.0, 1.0), config, seed=4) for _ in range(2)]
    for _ in range(1200):
        first, second = (rig.step() for rig in rigs)
        assert first.state is second.state
        if first.setpoint is not None:
            assert first.setpoint.velocity_map_mps.tobytes() == second.setpoint.velocity_map_mps.tobytes()


def test_it_turns_left_where_the_front_wall_is_at_d_and_keeps_the_wall_on_the_right():
    """The paper's rule, seen from outside: standing still at D from both walls of the corner."""
    rig = Rig(Hall(HALLS["cement_store"]), (30.0, 8.0, 0.0), CompanionConfig())
    rig.fly_until(S.FOLLOW)
    while not (rig.x > 40.0 and abs(rig.yaw_rate) > 0.2):
        rig.step()
        assert rig.output.state is S.FOLLOW
    assert rig.yaw_rate > 0
    assert 50.0 - rig.x == pytest.approx(6.0, abs=0.3)
    assert rig.y == pytest.approx(6.0, abs=0.2)
    for _ in range(160):
        rig.step()
    assert rig.y > 6.5
    assert 50.0 - rig.x == pytest.approx(6.0, abs=0.25)


@pytest.mark.parametrize("distance", [3.5, 4.5, 9.0])
def test_the_wall_distance_is_what_the_mission_says(distance):
    config = CompanionConfig.model_validate({"navigator": {"wall_distance_m": distance}})
    rig = Rig(Hall(HALLS["cement_store"]), (25.0, 12.0, 2.0), config)
    rig.fly_until(S.FOLLOW)
    for _ in range(60 * 20):
        rig.step()
    assert rig.wall_distance_rms_m() < 0.12


def test_a_corridor_too_narrow_for_d_on_both_sides_is_flown_in_its_middle():
    config = CompanionConfig.model_validate({"navigator": {"forward_speed_mps": 0.55}})
    rig = Rig(Hall([rectangle(0, 0, 40, 8)]), (20.0, 3.0, 0.3), config)
    rig.fly_until(S.FOLLOW)
    for _ in range(120 * 20):
        rig.step()
        assert rig.hall.clearance(rig.x, rig.y) > 2.0
        if rig.output.state is not S.FOLLOW:
            break


def test_a_short_sighted_sensor_finds_its_way_too():
    """Range 20 m: nothing ahead for most of each wall, nothing behind."""
    config = CompanionConfig.model_validate({"lidar": {"max_range_m": 20.0}, "navigator": {"forward_speed_mps": 0.55}})
    rig = Rig(Hall(HALLS["cement_store"]), (25.0, 15.0, 2.0), config)
    end = rig.fly(900)
    assert end.outcome == "completed"
    assert rig.from_start_m() < 1.0


def test_a_blocked_view_of_home_leads_back_along_the_flown_path():
    """Home lies round the reflex corner when the lap is cut short."""
    config = CompanionConfig.model_validate(
        {"navigator": {"forward_speed_mps": 0.55, "max_flight_time_s": 110.0, "height_m": 5.0}}
    )
    rig = Rig(Hall(HALLS["l_shaped"]), (18.0, 42.0, 0.0), config)
    end = rig.fly(900)
    assert end.outcome == "time_limit"
    assert rig.from_start_m() < 1.0
    assert rig.min_clearance > 2.4
