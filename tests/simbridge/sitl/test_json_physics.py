from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simbridge.sitl.json_physics import SERVO_PACKET, JsonPhysics, PhysicsState, encode
from tests.simbridge.sitl.recordings import Datagram, json_physics

REST = PhysicsState(
    gyro_radps=np.zeros(3),
    accel_mps2=np.array([0.0, 0.0, -9.80665]),
    position_m=np.zeros(3),
    q_ned_frd_wxyz=np.array([1.0, 0.0, 0.0, 0.0]),
    velocity_mps=np.zeros(3),
)
STEP_S = 0.00125


def state_of(line: bytes) -> tuple[float, PhysicsState]:
    said = json.loads(line)
    return said["timestamp"], PhysicsState(
        gyro_radps=np.array(said["imu"]["gyro"]),
        accel_mps2=np.array(said["imu"]["accel_body"]),
        position_m=np.array(said["position"]),
        q_ned_frd_wxyz=np.array(said["quaternion"]),
        velocity_mps=np.array(said["velocity"]),
    )


def packet(count: int, rate: int = 800, pwm: int = 1000) -> bytes:
    return SERVO_PACKET.pack(18458, rate, count, *[pwm] * 16)


@pytest.mark.parametrize("part", ["start", "armed", "stall"])
def test_answers_have_the_bytes_that_the_recorded_simulator_sent(part: str) -> None:
    answers = [d.data for d in json_physics(part) if not d.is_from_fc]
    assert len(answers) > 40
    for recorded in answers:
        assert encode(*state_of(recorded), sends_rangefinder=False) == recorded


def test_the_first_second_is_stepped_by_the_rate_that_each_packet_asks_for() -> None:
    """From 1200 Hz down to 800: the same stamps, byte for byte, as the simulator that ArduCopter flew with."""
    physics, replies, recorded = JsonPhysics(sends_rangefinder=False), 0, iter(json_physics("start"))
    rates: list[int] = []
    for asked, answered in zip(recorded, recorded, strict=True):
        request = physics.receive(asked.data)
        assert request is not None
        if request.count != len(rates):
            break  # the end of the first second: from here on not every frame was kept
        assert not request.is_repeat
        rates.append(request.rate_hz)
        time_s, _ = state_of(answered.data)
        ours = physics.reply(REST, 1.0 / request.rate_hz)
        # The rate is shown cut to whole hertz, so while it falls the last digit may differ.
        assert json.loads(ours)["timestamp"] == pytest.approx(time_s, abs=2e-4)
        replies += ours == answered.data
    assert len(rates) > 800
    assert (rates[0], rates[-1]) == (1200, 800)
    assert rates == sorted(rates, reverse=True)
    assert replies >= 3


def test_a_repeated_frame_gets_the_same_answer_and_no_time_passes() -> None:
    physics = JsonPhysics()
    physics.receive(packet(7))
    first = physics.reply(REST, STEP_S)
    again = physics.receive(packet(7))
    assert again is not None
    assert again.is_repeat
    assert physics.repeated_reply() == first
    assert physics.time_s == STEP_S


def test_copies_of_a_frame_not_answered_yet_are_one_request() -> None:
    """The recorded stall: ArduCopter asks five times with one count, gets one answer, and goes on with the next count."""
    physics = JsonPhysics()
    asked: list[Datagram] = [d for d in json_physics("stall") if d.is_from_fc]
    counts = [SERVO_PACKET.unpack(d.data)[2] for d in asked]
    assert counts.count(38481) == 5
    answered = 0
    for datagram, following in zip(asked, [*counts[1:], -1], strict=True):
        request = physics.receive(datagram.data)
        assert request is not None
        assert not request.is_repeat
        if following != request.count:
            physics.reply(REST, STEP_S)
            answered += 1
    assert answered == len(set(counts))
    assert physics.time_s == pytest.approx(answered * STEP_S)


def test_pulse_widths_become_controls_in_the_recorded_flight() -> None:
    physics = JsonPhysics()
    controls = []
    for datagram in json_physics("armed"):
        if datagram.is_from_fc:
            request = physics.receive(datagram.data)
            assert request is not None
            controls.append(request.controls())
            physics.reply(REST, STEP_S)
    u = np.array(controls)
    assert u.min() >= 0.0
    assert u[0] == pytest.approx(np.zeros(4))  # armed, waiting: 1000 us
    assert 0.35 < np.median(u[u > 0.2]) < 0.5  # that simulator's hover; MOT_THST_HOVER is 0.39 there


def test_outputs_that_are_off_are_motors_off() -> None:
    request = JsonPhysics().receive(packet(0, pwm=0))
    assert request is not None
    assert not request.controls().any()


def test_a_count_that_goes_back_is_a_restart_with_a_clock_from_0() -> None:
    physics = JsonPhysics()
    for count in range(5):
        physics.receive(packet(count))
        physics.reply(REST, STEP_S)
    request = physics.receive(packet(0, rate=1200))
    assert request is not None
    assert request.is_restart
    assert not request.is_repeat
    assert json.loads(physics.reply(REST, STEP_S))["timestamp"] == STEP_S


def test_the_clock_cannot_go_back() -> None:
    physics = JsonPhysics()
    physics.receive(packet(0))
    with pytest.raises(ValueError, match="only go forward"):
        physics.reply(REST, 0.0)


def test_a_line_has_a_newline_at_both_ends_and_no_space() -> None:
    line = encode(1.5, REST, sends_rangefinder=True)
    assert (line[:1], line[-1:]) == (b"\n", b"\n")
    assert b" " not in line
    assert line.count(b"\n") == 2


def test_no_return_of_the_rangefinder_is_beyond_any_range() -> None:
    assert json.loads(encode(1.5, REST, sends_rangefinder=True))["rng_1"] == 1000.0


@given(datagram=st.binary(max_size=80))
def test_what_is_no_request_is_dropped_and_counted(datagram: bytes) -> None:
    physics = JsonPhysics()
    request = physics.receive(datagram)
    assert (request is None) == bool(physics.dropped)
