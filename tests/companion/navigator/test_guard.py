"""The guard has the last word: every branch, and what must hold for any input."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config import CompanionConfig
from companion.messages import FlightMode, RequestKind, SetpointKind
from companion.navigator.guard import Guard, GuardInput
from companion.navigator.obstacles import HOME_MARGIN_M, allowed_speed
from tests.companion.navigator.builders import MS, GuardRig, S, abort, estimate, setpoint, toward, vehicle, walls

CFG = CompanionConfig().guard
MAX_RATE = math.radians(CFG.max_yaw_rate_dps)
number = st.floats(-1e3, 1e3)
quick = settings(deadline=None)  # the machine may be busy
anything = st.floats(allow_nan=True, allow_infinity=True)


def is_still(verdict) -> bool:
    wanted = verdict.setpoint
    return wanted.kind is SetpointKind.VELOCITY and not wanted.velocity_map_mps.any() and wanted.yaw_rate_radps == 0.0


# ---- what holds for any input -----------------------------------------------------------------------------------------


@quick
@given(number, number, number, number, st.booleans())
def test_speed_climb_and_turn_rate_are_never_above_their_limits(vx, vy, vz, rate, degenerate):
    rig = GuardRig()
    out = rig.check(
        vx, vy, vz, yaw_rate=rate, inputs=rig.inputs(estimate=estimate(rig.t, is_degenerate=degenerate))
    ).setpoint
    assert np.hypot(*out.velocity_map_mps[:2]) <= CFG.max_speed_mps * (0.5 if degenerate else 1.0) + 1e-9
    assert abs(out.velocity_map_mps[2]) <= CFG.max_climb_speed_mps
    assert abs(out.yaw_rate_radps) <= MAX_RATE


@quick
@given(st.tuples(anything, anything, anything, anything).filter(lambda v: not all(map(math.isfinite, v))))
def test_numbers_that_are_none_become_zero_velocity(v):
    assert is_still(GuardRig().check(*v[:3], yaw_rate=v[3]))


@quick
@given(st.integers(0, 2**32 - 1), st.floats(0.0, 360.0), st.floats(0.0, 2.0), st.floats(-math.pi, math.pi))
def test_never_moves_toward_anything_nearer_than_it_can_stop(seed, bearing, speed, yaw):
    """AUTOPILOTS.md: "in offboard, stopping before an obstacle is ours"."""
    rng = np.random.default_rng(seed)
    ranges = rng.uniform(0.3, 6.0, 360)
    rig = GuardRig(ranges=ranges)
    scan, pose = walls(rig.t, ranges), estimate(rig.t, yaw=yaw)
    given_to = GuardInput(estimate=pose, walls=scan, vehicle=vehicle(rig.t))
    rig.guard.check(None, rig.t, given_to)
    rig.t += 400 * MS  # what was seen before with another heading is forgotten
    scan, pose = walls(rig.t, ranges), estimate(rig.t, yaw=yaw)
    given_to = GuardInput(estimate=pose, walls=scan, vehicle=vehicle(rig.t))
    rig.guard.check(None, rig.t, given_to)
    rig.t += 600 * MS
    scan, pose = walls(rig.t, ranges), estimate(rig.t, yaw=yaw)
    wanted = setpoint(rig.t, *toward(bearing, speed))
    verdict = rig.guard.check(wanted, rig.t, GuardInput(estimate=pose, walls=scan, vehicle=vehicle(rig.t)))
    velocity = verdict.setpoint.velocity_map_mps[:2]
    assert np.hypot(*velocity) <= speed + 1e-9
    # The guard takes whole degrees of heading: the return it knows is that of the nearest sector, at its own bearing.
    directions = np.radians(np.arange(360)) + yaw
    closing = np.cos(directions) * velocity[0] + np.sin(directions) * velocity[1]
    room = np.asarray(scan.ranges_m) - CFG.stop_distance_m
    assert np.all(closing <= allowed_speed(room, CFG.deceleration_mps2) + 1e-6)


@quick
@given(number, number, number)
def test_without_obstacles_and_inside_the_limits_a_setpoint_passes_unchanged(vx, vy, vz):
    scale = 0.9 / max(1.0, abs(vx) + abs(vy) + abs(vz))
    v = (vx * scale, vy * scale, vz * scale)
    assert np.allclose(GuardRig().check(*v, yaw_rate=0.3).setpoint.velocity_map_mps, v)


@quick
@given(st.lists(st.tuples(st.sampled_from(["estimate", "walls", "vehicle"]), st.booleans()), max_size=8))
def test_whatever_is_missing_nothing_moves(losses):
    rig = GuardRig()
    for name, is_there in losses:
        changes = {} if is_there else {name: None}
        verdict = rig.check(0.5, 0.0, 0.0, later_ms=1000, **changes)
        if changes:
            assert verdict.setpoint.kind is SetpointKind.SILENT or is_still(verdict)


# ---- age --------------------------------------------------------------------------------------------------------------

FROZEN = {
    "lidar gone": lambda rig, lost: {"walls": walls(lost)},
    "estimates gone": lambda rig, lost: {"estimate": estimate(lost)},
    "no scan accepted": lambda rig, lost: {"estimate": estimate(rig.t, t_scan_ns=lost)},
    "registration failed": lambda rig, lost: {"estimate": estimate(rig.t, quality=-1)},
    "position not finite": lambda rig, lost: {"estimate": estimate(rig.t, at=(math.nan, 0.0, 5.0))},
    "quaternion not unit": lambda rig, lost: {"estimate": estimate(rig.t, q_map_body_wxyz=np.ones(4))},
    "estimate from the future": lambda rig, lost: {"estimate": estimate(rig.t + S)},
    "scan from the future": lambda rig, lost: {"walls": walls(rig.t + S)},
    "lidar stuck": lambda rig, lost: {"walls": stuck(rig, lost)},
}


def stuck(rig: GuardRig, lost: int):
    scan = walls(lost)
    return type(scan)(
        t_ns=rig.t, front_m=None, right_m=None, ranges_m=scan.ranges_m.copy(), is_seen=scan.is_seen
    )  # the same frame again with a new stamp


@pytest.mark.parametrize("loss", FROZEN)
def test_lost_vision_holds_at_300_ms_is_silent_at_400_ms_and_lands_at_2_s(loss):
    rig = GuardRig()
    rig.check(0.5, 0.0, 0.0)
    lost = rig.t
    seen: dict[int, object] = {}
    land_ms = None
    for ms in range(50, 2300, 50):
        rig.t = lost + ms * MS
        given_to = rig.inputs(**FROZEN[loss](rig, lost))
        verdict = rig.guard.check(setpoint(rig.t, 0.5, 0.0, 0.0), rig.t, given_to)
        seen[ms] = verdict
        if verdict.requests and land_ms is None:
            land_ms = ms
            assert verdict.requests[0].kind is RequestKind.LAND
    assert is_still(seen[350])
    assert all(seen[ms].setpoint.kind is SetpointKind.SILENT for ms in range(450, 2300, 50))
    assert land_ms == 2050
    assert rig.guard.is_silent
    if loss != "registration failed":  # that holds at once
        assert seen[250].setpoint.velocity_map_mps[0] == 0.5


def test_vision_that_comes_back_is_flown_on_again():
    rig = GuardRig()
    lost = rig.t
    assert rig.check(0.5, 0.0, 0.0, later_ms=600, walls=walls(lost)).setpoint.kind is SetpointKind.SILENT
    assert rig.check(0.5, 0.0, 0.0).setpoint.velocity_map_mps[0] == 0.5
    assert not rig.guard.is_silent


def test_equal_scans_on_the_ground_are_no_fault():
    """A sensor without noise, before take-off: nothing moves, nothing changes."""
    rig = GuardRig()
    first = rig.t
    for _ in range(20):
        verdict = rig.check(0.0, 0.0, 0.1, walls=None, inputs=rig.inputs(at=(0.0, 0.0, 0.0), walls=stuck(rig, first)))
        rig.t += 0
    assert verdict.setpoint.kind is SetpointKind.VELOCITY


@pytest.mark.parametrize(
    ("age_ms", "kind", "moves"), [(250, "velocity", True), (350, "velocity", False), (550, "silent", False)]
)
def test_an_old_wish_is_never_flown_on(age_ms, kind, moves):
    """AUTOPILOTS.md: "after 5 s a text, no action"."""
    rig = GuardRig()
    old = setpoint(rig.t, 0.5, 0.0, 0.0)
    rig.t += age_ms * MS
    verdict = rig.guard.check(old, rig.t, rig.inputs())
    assert verdict.setpoint.kind is SetpointKind(kind)
    assert bool(verdict.setpoint.velocity_map_mps.any()) is moves


@pytest.mark.parametrize(
    ("age_s", "kind", "moves"), [(1.4, "velocity", True), (2.1, "velocity", False), (3.1, "silent", False)]
)
def test_an_unheard_vehicle_is_held_then_left_to_itself(age_s, kind, moves):
    rig = GuardRig()
    heard = rig.t
    verdict = rig.check(0.5, 0.0, 0.0, later_ms=round(1000 * age_s), vehicle=vehicle(heard))
    assert verdict.setpoint.kind is SetpointKind(kind)
    assert bool(verdict.setpoint.velocity_map_mps.any()) is moves


def test_a_disconnected_vehicle_gets_nothing():
    rig = GuardRig()
    assert rig.check(0.5, 0.0, 0.0, vehicle=vehicle(rig.t, is_connected=False)).setpoint.kind is SetpointKind.SILENT


def test_no_wish_means_no_setpoint_but_lost_vision_still_asks_to_land():
    rig = GuardRig()
    lost, requests = rig.t, []
    for _ in range(50):
        rig.t += 50 * MS
        verdict = rig.guard.check(None, rig.t, rig.inputs(walls=walls(lost)))
        assert verdict.setpoint is None
        requests += verdict.requests
    assert [r.kind for r in requests] == [RequestKind.LAND]
    assert rig.guard.is_silent


def test_a_guard_that_never_saw_anything_is_silent_and_asks_for_nothing_on_the_ground():
    guard = Guard(CompanionConfig())
    for n in range(100):
        t = S + n * 50 * MS
        verdict = guard.check(
            setpoint(t, 0.0, 0.0, 0.5), t, GuardInput(estimate=None, walls=None, vehicle=vehicle(t, is_armed=False))
        )
        assert verdict.setpoint.kind is SetpointKind.SILENT
        assert verdict.requests == ()


@pytest.mark.parametrize("mode", [m for m in FlightMode if m is not FlightMode.OFFBOARD])
def test_lost_vision_asks_nothing_of_a_vehicle_that_others_fly(mode):
    rig = GuardRig()
    lost = rig.t
    for _ in range(60):
        assert rig.check(0.5, 0.0, 0.0, walls=walls(lost), vehicle=vehicle(rig.t, mode=mode)).requests == ()


# ---- abort ------------------------------------------------------------------------------------------------------------


def test_abort_gives_zero_velocity_at_once_and_a_land_request_within_1_s_and_stays():
    rig = GuardRig()
    asked = []
    for n in range(80):
        verdict = rig.check(0.5, 0.2, 0.3, yaw_rate=0.4, commands=(abort(rig.t),) if n == 0 else ())
        assert is_still(verdict)
        asked += [n * 0.05 for r in verdict.requests if r.kind is RequestKind.LAND]
    assert asked[0] <= 1.0
    assert len(asked) >= 3  # again while nobody obeys
    assert rig.guard.is_aborted


def test_abort_is_told_once_however_often_it_comes():
    rig = GuardRig()
    events = [e for _ in range(10) for e in rig.check(0.5, 0.0, 0.0, commands=(abort(rig.t),)).events]
    assert [e.name for e in events].count("guard_abort") == 1


@pytest.mark.parametrize("mode", [FlightMode.MANUAL, FlightMode.LAND, FlightMode.DESCEND])
def test_abort_asks_nothing_of_a_pilot_nor_twice_of_a_landing_vehicle(mode):
    rig = GuardRig()
    for _ in range(60):
        assert rig.check(0, 0, 0, commands=(abort(rig.t),), vehicle=vehicle(rig.t, mode=mode)).requests == ()


# ---- the box ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("height", [12.0, 13.5, 13.9, 14.0, 14.4])
def test_it_cannot_climb_through_the_height_limit(height):
    rig = GuardRig()
    up = rig.check(0.0, 0.0, 1.0, at=(0.0, 0.0, height)).setpoint.velocity_map_mps[2]
    room = max(0.0, CFG.max_height_m - height)
    assert up * 0.5 + up**2 / (2 * CFG.deceleration_mps2) <= room + 1e-9
    assert rig.check(0.0, 0.0, -0.5, at=(0.0, 0.0, height)).setpoint.velocity_map_mps[2] == -0.5


def test_it_does_not_sink_to_the_floor_by_setpoints():
    rig = GuardRig()
    assert rig.check(0.0, 0.0, -1.0, at=(0.0, 0.0, 0.3)).setpoint.velocity_map_mps[2] == 0.0
    assert rig.check(0.0, 0.0, -0.5, at=(0.0, 0.0, 3.0)).setpoint.velocity_map_mps[2] == -0.5


def test_it_does_not_sink_onto_what_the_rangefinder_sees():
    rig = GuardRig()
    assert rig.check(0.0, 0.0, -0.5, below_m=0.8).setpoint.velocity_map_mps[2] == 0.0
    assert rig.check(0.0, 0.0, -0.5, below_m=3.0).setpoint.velocity_map_mps[2] == -0.5
    assert rig.check(0.0, 0.0, -0.5, below_m=math.nan).setpoint.velocity_map_mps[2] == -0.5


@quick
@given(st.floats(0, 360), st.floats(0, 360), st.floats(18.0, 20.4))
def test_it_cannot_leave_the_fence(bearing, heading, distance):
    rig = GuardRig(CompanionConfig.model_validate({"guard": {"max_distance_m": 20.0}}))
    x, y, _ = toward(bearing, distance)
    velocity = rig.check(*toward(heading, 1.0), at=(x, y, 5.0)).setpoint.velocity_map_mps
    outward = velocity[0] * math.cos(math.radians(bearing)) + velocity[1] * math.sin(math.radians(bearing))
    assert outward <= allowed_speed(20.0 - distance, CFG.deceleration_mps2) + 1e-6


@pytest.mark.parametrize("at", [(0.0, 0.0, 15.0), (501.0, 0.0, 5.0)])
def test_outside_the_box_it_holds_then_lands(at):
    rig = GuardRig()
    requests = []
    for n in range(60):
        verdict = rig.check(0.1, 0.0, 0.0, at=at)
        assert is_still(verdict)
        requests += [(n * 0.05, r.kind) for r in verdict.requests]
    assert requests[0][1] is RequestKind.LAND
    assert 2.0 <= requests[0][0] <= 2.2


@pytest.mark.parametrize(("height", "below", "breach"), [(9.0, 11.0, True), (9.0, 9.2, False), (9.0, 3.0, False)])
def test_a_height_that_the_rangefinder_gives_the_lie_to_holds_then_lands(height, below, breach):
    """Dust that passed for ground once lifted the estimate's floor, and the vehicle to the ceiling."""
    rig = GuardRig()
    requests = []
    for _ in range(60):
        verdict = rig.check(0.1, 0.0, 0.0, at=(2.0, 0.0, height), below_m=below)
        assert is_still(verdict) is breach
        requests += [r.kind for r in verdict.requests]
    assert (RequestKind.LAND in requests) is breach


def test_back_inside_the_box_it_flies_on():
    rig = GuardRig()
    assert is_still(rig.check(0.1, 0.0, 0.0, at=(0.0, 0.0, 15.0)))
    assert rig.check(0.1, 0.0, 0.0).setpoint.velocity_map_mps[0] == 0.1


def test_an_uncertain_position_is_held():
    rig = GuardRig()
    for variance in (1.5, math.nan, -1.0):
        covariance = np.diag([variance, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6])
        assert is_still(rig.check(0.5, 0, 0, inputs=rig.inputs(estimate=estimate(rig.t, pose_covariance=covariance))))


# ---- obstacles --------------------------------------------------------------------------------------------------------


def ahead(distance: float, half_width: int = 3) -> np.ndarray:
    ranges = np.full(360, 20.0)
    ranges[np.arange(-half_width, half_width + 1)] = distance
    return ranges


@pytest.mark.parametrize("distance", [0.4, 1.0, 2.0])
def test_it_stops_before_a_thing_in_the_way_but_may_back_off(distance):
    rig = GuardRig(ranges=ahead(distance))
    assert rig.check(0.5, 0.0, 0.0).setpoint.velocity_map_mps[0] <= 1e-9
    assert rig.check(-0.5, 0.0, 0.0).setpoint.velocity_map_mps[0] == pytest.approx(-0.5)


def test_it_slides_along_a_wall_that_is_too_near():
    bearing = np.radians(np.arange(360) + 90)  # a wall on the right at 1.9 m
    ranges = np.where(np.cos(bearing - math.pi) > 0.05, 1.9 / np.maximum(np.cos(bearing - math.pi), 0.05), 20.0)
    ranges = np.roll(ranges, 180)
    rig = GuardRig(ranges=ranges)
    along = np.argmin(ranges)
    away = math.degrees(np.radians(along)) + 180
    out = rig.check(*toward(along, 0.4)).setpoint.velocity_map_mps
    assert np.hypot(*out[:2]) < 0.05
    out = rig.check(*toward(away, 0.4)).setpoint.velocity_map_mps
    assert np.hypot(*out[:2]) == pytest.approx(0.4)


def test_where_nobody_looked_it_does_not_go():
    rig = GuardRig(ranges=np.where(np.abs((np.arange(360) + 180) % 360 - 180) < 8, np.inf, 20.0))
    blind = np.ones(360, dtype=bool)
    blind[np.arange(-7, 8)] = False
    for _ in range(10):
        verdict = rig.check(0.5, 0.0, 0.0, inputs=None, walls=walls(rig.t + 50 * MS, rig.ranges, blind))
    assert not verdict.setpoint.velocity_map_mps.any()
    assert rig.check(-0.5, 0.0, 0.0, walls=walls(rig.t + 50 * MS, rig.ranges, blind)).setpoint.velocity_map_mps[0] < 0


def test_beyond_the_sensors_reach_is_free_when_it_was_looked_at():
    rig = GuardRig(ranges=np.where(np.abs((np.arange(360) + 180) % 360 - 180) < 60, np.inf, 20.0))
    assert rig.check(0.5, 0.0, 0.0).setpoint.velocity_map_mps[0] == 0.5


def test_one_lost_packet_does_not_stop_it():
    rig = GuardRig()
    lost = np.ones(360, dtype=bool)
    lost[:12] = False
    scan = walls(rig.t + 50 * MS, np.where(lost, 20.0, np.inf), lost)
    assert rig.check(0.5, 0.1, 0.0, walls=scan).setpoint.velocity_map_mps[0] == 0.5


def test_a_near_thing_that_vanishes_is_still_there_for_a_moment():
    rig = GuardRig(ranges=ahead(1.5))
    rig.check(0.5, 0.0, 0.0)
    rig.ranges = ahead(np.inf)
    assert rig.check(0.5, 0.0, 0.0).setpoint.velocity_map_mps[0] <= 1e-9
    rig.check(0.5, 0.0, 0.0, later_ms=400)
    assert rig.check(0.5, 0.0, 0.0, later_ms=250).setpoint.velocity_map_mps[0] == 0.5


def test_with_nothing_seen_anywhere_it_stays():
    rig = GuardRig(ranges=np.inf)
    for _ in range(15):
        verdict = rig.check(0.5, 0.0, 0.0)
    assert not verdict.setpoint.velocity_map_mps[:2].any()


@pytest.mark.parametrize("bad", [math.nan, -1.0, 0.0])
def test_bad_ranges_are_not_taken_for_free_air(bad):
    rig = GuardRig(ranges=np.where(np.abs((np.arange(360) + 180) % 360 - 180) < 20, bad, 20.0))
    rig.t += 500 * MS
    for _ in range(10):
        verdict = rig.check(0.5, 0.0, 0.0)
    assert not verdict.setpoint.velocity_map_mps[:2].any()


def by_a_wall(distance: float) -> np.ndarray:
    """Ranges to an endless wall ahead (x = distance), 20 m elsewhere."""
    cosine = np.cos(np.radians(np.arange(360)))
    return np.where(cosine > distance / 20.0, distance / np.maximum(cosine, 1e-9), 20.0)


def taken_off_by_a_wall(distance: float) -> GuardRig:
    """A guard that saw the wall on the ground before it was armed."""
    rig = GuardRig()
    rig.guard, rig.ranges = Guard(CompanionConfig()), by_a_wall(distance)
    for is_armed in (False, True):
        rig.t += 100 * MS
        rig.guard.check(None, rig.t, rig.inputs(at=(0.0, 0.0, 0.0), vehicle=vehicle(rig.t, is_armed=is_armed)))
    return rig


def toward_the_wall(rig: GuardRig, x: float, y: float, wall_m: float) -> float:
    """Velocity towards it that passes at (x, y), the wall being where it was."""
    rig.ranges = by_a_wall(wall_m - x)
    for _ in range(12):  # what was seen from elsewhere is forgotten
        rig.check(0.0, 0.0, 0.0, later_ms=100, at=(x, y, 5.0))
    return float(rig.check(0.4, 0.0, 0.0, at=(x, y, 5.0)).setpoint.velocity_map_mps[0])


def test_the_place_of_take_off_is_come_back_to_though_a_wall_is_nearer_than_the_stop_distance():
    rig = taken_off_by_a_wall(1.2)
    assert toward_the_wall(rig, -1.0, 0.0, 1.2) > 0.3
    assert toward_the_wall(rig, -0.3, 0.0, 1.2) > 0.1
    assert toward_the_wall(rig, HOME_MARGIN_M, 0.0, 1.2) < 0.01  # and no nearer


def test_away_from_the_place_of_take_off_the_stop_distance_holds():
    rig = taken_off_by_a_wall(1.2)
    for y in (3.0, -5.0, 12.0):
        assert toward_the_wall(rig, 1.2 - CFG.stop_distance_m, y, 1.2) < 0.02


def test_what_came_to_stand_by_the_place_of_take_off_is_kept_off_as_far_as_the_nearest_thing_was():
    rig = taken_off_by_a_wall(1.6)
    assert toward_the_wall(rig, -1.4, 0.0, 0.0) < 0.01  # a wall now runs through the start
    rig = taken_off_by_a_wall(5.0)  # in the open
    assert toward_the_wall(rig, -2.0, 0.0, 0.0) < 0.01


def test_an_obstacle_stays_where_it_is_while_the_vehicle_moves_and_turns():
    rig = GuardRig(ranges=ahead(4.0))
    scan = walls(rig.t, ahead(4.0))
    rig.guard.check(None, rig.t, rig.inputs(walls=scan))
    rig.t += 200 * MS
    moved = rig.inputs(estimate=estimate(rig.t, at=(2.1, 0.0, 5.0), yaw=2.0), walls=scan)
    out = rig.guard.check(setpoint(rig.t, 0.5, 0.0, 0.0), rig.t, moved).setpoint.velocity_map_mps
    assert out[0] <= 1e-9


def test_what_goes_on_is_told_once():
    rig = GuardRig(ranges=ahead(1.0))
    events = [e.name for _ in range(40) for e in rig.check(0.5, 0.0, 0.0).events]
    assert events == ["guard_limit"]


def test_silence_that_is_asked_for_stays_silence():
    rig = GuardRig()
    wish = setpoint(rig.t, 0.0, 0.0, 0.0)
    silent = type(wish)(t_ns=rig.t, kind=SetpointKind.SILENT, velocity_map_mps=np.zeros(3), yaw_rate_radps=0.0)
    assert rig.guard.check(silent, rig.t, rig.inputs()).setpoint.kind is SetpointKind.SILENT
