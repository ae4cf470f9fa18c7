"""Each state by each loss: what the navigator and the guard do together (docs/safety.md)."""

from __future__ import annotations

import copy
import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.config import CompanionConfig
from companion.messages import (
    FlightMode,
    LandedState,
    OperatorCommand,
    OperatorCommandKind,
    RequestKind,
    SetpointKind,
    WallRanges,
)
from companion.navigator import Navigator, NavigatorInput, NavigatorState
from tests.companion.navigator.builders import MS, estimate, vehicle, walls
from tests.companion.navigator.conftest import IN_THE_AIR, S
from tests.companion.navigator.halls import Rig

ON_THE_GROUND = [S.WAIT_READY, S.ARMING]
OTHERS_FLY = [FlightMode.MANUAL, FlightMode.HOLD, FlightMode.RETURN, FlightMode.MISSION, FlightMode.TAKEOFF]


def command(rig: Rig, kind: OperatorCommandKind) -> OperatorCommand:
    return OperatorCommand(t_ns=rig.t, kind=kind, source="test")


def run(rig: Rig, seconds: float, *commands: OperatorCommand) -> list[tuple[float, object]]:
    """(time since, setpoint that left the guard) of each step."""
    out = []
    start = rig.t
    rig.requests.clear()
    for n in range(round(seconds * 20)):
        rig.step(*commands if n == 0 else ())
        out.append(((rig.t - start) / 1e9, rig.setpoint))
    return out


def asked(rig: Rig) -> list[RequestKind]:
    return [r.kind for r in rig.requests]


def is_still(setpoint) -> bool:
    return setpoint is None or not (setpoint.velocity_map_mps.any() or setpoint.yaw_rate_radps)


# ---- 1, 2: LiDAR gone, stuck ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("state", IN_THE_AIR)
@pytest.mark.parametrize("stuck", [False, True])
def test_a_lidar_that_is_gone_or_stuck_holds_then_is_silent_then_lands(flown_to, state, stuck):
    rig = flown_to(state)
    if stuck:
        last = rig.walls
        assert last is not None
        rig._scan = lambda: WallRanges(
            t_ns=rig.t, front_m=None, right_m=None, ranges_m=last.ranges_m, is_seen=last.is_seen
        )
    else:
        rig.see = False
    trace = run(rig, 4.0)
    assert all(is_still(s) for t, s in trace if t > 0.45)
    assert all(s is None or s.kind is SetpointKind.SILENT for t, s in trace if t > 0.6)
    land = [r for r in rig.requests if r.kind is RequestKind.LAND]
    assert (land[0].t_ns - (rig.t - 4_000 * MS)) / 1e9 <= 2.2  # the last good scan was on its way yet
    assert set(asked(rig)) == {RequestKind.LAND}
    end = rig.fly(60)
    assert end.finished or end.state is S.INTERRUPTED
    assert end.outcome != "completed" or state is S.LAND


@pytest.mark.parametrize("state", ON_THE_GROUND)
def test_without_a_lidar_it_never_arms(flown_to, state):
    rig = flown_to(state)
    rig.see = False
    run(rig, 10.0)
    assert not rig.armed
    assert rig.navigator.state is S.WAIT_READY


@pytest.mark.parametrize("state", [S.CLIMB, S.FIND_WALL, S.FOLLOW, S.RETURN])
def test_a_short_gap_in_the_scans_is_held_and_then_flown_on(flown_to, state):
    rig = flown_to(state)
    rig.see = False
    run(rig, 0.8)
    assert rig.navigator.state is S.HOLDING
    rig.see = True
    run(rig, 1.6)
    assert rig.navigator.state is state
    assert RequestKind.LAND not in asked(rig)


# ---- 3: LiDAR slow ----------------------------------------------------------------------------------------------------


def test_a_slow_lidar_slows_the_flight_within_a_second_or_so(flown_to):
    rig = flown_to(S.FOLLOW)
    cast = rig._scan
    before = float(np.hypot(rig.v[0], rig.v[1]))
    rig._scan = lambda: cast() if rig.t // (100 * MS) % 3 else None  # every third scan is lost
    trace = run(rig, 2.5)
    speeds = [float(np.hypot(*s.velocity_map_mps[:2])) for t, s in trace if s is not None and t > 1.7]
    assert max(speeds) < 0.65 * max(before, 0.43)
    assert rig.navigator.state is S.FOLLOW


# ---- 13: the vehicle no longer does what it is told -------------------------------------------------------------------


@pytest.mark.parametrize("state", [S.FIND_WALL, S.FOLLOW, S.RETURN])
def test_a_vehicle_that_does_not_follow_its_setpoints_is_landed_within_some_seconds(flown_to, state):
    """ArduCopter that no longer gets them stops after 3 s, holds in GUIDED and says nothing (ARDUPILOT.md, GUIDED).
    AUTOPILOTS.md: "GUID_TIMEOUT 3 s: zero velocity"."""
    rig = flown_to(state)
    rig.hears_setpoints = False
    begin = rig.t
    run(rig, 8.0)
    lands = [r for r in rig.requests if r.kind is RequestKind.LAND]
    assert lands, rig.log.events[-5:]
    assert 2.0 < (lands[0].t_ns - begin) / 1e9 < 6.0
    assert "not_followed" in rig.log.events
    end = rig.fly(60)
    assert (end.state, end.outcome) == (S.DONE, "not_followed")
    assert "does not follow its setpoints" in end.reason


@pytest.mark.parametrize("state", [S.HOLDING, S.CLIMB])
def test_where_no_motion_is_asked_for_nothing_is_missed(flown_to, state):
    rig = flown_to(state)
    rig.hears_setpoints = False
    run(rig, 5.0)
    assert "not_followed" not in rig.log.events


# ---- 8, 9: registration fails, geometry is degenerate -----------------------------------------------------------------


@pytest.mark.parametrize("state", IN_THE_AIR)
@pytest.mark.parametrize(
    "changes", [{"quality": -1}, {"position_map_m": np.full(3, math.nan)}, {"q_map_body_wxyz": np.full(4, math.nan)}]
)
def test_a_failed_registration_stops_at_once_and_lands(flown_to, state, changes):
    rig = flown_to(state)
    rig.estimate_changes = changes
    trace = run(rig, 3.0)
    assert all(is_still(s) for _, s in trace)
    assert RequestKind.LAND in asked(rig)


@pytest.mark.parametrize("state", [S.CLIMB, S.FIND_WALL, S.FOLLOW, S.RETURN])
@pytest.mark.parametrize("variances", [(4.0, 4.0, 1.0), (0.01, 0.01, 1.5)])
def test_an_uncertain_position_holds_and_lands_after_20_s(flown_to, state, variances):
    rig = flown_to(state)
    rig.estimate_changes = {"pose_covariance": np.diag([*variances, 1e-4, 1e-4, 1e-4])}
    trace = run(rig, 15.0)
    assert all(is_still(s) for _, s in trace)
    assert rig.navigator.state is S.HOLDING
    run(rig, 8.0)
    assert RequestKind.LAND in asked(rig)


@pytest.mark.parametrize("state", [S.FIND_WALL, S.FOLLOW])
def test_degenerate_geometry_slows_and_turns_back_if_it_lasts(flown_to, state):
    rig = flown_to(state)
    rig.estimate_changes = {"is_degenerate": True}
    trace = run(rig, 19.0)
    assert max(float(np.hypot(*s.velocity_map_mps[:2])) for _, s in trace) <= 0.5
    assert rig.navigator.state is not S.RETURN
    run(rig, 2.0)
    assert rig.navigator.state is S.RETURN
    assert "degenerate" in rig.log.events


@pytest.mark.parametrize("state", [S.CLIMB, S.FIND_WALL, S.FOLLOW, S.RETURN])
def test_odometry_that_begins_anew_elsewhere_lands_here(flown_to, state):
    rig = flown_to(state)
    rig.estimate_changes = {"reset_counter": 1, "position_map_m": np.array([50.0, 0.0, 5.0])}
    run(rig, 1.0)
    assert RequestKind.LAND in asked(rig)
    assert "odometry_reset" in rig.log.events


def test_a_reset_in_place_is_flown_on(flown_to):
    rig = flown_to(S.FOLLOW)
    rig.estimate_changes = {"reset_counter": 1}
    run(rig, 2.0)
    assert rig.navigator.state is S.FOLLOW


# ---- 11: not ready ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("why", ["clock", "vehicle", "preflight", "unheard"])
def test_it_does_not_arm_before_all_is_ready_and_says_why(why):
    navigator = Navigator(CompanionConfig())
    said = []
    for n in range(200):
        t = 10**10 + n * 50 * MS
        state = vehicle(t, is_armed=False, landed_state=LandedState.ON_GROUND, mode=FlightMode.HOLD)
        if why == "vehicle":
            state = vehicle(t, is_armed=False, is_ready_to_arm=False, not_ready_because=("vision: 3 of 500",))
        output = navigator.step(
            t,
            NavigatorInput(
                estimate=estimate(t), walls=walls(t), vehicle=None if why == "unheard" else state,
                time_synced=why != "clock", not_ready_because=("disk: 1 GiB free",) if why == "preflight" else (),
            ),
        )  # fmt: skip
        assert output.state is S.WAIT_READY
        assert output.setpoint is None
        assert output.requests == ()
        said += [e.text for e in output.events]
    words = {"clock": "clocks", "vehicle": "3 of 500", "preflight": "disk", "unheard": "not heard"}
    assert len(said) == 1
    assert words[why] in said[0]


def test_reasons_that_change_all_the_time_are_told_at_most_each_two_seconds_and_the_last_is_told():
    navigator = Navigator(CompanionConfig())
    said = []
    for n in range(200):
        t = 10**10 + n * 50 * MS
        reason = f"step {min(n, 20)}: going on"
        state = vehicle(t, is_armed=False, is_ready_to_arm=False, not_ready_because=(reason,))
        output = navigator.step(
            t, NavigatorInput(estimate=estimate(t), walls=walls(t), vehicle=state, time_synced=True)
        )
        said += [(n, e.text) for e in output.events]
    assert [n for n, _ in said] == [0, 40]
    assert "step 0" in said[0][1]
    assert "step 20" in said[1][1]


def test_it_gives_up_when_the_vehicle_will_not_arm(flown_to):
    """PX4.md: "arming is then refused (TEMPORARILY_REJECTED) while the signal is missing"."""
    rig = flown_to(S.ARMING)
    rig._obey = lambda request: setattr(rig, "mode", FlightMode.OFFBOARD)
    end = rig.fly(120)
    assert end.state is S.FAILED
    assert end.outcome == "not_armed"
    assert 10 <= asked(rig).count(RequestKind.ARM) <= 20


def test_it_streams_before_it_asks(flown_to):
    """AUTOPILOTS.md: "a setpoint stream >= 2 Hz already running; valid local position (or velocity)"."""
    rig = flown_to(S.ARMING)
    trace = run(rig, 1.5)
    assert all(s is not None and s.kind is SetpointKind.VELOCITY for t, s in trace if t < 0.9)
    first = rig.requests[0]
    assert first.kind is RequestKind.OFFBOARD
    assert first.t_ns - (rig.t - 1_500 * MS) >= 900 * MS


# ---- 12, 13, 18: the flight controller reboots, is not heard; we begin in the air -------------------------------------


@pytest.mark.parametrize("state", [S.CLIMB, S.FIND_WALL, S.FOLLOW, S.RETURN, S.HOLDING])
def test_a_rebooted_vehicle_is_never_armed_again(flown_to, state):
    rig = flown_to(state)
    rig.armed, rig.mode = False, FlightMode.UNKNOWN
    trace = run(rig, 7.0)
    assert all(s is None for _, s in trace)
    assert asked(rig) == []
    assert rig.output.state is S.INTERRUPTED
    assert rig.output.finished
    assert rig.output.outcome == "disarmed"


@pytest.mark.parametrize("state", IN_THE_AIR)
def test_a_lost_link_is_held_then_left_silent(flown_to, state):
    rig = flown_to(state)
    rig.heartbeat = False
    trace = run(rig, 5.0)
    assert all(is_still(s) for t, s in trace if t > 2.1)
    assert all(s is None or s.kind is SetpointKind.SILENT for t, s in trace if t > 3.1)
    assert rig.output.state is S.INTERRUPTED


@pytest.mark.parametrize("state", [s for s in IN_THE_AIR if s is not S.LAND])
def test_vision_that_the_flight_controller_no_longer_fuses_holds_then_lands(flown_to, state):
    """It dead-reckons then: real PX4 for 4.6 s, and what we see is of no use to it (docs/safety.md). AUTOPILOTS.md:
    "dead reckoning until EKF2_NOAID_TOUT 5 s, then local position invalid, then failsafe"."""
    rig = flown_to(state)
    said = rig.vehicle
    rig.vehicle = lambda: dataclasses.replace(said(), is_vision_fused=False)
    trace = run(rig, 2.5)
    assert all(is_still(s) for t, s in trace if t > 0.1)
    assert RequestKind.LAND in asked(rig)


def test_vision_fused_again_within_a_second_is_flown_on(flown_to):
    rig = flown_to(S.FOLLOW)
    said = rig.vehicle
    rig.vehicle = lambda: dataclasses.replace(said(), is_vision_fused=False)
    run(rig, 0.8)
    assert rig.output.state is S.HOLDING
    rig.vehicle = said
    run(rig, 3.0)
    assert rig.output.state is S.FOLLOW
    assert RequestKind.LAND not in asked(rig)


@pytest.mark.parametrize("state", ON_THE_GROUND)
def test_an_unheard_vehicle_is_not_armed(flown_to, state):
    rig = flown_to(state)
    rig.heartbeat = False
    rig.vehicle = lambda: vehicle(rig.t, is_connected=False, is_armed=False)
    run(rig, 5.0)
    assert rig.output.state is S.WAIT_READY
    assert not rig.armed


def test_found_in_the_air_it_stays_passive_and_only_lands_when_asked(flown_to):
    rig = flown_to(S.FOLLOW)
    rig.navigator = Navigator(rig.config)
    trace = run(rig, 5.0)
    assert all(s is None for _, s in trace)
    assert asked(rig) == []
    assert rig.output.state is S.INTERRUPTED
    run(rig, 3.0, command(rig, OperatorCommandKind.RESUME))
    assert asked(rig) == [RequestKind.LAND]


# ---- 23: battery ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("state", [S.CLIMB, S.FIND_WALL, S.FOLLOW, S.HOLDING])
def test_a_low_battery_flies_home_and_lands(flown_to, state):
    rig = flown_to(state)
    rig.battery = 0.29
    end = rig.fly(300)
    assert end.state is S.DONE
    assert end.outcome == "battery_low"
    assert rig.from_start_m() < 1.0


@pytest.mark.parametrize("state", IN_THE_AIR)
def test_an_empty_battery_lands_here(flown_to, state):
    rig = flown_to(state)
    rig.battery = 0.05
    run(rig, 1.0)
    if state is not S.LAND:  # that lands already
        assert asked(rig) == [RequestKind.LAND]
    assert rig.fly(60).finished


@pytest.mark.parametrize("ratio", [None, math.nan, -1.0])
def test_a_battery_that_is_not_measured_ends_no_flight(flown_to, ratio):
    """PX4.md: "simulated battery; 0 = no battery simulator"."""
    rig = flown_to(S.FOLLOW)
    rig.battery = ratio
    run(rig, 2.0)
    assert rig.output.state is S.FOLLOW


# ---- 28: abort and the operator's other words -------------------------------------------------------------------------


@pytest.mark.parametrize("state", IN_THE_AIR)
@pytest.mark.parametrize("times", [1, 3])
def test_abort_stops_in_200_ms_asks_to_land_in_1_s_and_ends_aborted(flown_to, state, times):
    rig = flown_to(state)
    trace = run(rig, 1.0, *[command(rig, OperatorCommandKind.ABORT)] * times)
    assert all(is_still(s) for t, s in trace if t <= 0.2 or s is not None)
    assert RequestKind.LAND in asked(rig)
    assert rig.log.events.count("abort") == 1
    rig.step(command(rig, OperatorCommandKind.RESUME))  # latched
    assert rig.navigator.state is S.ABORTING
    end = rig.fly(60)
    assert end.state is S.ABORTED
    assert end.outcome == "aborted"


@pytest.mark.parametrize("state", ON_THE_GROUND)
def test_abort_on_the_ground_ends_without_arming(flown_to, state):
    rig = flown_to(state)
    run(rig, 5.0, command(rig, OperatorCommandKind.ABORT))
    assert rig.output.state is S.ABORTED
    assert rig.output.finished
    assert asked(rig) == []


@pytest.mark.parametrize("state", IN_THE_AIR)
def test_the_operator_can_land_it_anywhere(flown_to, state):
    rig = flown_to(state)
    run(rig, 1.0, command(rig, OperatorCommandKind.LAND))
    assert asked(rig) == [RequestKind.LAND]
    end = rig.fly(60)
    assert end.state is S.DONE
    assert end.outcome == "operator"


@pytest.mark.parametrize("state", [S.CLIMB, S.FIND_WALL, S.FOLLOW, S.RETURN])
def test_hold_and_resume_go_on_where_they_stopped(flown_to, state):
    rig = flown_to(state)
    trace = run(rig, 10.0, command(rig, OperatorCommandKind.HOLD))
    assert all(is_still(s) for _, s in trace)
    run(rig, 1.5, command(rig, OperatorCommandKind.RESUME))
    assert rig.navigator.state is state


@pytest.mark.parametrize("kind", [OperatorCommandKind.HOLD, OperatorCommandKind.LAND, OperatorCommandKind.RESUME])
@pytest.mark.parametrize("state", ON_THE_GROUND)
def test_what_makes_no_sense_on_the_ground_is_refused_and_told(flown_to, kind, state):
    rig = flown_to(state)
    rig.step(command(rig, kind))
    assert "command_refused" in rig.log.events
    assert rig.navigator.state is state


# ---- 29: others fly ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("state", IN_THE_AIR)
@pytest.mark.parametrize("mode", OTHERS_FLY)
def test_after_a_takeover_nothing_is_streamed_or_asked(flown_to, state, mode):
    rig = flown_to(state)
    rig.mode = mode
    trace = run(rig, 3.0)
    assert all(s is None for _, s in trace)
    assert asked(rig) == []
    assert rig.output.state is S.INTERRUPTED
    rig.mode = FlightMode.OFFBOARD  # even so: unasked, never
    trace = run(rig, 1.0)
    assert all(s is None for _, s in trace)


@pytest.mark.parametrize("state", [S.CLIMB, S.FIND_WALL, S.FOLLOW, S.RETURN])
def test_the_operator_may_give_it_back(flown_to, state):
    rig = flown_to(state)
    rig.mode = FlightMode.MANUAL
    run(rig, 2.0)
    run(rig, 3.0, command(rig, OperatorCommandKind.RESUME))
    assert asked(rig) == [RequestKind.OFFBOARD]
    assert rig.output.state in (state, S.RETURN)  # the minute may be over
    assert rig.output.setpoint is not None


def test_abort_does_not_take_it_from_the_pilot(flown_to):
    rig = flown_to(S.FOLLOW)
    rig.mode = FlightMode.MANUAL
    run(rig, 1.0)
    run(rig, 3.0, command(rig, OperatorCommandKind.ABORT))
    assert asked(rig) == []
    assert "abort_noted" in rig.log.events


@pytest.mark.parametrize("mode", [FlightMode.LAND, FlightMode.DESCEND])
def test_a_failsafe_landing_is_left_alone(flown_to, mode):
    """PX4.md: "with no local and no global position that is DESCEND"."""
    rig = flown_to(S.FOLLOW)
    rig.mode = mode
    trace = run(rig, 2.0)
    assert all(s is None for _, s in trace)
    assert asked(rig) == []


def test_no_loss_leaves_a_state_unhandled():
    """The lists above name every state of a flight."""
    over = {S.DONE, S.ABORTED, S.FAILED, S.INTERRUPTED, S.ABORTING}
    assert set(IN_THE_AIR) | set(ON_THE_GROUND) | over == set(NavigatorState)


# ---- garbage ----------------------------------------------------------------------------------------------------------


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([S.CLIMB, S.FIND_WALL, S.FOLLOW, S.RETURN]))
def test_no_ranges_and_no_pose_make_it_raise_or_fly_wild(flights, seed, state):
    rig = copy.deepcopy(flights[state])
    rng = np.random.default_rng(seed)
    poison = np.array([np.nan, np.inf, -np.inf, 0.0, -3.0, 1e12, 0.05])

    def garbage() -> WallRanges:
        ranges = rng.uniform(0.0, 30.0, 360)
        where = rng.random(360) < rng.random()
        ranges[where] = rng.choice(poison, int(where.sum()))
        return WallRanges(
            t_ns=rig.t, front_m=None, right_m=None, ranges_m=ranges, is_seen=rng.random(360) < rng.random()
        )

    rig._scan = garbage
    if rng.random() < 0.5:
        rig.estimate_changes = {"position_map_m": rng.choice(poison, 3)}
    for _ in range(30):
        rig.step()
        wanted = rig.setpoint
        if wanted is not None:
            assert np.all(np.isfinite(wanted.velocity_map_mps))
            assert np.hypot(*wanted.velocity_map_mps[:2]) <= 1.0
