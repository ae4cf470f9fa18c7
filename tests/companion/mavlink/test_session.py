"""The whole session against an autopilot packed and read by pymavlink."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as m

import companion
from companion.config import MavlinkConfig
from companion.mavlink.px4 import PX4
from companion.mavlink.session import MavlinkSession
from companion.messages import (
    AttitudeSample,
    Event,
    FlightMode,
    LandedState,
    RangefinderSample,
    RequestKind,
    Setpoint,
    SetpointKind,
    Severity,
    VehicleState,
)
from tests.companion.mavlink import peer as p
from tests.companion.mavlink.peer import MS, SECOND, Peer

ARDUPILOT, PX4_ID = 3, 12


def state(peer: Peer) -> VehicleState:
    return peer.session.vehicle_state(peer.t_ns)


# ---- who it is ------------------------------------------------------------------------------------------------------


def test_nothing_is_commanded_before_the_autopilot_is_known() -> None:
    """ARDUPILOT.md: DO_SET_MODE with PX4's numbers is accepted and is RTL there: tell the autopilots apart first."""
    peer = Peer()
    peer.silent = True
    peer.request(RequestKind.OFFBOARD)
    peer.request(RequestKind.ARM)
    peer.run(3.0, vision=True, setpoints=True)
    assert {message.get_type() for message in peer.sent} == {"HEARTBEAT"}
    assert peer.event_names() == ["offboard_refused", "arm_refused"]


@pytest.mark.parametrize(
    ("autopilot", "kind", "params"),
    [
        (PX4_ID, RequestKind.OFFBOARD, (1, 6, 0)),
        (PX4_ID, RequestKind.LAND, (1, 4, 6)),
        (PX4_ID, RequestKind.HOLD, (1, 4, 3)),
        (ARDUPILOT, RequestKind.OFFBOARD, (1, 4, 0)),
        (ARDUPILOT, RequestKind.LAND, (1, 9, 0)),
        (ARDUPILOT, RequestKind.HOLD, (1, 17, 0)),
    ],
)
def test_each_mode_is_asked_for_in_the_autopilots_own_numbers(
    autopilot: int, kind: RequestKind, params: tuple[int, ...]
) -> None:
    """PX4.md: "Mode command DO_SET_MODE(base 1 custom, main 6)"."""
    peer = Peer(autopilot)
    peer.run(1.1)
    peer.request(kind)
    peer.take()
    sent = [c for c in peer.of("COMMAND_LONG") if c.command == 176]
    assert [(c.param1, c.param2, c.param3) for c in sent] == [params]
    assert [(c.target_system, c.target_component) for c in sent] == [(1, 1)]


def test_a_heartbeat_of_something_else_is_no_autopilot() -> None:
    peer = Peer()
    peer.say(p.heartbeat(autopilot=8))
    assert peer.session.autopilot is None
    assert peer.session.counts == {"refused.not_an_autopilot": 1}


# ---- streams --------------------------------------------------------------------------------------------------------


def test_streams_are_asked_for_once_each_and_unused_ones_switched_off() -> None:
    peer = Peer()
    peer.run(2.0)
    asked = [(int(c.param1), c.param2) for c in peer.of("COMMAND_LONG") if c.command == 511]
    assert asked == [(i, pytest.approx(1e6 / hz if hz else -1)) for i, hz in PX4.streams_hz]
    assert dict(PX4.streams_hz)[31] == 50.0
    assert "stream_refused" not in peer.event_names()


def test_a_stream_that_nobody_acknowledges_is_asked_for_again_then_told() -> None:
    peer = Peer()
    peer.ack = None
    peer.run(4.5)
    first = [c.confirmation for c in peer.of("COMMAND_LONG") if c.command == 511 and c.param1 == 31]
    assert first == [0, 1, 2, 3]
    told = [event.text for event in peer.events if event.name == "stream_refused"]
    assert told[0] == "Stream ATTITUDE_QUATERNION at 50 Hz: not answered, sent 4 times"


def test_a_refused_stream_is_told_and_does_not_stop_the_others() -> None:
    """ARDUPILOT.md recordings: unknown id: DENIED."""
    peer = Peer(ARDUPILOT)
    peer.ack = 2
    peer.run(2.0)
    told = [event.text for event in peer.events if event.name == "stream_refused"]
    assert "Stream LOCAL_POSITION_NED at 10 Hz: denied" in told
    assert len(told) == 10


# ---- origin ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("autopilot", [PX4_ID, ARDUPILOT])
def test_no_odometry_leaves_before_the_origin_is_confirmed(autopilot: int) -> None:
    """PX4.md 6: the origin before the first vision sample. AUTOPILOTS.md: "automatic modes need SET_GPS_GLOBAL_ORIGIN,
    before the first vision sample, altitude 0"."""
    peer = Peer(autopilot)
    peer.answers_origin_after = 10**9
    peer.run(6.0, vision=True)
    assert peer.of("SET_GPS_GLOBAL_ORIGIN")
    assert not peer.of("ODOMETRY")
    assert peer.session.counts["vision.no_origin"] > 100
    peer.answers_origin_after = 0
    peer.run(2.0, vision=True)
    assert len(peer.of("ODOMETRY")) > 10


def test_the_origins_altitude_is_zero() -> None:
    """PX4.md 7: an origin at 489 m made local z jump to 489 m when vision began. AUTOPILOTS.md: "automatic modes need
    SET_GPS_GLOBAL_ORIGIN, before the first vision sample, altitude 0"."""
    peer = Peer()
    peer.run(4.0)
    (sent,) = peer.of("SET_GPS_GLOBAL_ORIGIN")
    assert (sent.latitude, sent.longitude, sent.altitude, sent.target_system) == (474000000, 85000000, 0, 1)


def test_the_origin_is_sent_again_each_second_until_it_comes_back() -> None:
    """AUTOPILOTS.md: ArduPilot: sent until GPS_GLOBAL_ORIGIN comes back; a text does not prove it."""
    peer = Peer(ARDUPILOT)
    peer.answers_origin_after = 2
    peer.run(3.0)
    peer.say(m.MAVLink_statustext_message(6, b"EKF3 IMU0 origin set"))
    assert not state(peer).is_ready_to_arm
    peer.run(4.0)
    assert len(peer.of("SET_GPS_GLOBAL_ORIGIN")) == 3
    assert peer.event_names().count("origin_confirmed") == 1


@pytest.mark.parametrize("autopilot", [PX4_ID, ARDUPILOT])
def test_an_origin_that_is_there_already_is_not_set_again(autopilot: int) -> None:
    """After a restart of the companion the autopilot still has it."""
    peer = Peer(autopilot)
    peer.has_origin = True
    peer.run(4.0, vision=True)
    assert not peer.of("SET_GPS_GLOBAL_ORIGIN")
    assert peer.of("ODOMETRY")


def test_no_origin_is_set_while_px4_holds_a_horizontal_position() -> None:
    """PX4.md 6: set while NED vision is fused, the local position jumps by thousands of kilometres."""
    peer = Peer()
    peer.flags = p.PX4_FUSED
    peer.run(6.0)
    assert not peer.of("SET_GPS_GLOBAL_ORIGIN")
    peer.flags = p.PX4_NOT_FUSED
    peer.run(2.0)
    assert peer.of("SET_GPS_GLOBAL_ORIGIN")


@pytest.mark.parametrize("autopilot", [PX4_ID, ARDUPILOT])
def test_no_origin_is_set_on_an_armed_vehicle(autopilot: int) -> None:
    """PX4.md: "sending SET_GPS_GLOBAL_ORIGIN makes the local position jump to about (5.2e6, 1.07e6) m"."""
    peer = Peer(autopilot)
    peer.armed = True
    peer.run(6.0)
    assert not peer.of("SET_GPS_GLOBAL_ORIGIN")


def test_an_origin_with_an_altitude_is_warned_of() -> None:
    """PX4.md: "an origin at 489 m made local z jump to 489 m when vision began, still valid"."""
    peer = Peer()
    peer.run(0.9)
    peer.say(p.heartbeat())
    peer.say(m.MAVLink_gps_global_origin_message(474000000, 85000000, 489399, 0))
    (warning,) = [event for event in peer.events if event.name == "origin_altitude"]
    assert "489.4 m" in warning.text


# ---- time -----------------------------------------------------------------------------------------------------------


def test_timesync_is_answered_with_our_monotonic_clock() -> None:
    """PX4.md: "so do not answer TIMESYNC with wall time there"."""
    peer = Peer()
    peer.say(m.MAVLink_timesync_message(0, 777))
    (answer,) = peer.take()
    assert (answer.tc1, answer.ts1) == (peer.t_ns, 777)


def test_timesync_is_asked_at_10_hz() -> None:
    """AUTOPILOTS.md: "TIMESYNC at 10 Hz; used after 500 good exchanges (about 50 s) with round trip < 10 ms"."""
    peer = Peer()
    peer.run(5.0)
    asked = [message for message in peer.of("TIMESYNC") if message.tc1 == 0]
    assert 38 <= len(asked) <= 52


def test_px4_is_not_armed_before_its_500_exchanges() -> None:
    """AUTOPILOTS.md: used after 500 good exchanges, about 50 s; FAULTS 11: refuses to arm, says why."""
    peer = Peer()
    peer.run(3.0)
    peer.flags = p.PX4_FUSED
    peer.run(40.0, vision=True)
    assert not peer.session.time_synced
    (reason,) = state(peer).not_ready_because
    assert "of the 500 exchanges" in reason
    peer.run(12.0, vision=True)
    assert peer.session.time_synced
    assert state(peer).is_ready_to_arm, state(peer).not_ready_because


def test_ardupilot_needs_no_500_exchanges() -> None:
    """AUTOPILOTS.md: "corrects jitter itself"."""
    peer = Peer(ARDUPILOT)
    peer.make_ready()
    assert state(peer).is_ready_to_arm, state(peer).not_ready_because


def test_attitude_carries_our_time_not_the_autopilots() -> None:
    peer = Peer()
    peer.run(3.0)
    sample = [r for r in peer.received if isinstance(r, AttitudeSample)][-1]
    assert 0 <= peer.t_ns - sample.t_ns <= 20 * MS


def test_odometry_is_stamped_in_our_clock() -> None:
    """PX4.md 5: PX4 maps time_usec by its own timesync."""
    peer = Peer()
    peer.run(3.0, vision=True)
    newest = peer.of("ODOMETRY")[-1]
    assert 0 <= peer.t_ns // 1000 - newest.time_usec <= 40_000


# ---- vision ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("autopilot", "frame"), [(PX4_ID, 1), (ARDUPILOT, 20)])
def test_odometry_is_what_each_autopilot_takes(autopilot: int, frame: int) -> None:
    """AUTOPILOTS.md: frames, estimator type, quality, reset counter. PX4.md: "no vehicle_global_position is ever
    published even after SET_GPS_GLOBAL_ORIGIN"."""
    peer = Peer(autopilot)
    peer.run(3.0)
    sample = p.estimate(
        peer.t_ns,
        position_map_m=np.array([1.0, 2.0, 3.0]),
        velocity_body_mps=np.array([0.1, 0.2, 0.3]),
        rate_body_radps=np.array([0.01, 0.02, 0.03]),
        reset_counter=257,
    )
    assert peer.session.send_odometry(sample)
    (sent,) = peer.take()
    assert (sent.frame_id, sent.child_frame_id, sent.estimator_type) == (frame, 12, 3)
    assert (sent.x, sent.y, sent.z) == (1.0, -2.0, -3.0)
    assert (sent.vx, sent.vy, sent.vz) == pytest.approx((0.1, -0.2, -0.3))
    assert (sent.rollspeed, sent.pitchspeed, sent.yawspeed) == pytest.approx((0.01, -0.02, -0.03))
    assert (sent.quality, sent.reset_counter) == (90, 1)
    assert sent.pose_covariance[0] == pytest.approx(0.01)
    assert sent.velocity_covariance[0] == pytest.approx(0.01)
    assert math.isnan(sent.velocity_covariance[20])
    assert sent.get_srcComponent() == 197


@pytest.mark.parametrize("autopilot", [PX4_ID, ARDUPILOT])
def test_samples_leave_no_closer_than_20_ms_and_never_backwards(autopilot: int) -> None:
    """ARDUPILOT.md: messages closer than 20 ms are dropped. AUTOPILOTS.md: ">= 4 Hz, used up to 50 Hz". PX4.md:
    "too-fast samples are dropped with EV data too fast"."""
    peer = Peer(autopilot)
    peer.run(3.0)
    times = [0, 10, 19, 20, 15, 45, 45, 65]
    left = [peer.session.send_odometry(p.estimate(peer.t_ns + t * MS)) for t in times]
    assert left == [True, False, False, True, False, True, False, True]
    assert peer.session.counts["vision.time_went_back"] == 2


def test_a_failed_estimate_is_not_sent() -> None:
    """PX4.md 7: quality -1 is accepted by PX4: so it must not leave. FAULTS 8: quality -1, silent. AUTOPILOTS.md: "-1
    failed, 0 unknown, 1..100; must reach EKF2_EV_QMIN (0 = off)"."""
    peer = Peer()
    peer.run(3.0)
    assert not peer.session.send_odometry(p.estimate(peer.t_ns, quality=-1))


@pytest.mark.parametrize(
    "changes",
    [
        {"position_map_m": np.array([0.0, float("nan"), 0.0])},
        {"velocity_body_mps": np.array([float("inf"), 0.0, 0.0])},
        {"pose_covariance": np.full((6, 6), float("nan"))},
        {"q_map_body_wxyz": np.zeros(4)},
    ],
)
def test_a_sample_that_is_not_finite_never_leaves(changes: dict[str, object]) -> None:
    """AUTOPILOTS.md: "NaN check"."""
    peer = Peer()
    peer.run(3.0)
    assert not peer.session.send_odometry(p.estimate(peer.t_ns, **changes))


# ---- setpoints ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("autopilot", [PX4_ID, ARDUPILOT])
def test_a_setpoint_is_velocity_and_yaw_rate_in_local_ned(autopilot: int) -> None:
    """PX4.md 4 and ARDUPILOT.md: other frames are refused, or make ArduPilot swing. AUTOPILOTS.md:
    "SET_POSITION_TARGET_LOCAL_NED, frame LOCAL_NED or BODY_NED, with type masks"."""
    peer = Peer(autopilot)
    peer.run(1.1)
    assert peer.session.send_setpoint(p.setpoint(peer.t_ns, (0.4, 0.2, 0.1), 0.3))
    (sent,) = peer.take()
    assert (sent.coordinate_frame, sent.type_mask) == (1, 0x5C7)
    assert (sent.vx, sent.vy, sent.vz, sent.yaw_rate) == pytest.approx((0.4, -0.2, -0.1, -0.3))
    assert (sent.target_system, sent.target_component) == (1, 1)


def test_silent_means_that_nothing_is_sent() -> None:
    peer = Peer()
    peer.run(1.1)
    silent = Setpoint(t_ns=peer.t_ns, kind=SetpointKind.SILENT, velocity_map_mps=np.zeros(3), yaw_rate_radps=0.0)
    assert not peer.session.send_setpoint(silent)
    assert not peer.take()


def test_a_setpoint_that_is_not_finite_never_leaves() -> None:
    peer = Peer()
    peer.run(1.1)
    assert not peer.session.send_setpoint(p.setpoint(peer.t_ns, (float("nan"), 0, 0)))
    assert [event.name for event in peer.session.take_events()] == ["setpoint_not_finite"]


# ---- commands -------------------------------------------------------------------------------------------------------


def test_arming_is_refused_by_our_own_gate_with_every_reason() -> None:
    peer = Peer()
    peer.run(1.1)
    peer.request(RequestKind.ARM)
    peer.run(0.1)
    assert not [c for c in peer.of("COMMAND_LONG") if c.command == 400]
    text = next(event.text for event in peer.events if event.name == "arm_refused")
    for part in ("origin:", "time sync:", "vision:", "fusion:"):
        assert part in text


def test_arming_is_sent_once_the_gate_is_green_and_its_end_is_told() -> None:
    peer = Peer()
    peer.make_ready()
    peer.request(RequestKind.ARM)
    peer.step(vision=True)
    (command,) = [c for c in peer.of("COMMAND_LONG") if c.command == 400]
    assert (command.param1, command.param2) == (1.0, 0.0), "never by force"
    assert "arm_accepted" in peer.event_names()


@pytest.mark.parametrize("autopilot", [PX4_ID, ARDUPILOT])
@pytest.mark.parametrize(("turn_deg", "is_refused"), [(0, False), (8, False), (12, True), (90, True), (180, True)])
def test_an_attitude_that_is_not_the_estimates_refuses_arming(
    autopilot: int, turn_deg: float, is_refused: bool
) -> None:
    """FAULTS 27: frames mixed up (ENU/NED, yaw): attitude against FC within 10 deg, before arming. Fused, the
    autopilot's heading is the vision's: one that differs is turned by a frame or a mount."""
    peer = Peer(autopilot)
    half = math.radians(turn_deg) / 2
    peer.q = (math.cos(half), 0.0, 0.0, math.sin(half))
    peer.make_ready()
    reasons = state(peer).not_ready_because
    assert [r for r in reasons if r.startswith(f"frames: estimate and autopilot disagree by {turn_deg} deg")] == [
        *reasons
    ]
    assert bool(reasons) is is_refused
    peer.request(RequestKind.ARM)
    assert bool([c for c in peer.take() if c.get_type() == "COMMAND_LONG" and c.command == 400]) is not is_refused


def test_a_roll_that_is_not_the_estimates_refuses_arming_too() -> None:
    """FAULTS 27: a LiDAR mounted on its side agrees in heading."""
    peer = Peer()
    peer.q = (math.cos(0.15), math.sin(0.15), 0.0, 0.0)
    peer.make_ready()
    (reason,) = state(peer).not_ready_because
    assert "disagree by 17 deg (0 in heading" in reason


def test_a_refused_command_is_told_with_the_autopilots_word() -> None:
    """PX4.md 7: a disarmed OFFBOARD request is always accepted; arming is then refused while the stream is missing."""
    peer = Peer()
    peer.make_ready()
    peer.ack = 1
    peer.request(RequestKind.ARM)
    peer.run(0.1, vision=True)
    (event,) = [event for event in peer.events if event.name == "arm_refused"]
    assert event.text == "arm: temporarily rejected"


def test_land_is_sent_again_until_answered_and_then_given_up_aloud() -> None:
    peer = Peer()
    peer.run(2.0)
    peer.ack = None
    peer.request(RequestKind.LAND)
    peer.request(RequestKind.LAND)
    peer.run(4.0)
    assert [c.confirmation for c in peer.of("COMMAND_LONG") if c.command == 176] == [0, 1, 2, 3]
    assert "land_refused" in peer.event_names()


def test_land_does_not_wait_behind_stream_requests() -> None:
    peer = Peer()
    peer.ack = None
    peer.run(1.1)
    peer.request(RequestKind.LAND)
    assert [c.command for c in peer.take() if c.get_type() == "COMMAND_LONG"] == [176]


def test_an_ack_for_another_companion_is_not_ours() -> None:
    peer = Peer()
    peer.run(2.0)
    peer.ack = None
    peer.request(RequestKind.LAND)
    peer.say(m.MAVLink_command_ack_message(176, 0, 0, 0, 255, 190))
    assert "land_accepted" not in peer.event_names()
    peer.say(m.MAVLink_command_ack_message(176, 0, 0, 0, 1, 191))
    assert "land_accepted" in peer.event_names()


# ---- take-off of ArduCopter -----------------------------------------------------------------------------------------


def ready_in_guided() -> Peer:
    peer = Peer(ARDUPILOT)
    peer.make_ready()
    peer.custom_mode, peer.armed = 4, True
    peer.run(1.1, vision=True)
    peer.say(m.MAVLink_extended_sys_state_message(0, 1))
    assert state(peer).mode is FlightMode.OFFBOARD
    return peer


def test_arducopter_takes_off_by_command_and_setpoints_wait_for_it() -> None:
    """ARDUPILOT.md recordings: armed in GUIDED it leaves the ground by NAV_TAKEOFF, and says in air (2) when up.
    AUTOPILOTS.md: "GUIDED, armed, EKF origin"."""
    peer = ready_in_guided()
    assert peer.session.send_setpoint(p.setpoint(peer.t_ns)), "standing still needs no take-off"
    assert not peer.session.send_setpoint(p.setpoint(peer.t_ns, (0, 0, 0.5)))
    assert not peer.session.send_setpoint(p.setpoint(peer.t_ns + 1, (0, 0, 0.5)))
    commands = [c for c in peer.take() if c.get_type() == "COMMAND_LONG"]
    assert [(c.command, c.param7) for c in commands] == [(22, 1.5)]
    peer.say(m.MAVLink_command_ack_message(22, 0, 0, 0, 1, 191))
    peer.say(m.MAVLink_extended_sys_state_message(0, 3))
    assert not peer.session.send_setpoint(p.setpoint(peer.t_ns + 2, (0, 0, 0.5)))
    peer.say(m.MAVLink_extended_sys_state_message(0, 2))
    assert peer.session.send_setpoint(p.setpoint(peer.t_ns + 3, (0, 0, 0.5)))


def test_a_refused_takeoff_is_tried_again_after_a_pause() -> None:
    peer = ready_in_guided()
    peer.session.send_setpoint(p.setpoint(peer.t_ns, (0, 0, 0.5)))
    peer.say(m.MAVLink_command_ack_message(22, 4, 0, 0, 1, 191))
    peer.take()
    assert peer.session.send_setpoint(p.setpoint(peer.t_ns + SECOND, (0, 0, 0.5)))
    assert not peer.session.send_setpoint(p.setpoint(peer.t_ns + 3 * SECOND, (0, 0, 0.5)))
    assert [c.command for c in peer.take() if c.get_type() == "COMMAND_LONG"] == [22]


# ---- what comes back ------------------------------------------------------------------------------------------------


def test_attitude_is_turned_into_our_frames() -> None:
    peer = Peer()
    peer.say(p.heartbeat())
    half = math.sqrt(0.5)
    (sample,) = [
        r
        for r in peer.say(m.MAVLink_attitude_quaternion_message(5000, half, 0, 0, half, 0.1, 0.2, 0.3))
        if isinstance(r, AttitudeSample)
    ]
    assert np.allclose(sample.q_ref_body_wxyz, [half, 0, 0, -half]), "clockwise from above is a right turn"
    assert np.allclose(sample.rate_body_radps, [0.1, -0.2, -0.3])


@pytest.mark.parametrize(
    ("orientation", "low", "now", "quality", "distance"),
    [
        (25, 10, 150, 0, 1.5),
        (25, 10, 5, 0, None),
        (25, 10, 9999, 0, None),
        (0, 10, 150, 0, None),
        (25, 10, 150, 1, None),
    ],
)
def test_only_a_good_downward_distance_is_a_rangefinder_sample(
    orientation: int, low: int, now: int, quality: int, distance: float | None
) -> None:
    peer = Peer()
    message = m.MAVLink_distance_sensor_message(
        5000, low, 4000, now, 0, 0, orientation, 255, 0, 0, (0, 0, 0, 0), quality
    )
    samples = [r.distance_m for r in peer.say(message) if isinstance(r, RangefinderSample)]
    assert samples == ([] if distance is None else [distance])


def test_position_is_valid_only_by_the_estimators_flags() -> None:
    """PX4.md 7: between origin and first vision LOCAL_POSITION_NED streams millions of metres."""
    peer = Peer()
    peer.run(1.1)
    far = m.MAVLink_local_position_ned_message(peer.boot_ns // MS, -5227321.0, -1067128.0, 0, 0, 0, 0)
    peer.say(far)
    assert not state(peer).is_position_valid
    peer.say(p.estimator_status(p.PX4_FUSED))
    peer.say(m.MAVLink_local_position_ned_message(peer.boot_ns // MS, 1.0, 2.0, -3.0, 0.1, 0.2, -0.3))
    assert state(peer).is_position_valid
    assert np.allclose(state(peer).position_map_m, [1, -2, 3])
    assert np.allclose(state(peer).velocity_map_mps, [0.1, -0.2, 0.3])


@pytest.mark.parametrize(("percent", "ratio"), [(75, 0.75), (0, 0.0), (-1, None)])
def test_battery_is_a_share_or_not_known(percent: int, ratio: float | None) -> None:
    peer = Peer()
    peer.say(m.MAVLink_sys_status_message(0, 0, 0, 0, 0, 0, percent, 0, 0, 0, 0, 0, 0))
    assert state(peer).battery_ratio == ratio


# ---- loss, restart, takeover ----------------------------------------------------------------------------------------


def test_a_link_is_weak_after_1_s_lost_after_3_s_and_told_when_back() -> None:
    """FAULTS 13."""
    peer = Peer()
    peer.run(2.0)
    peer.silent = True
    start = peer.t_ns
    peer.run(4.5)
    told = [(e.name, round((e.t_ns - start) / SECOND, 1)) for e in peer.events if e.name.startswith("link_")]
    assert told[0][0] == "link_weak"
    assert 0.9 <= told[0][1] <= 1.2
    assert told[1][0] == "link_lost"
    assert 2.9 <= told[1][1] <= 3.2
    assert not state(peer).is_connected
    assert not state(peer).is_ready_to_arm
    peer.silent = False
    peer.run(1.1)
    assert [name for name in peer.event_names() if name.startswith("link_")][-1] == "link_good"


def test_a_restart_of_the_autopilot_redoes_the_handshake_and_never_arms() -> None:
    """FAULTS 12: drop offboard, redo the handshake; never arms by itself."""
    peer = Peer()
    peer.make_ready()
    peer.armed, peer.custom_mode = True, p.PX4_OFFBOARD
    peer.run(2.0, vision=True, setpoints=True)
    peer.ack = None
    peer.request(RequestKind.ARM)  # sent, still unanswered when it restarts
    peer.take()
    peer.boot_ns, peer.armed, peer.has_origin, peer.flags = 1 * SECOND, False, False, p.PX4_NOT_FUSED
    peer.custom_mode, peer.ack = p.PX4_HOLD, 0
    peer.sent.clear()
    peer.run(6.0, vision=True)
    assert "autopilot_rebooted" in peer.event_names()
    assert {c.command for c in peer.of("COMMAND_LONG")} == {511, 512}
    assert peer.of("SET_GPS_GLOBAL_ORIGIN")
    first_odometry = min(i for i, message in enumerate(peer.sent) if message.get_type() == "ODOMETRY")
    origin = min(i for i, message in enumerate(peer.sent) if message.get_type() == "SET_GPS_GLOBAL_ORIGIN")
    assert origin < first_odometry
    assert not peer.session.time_synced
    assert not state(peer).is_ready_to_arm
    assert not state(peer).is_armed


def test_an_ardupilot_that_boots_again_is_noticed_though_nothing_with_its_clock_streams() -> None:
    """As seen with real ArduCopter: after its restart only heartbeats come, the first with MAV_STATE_BOOT."""
    peer = Peer(autopilot=3)
    peer.make_ready()
    peer.sent.clear()
    peer.say(p.heartbeat(3, custom_mode=0, status=1))
    peer.run(2.0)
    assert "autopilot_rebooted" in peer.event_names()
    assert 511 in {c.command for c in peer.of("COMMAND_LONG")}  # streams are asked for again
    assert not state(peer).is_ready_to_arm


def test_an_autopilot_that_was_gone_is_asked_for_all_again() -> None:
    peer = Peer(autopilot=3)
    peer.make_ready()
    peer.silent = True
    peer.run(4.0)
    peer.sent.clear()
    peer.silent = False
    peer.run(2.0)
    assert 511 in {c.command for c in peer.of("COMMAND_LONG")}
    assert "autopilot_rebooted" not in peer.event_names()  # that is not known


def test_one_that_boots_for_the_first_time_has_not_rebooted() -> None:
    peer = Peer(autopilot=3)
    peer.say(p.heartbeat(3, custom_mode=0, status=0))
    peer.say(p.heartbeat(3, custom_mode=0, status=1))
    peer.say(p.heartbeat(3, custom_mode=0, status=3))
    assert "autopilot_rebooted" not in peer.event_names()


def test_a_clock_that_wraps_or_a_late_packet_is_no_restart() -> None:
    peer = Peer()
    peer.say(p.heartbeat())
    for boot_ms in (4294967290, 20, 40, 30, 60):
        peer.say(p.attitude(boot_ms))
    assert "autopilot_rebooted" not in peer.event_names()


@pytest.mark.parametrize("custom_mode", [p.PX4_POSITION, p.PX4_HOLD, p.PX4_LAND])
def test_when_the_pilot_takes_over_the_setpoints_stop_and_offboard_is_not_taken_back(custom_mode: int) -> None:
    """FAULTS 29: stop streaming; never take it back unasked."""
    peer = Peer()
    peer.make_ready()
    peer.armed, peer.custom_mode = True, p.PX4_OFFBOARD
    peer.run(2.0, vision=True, setpoints=True)
    peer.custom_mode = custom_mode
    peer.say(m.MAVLink_extended_sys_state_message(0, 4 if custom_mode == p.PX4_LAND else 2))
    peer.run(1.1, vision=True)
    assert "pilot_took_control" in peer.event_names()
    assert not peer.session.send_setpoint(p.setpoint(peer.t_ns))
    assert peer.session.send_odometry(p.estimate(peer.t_ns + 30 * MS)), "the vision still serves the pilot"
    peer.request(RequestKind.OFFBOARD)
    peer.request(RequestKind.ARM)
    assert not [c for c in peer.take() if c.get_type() == "COMMAND_LONG"]
    peer.request(RequestKind.LAND)
    assert [c for c in peer.take() if c.get_type() == "COMMAND_LONG"], "landing is always allowed"
    peer.session.resume_control()
    assert peer.session.send_setpoint(p.setpoint(peer.t_ns))


def test_a_mode_that_we_asked_for_is_no_takeover() -> None:
    peer = Peer()
    peer.make_ready()
    peer.armed, peer.custom_mode = True, p.PX4_OFFBOARD
    peer.run(2.0, vision=True, setpoints=True)
    peer.request(RequestKind.LAND)
    peer.custom_mode = p.PX4_LAND
    peer.say(m.MAVLink_extended_sys_state_message(0, 4))
    peer.run(1.1, vision=True)
    assert "pilot_took_control" not in peer.event_names()
    assert state(peer).mode is FlightMode.LAND


def test_a_companion_that_comes_back_in_the_air_stays_passive() -> None:
    """FAULTS 18: comes back passive: no offboard, no arming; operator re-engages."""
    peer = Peer()
    peer.armed, peer.custom_mode, peer.has_origin, peer.flags = True, p.PX4_LAND, True, p.PX4_FUSED
    peer.run(4.0, vision=True, setpoints=True)
    peer.request(RequestKind.OFFBOARD)
    peer.run(0.1)
    assert peer.session.is_passive
    assert "joined_in_flight" in peer.event_names()
    names = {message.get_type() for message in peer.sent}
    assert not names & {"ODOMETRY", "SET_POSITION_TARGET_LOCAL_NED", "SET_GPS_GLOBAL_ORIGIN"}
    assert {c.command for c in peer.of("COMMAND_LONG")} <= {511, 512}
    peer.armed = False
    peer.run(1.1, vision=True)
    assert not peer.session.is_passive
    assert peer.of("ODOMETRY")


def test_failsafe_is_read_from_the_heartbeat() -> None:
    """PX4.md 6: HEARTBEAT shows system_status 5 (CRITICAL) while in failsafe."""
    peer = Peer()
    peer.make_ready()
    peer.armed, peer.custom_mode = True, p.PX4_OFFBOARD
    peer.run(2.0, vision=True, setpoints=True)
    peer.custom_mode, peer.status = p.PX4_LAND, 5
    peer.run(1.1, vision=True)
    assert state(peer).is_failsafe
    assert "autopilot_failsafe" in peer.event_names()
    assert "pilot_took_control" not in peer.event_names()


# ---- forged and foreign ---------------------------------------------------------------------------------------------

HERE, ELSEWHERE = ("10.0.0.1", 14580), ("10.0.0.66", 4444)


def test_frames_in_the_autopilots_name_from_another_address_are_refused() -> None:
    """FAULTS 15: spoofed sender: source."""
    peer = Peer()
    peer.say(p.heartbeat(), HERE)
    out = peer.say(p.heartbeat(armed=True, custom_mode=p.PX4_OFFBOARD), ELSEWHERE)
    assert not state(peer).is_armed
    assert [r.name for r in out if isinstance(r, Event)] == ["security"]
    assert peer.session.peer == HERE
    for _ in range(100):
        peer.say(p.heartbeat(armed=True), ELSEWHERE)
    assert peer.event_names().count("security") == 1, "a flood is told once in 10 s"
    assert peer.session.counts["refused.wrong_address"] == 101


def test_after_a_lost_link_the_autopilot_may_come_from_a_new_address() -> None:
    peer = Peer()
    peer.say(p.heartbeat(), HERE)
    peer.silent = True
    peer.run(3.5)
    peer.say(p.heartbeat(), ELSEWHERE)
    assert state(peer).is_connected


@pytest.mark.parametrize(
    ("system", "component", "reason", "is_security"),
    [
        (1, 191, "our_own_name", True),
        (1, 197, "our_own_name", True),
        (2, 1, "second_autopilot", True),
        (255, 190, "other_system", False),
        (1, 100, "other_component", False),
    ],
)
def test_other_senders_are_counted_and_not_believed(
    system: int, component: int, reason: str, is_security: bool
) -> None:
    """FAULTS 15: system and component id."""
    peer = Peer()
    data = p.heartbeat(armed=True).pack(p.packer(system, component))
    out = peer.hear(bytes(data))
    assert peer.session.autopilot is None
    assert peer.session.counts == {f"refused.{reason}": 1}
    assert bool([r for r in out if isinstance(r, Event) and r.name == "security"]) is is_security


def test_half_a_frame_of_a_stranger_does_not_hold_up_the_autopilot() -> None:
    peer = Peer()
    peer.session.receive(b"\xfd\xff\x00\x00\x00", peer.t_ns, ELSEWHERE)
    peer.say(p.heartbeat(), HERE)
    assert peer.session.autopilot == "px4"


# ---- texts, obstacles, computer -------------------------------------------------------------------------------------


def test_an_event_goes_out_as_statustext_in_chunks_of_50() -> None:
    """AUTOPILOTS.md: STATUSTEXT longer than 50 bytes goes in chunks."""
    peer = Peer()
    text = "The wall is nearer than two metres: braking, then holding until the operator says more"
    peer.session.send_event(Event(t_ns=1, severity=Severity.CRITICAL, name="x", text=text))
    sent = peer.take()
    assert [len(s.text) for s in sent] == [50, len(text) - 50]
    assert "".join(s.text for s in sent) == text
    assert [s.chunk_seq for s in sent] == [0, 1]
    assert len({s.id for s in sent}) == 1
    assert sent[0].id > 0
    assert sent[0].severity == 2


def test_the_autopilots_own_words_are_not_sent_back_to_it() -> None:
    peer = Peer()
    (event,) = [r for r in peer.say(m.MAVLink_statustext_message(4, b"Motor hot")) if isinstance(r, Event)]
    peer.session.send_event(event)
    assert not peer.take()


def test_a_text_in_chunks_is_put_together_and_loses_its_tab() -> None:
    """PX4.md 7: texts end in a tab, come in chunks."""
    peer = Peer()
    whole = b"Arming denied: Resolve system health failures first, then try again\t"
    peer.say(m.MAVLink_statustext_message(2, whole[:50], 7, 0))
    assert not peer.events
    peer.say(m.MAVLink_statustext_message(2, whole[50:], 7, 1))
    assert [(e.text, e.severity) for e in peer.events] == [(whole.decode().strip(), Severity.CRITICAL)]


def test_state_is_landed_or_flying_as_extended_sys_state_says() -> None:
    peer = Peer()
    for number, landed in ((1, LandedState.ON_GROUND), (2, LandedState.IN_AIR), (9, LandedState.UNDEFINED)):
        peer.say(m.MAVLink_extended_sys_state_message(0, number))
        assert state(peer).landed_state is landed


# ---- the vehicle's own number, and what may not fly -----------------------------------------------------------------


def test_a_vehicle_of_another_number_is_addressed_by_it() -> None:
    """PX4.md 4: a companion's heartbeat counts only with the autopilot's own system id; setpoints and commands are
    taken only by their target."""
    session = MavlinkSession(MavlinkConfig(system_id=7))
    hello = p.heartbeat().pack(p.packer(7, 1))
    session.receive(bytes(hello), SECOND)
    session.poll(SECOND)
    session.send_setpoint(p.setpoint(SECOND))
    sent = p.parse(session.data_to_send())
    assert {message.get_srcSystem() for message in sent} == {7}
    targets = {message.target_system for message in sent if hasattr(message, "target_system")}
    assert targets == {7}
    assert {message.get_type() for message in sent} >= {"HEARTBEAT", "COMMAND_LONG", "SET_POSITION_TARGET_LOCAL_NED"}


def test_neither_mavutil_nor_mavsdk_is_part_of_the_flight_loop() -> None:
    """AUTOPILOTS.md: mavutil blocks; MAVSDK repeats the last setpoint from a thread of its own, so that a hung program
    never trips the autopilot's own failsafe."""
    root = Path(companion.__file__).parent
    files = [path for path in root.rglob("*.py") if "__pycache__" not in path.parts]
    assert len(files) > 30
    imports = [
        (path.name, line)
        for path in files
        for line in path.read_text(encoding="utf-8").splitlines()
        if line.lstrip().startswith(("import ", "from ")) and ("mavutil" in line or "mavsdk" in line)
    ]
    assert imports == []
