from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simbridge.sensors import BaroSample, ImuSample
from simbridge.sitl.hil import HilLink
from tests.simbridge.sitl.recordings import decode, tlog_frames

STEP_NS = 4_000_000
REST = ImuSample(accel_frd_mps2=np.array([0.0, 0.0, -9.81]), gyro_frd_radps=np.zeros(3))
BARO = BaroSample(pressure_hpa=955.98, pressure_altitude_m=488.0, temperature_c=15.0)
MAG = np.array([0.215, 0.01, 0.425])


def recorded_sensors(count: int) -> list[tuple[bytes, object]]:
    frames = [f for _, f in tlog_frames("autopilots", "px4", "hil_lockstep.to_fc.tlog")]
    pairs = [(f, decode(f)) for f in frames[: count + count // 20]]
    return [(f, m) for f, m in pairs if m.get_type() == "HIL_SENSOR"][:count]


def recorded_answers() -> list[bytes]:
    return [f for _, f in tlog_frames("autopilots", "px4", "hil_lockstep.from_fc.tlog")]


def sent(data: bytes) -> list[object]:
    import pymavlink.dialects.v20.common as mavlink

    return list(mavlink.MAVLink(None).parse_buffer(data) or [])


def test_a_sensor_frame_has_the_bytes_that_the_recorded_simulator_sent() -> None:
    compared = 0
    for frame, m in recorded_sensors(200):
        if m.fields_updated != 0x1BFF:
            continue
        link = HilLink()
        link._mav.seq = frame[4]
        ours = link.hil_sensor(
            m.time_usec * 1000,
            ImuSample(
                accel_frd_mps2=np.array([m.xacc, m.yacc, m.zacc]), gyro_frd_radps=np.array([m.xgyro, m.ygyro, m.zgyro])
            ),
            BaroSample(pressure_hpa=m.abs_pressure, pressure_altitude_m=m.pressure_alt, temperature_c=m.temperature),
            np.array([m.xmag, m.ymag, m.zmag]),
        )
        assert ours == frame
        compared += 1
    assert compared == 40


def test_masks_follow_the_recorded_pattern_baro_in_every_fifth_frame() -> None:
    """PX4.md: "accel 0x7, gyro 0x38, mag 0x1C0, baro 0x1A00"."""
    recorded = [m.fields_updated for _, m in recorded_sensors(100)]
    link, ours = HilLink(), []
    for i in range(100):
        t_ns = 1_004_000_000 + i * STEP_NS
        baro = BARO if t_ns % 20_000_000 == 0 else None
        (message,) = sent(link.hil_sensor(t_ns, REST, baro, MAG))
        ours.append(message.fields_updated)
    assert ours == recorded


def test_without_magnetometer_its_bits_are_off() -> None:
    """PX4.md: "accel 0x7, gyro 0x38, mag 0x1C0, baro 0x1A00"."""
    (message,) = sent(HilLink().hil_sensor(STEP_NS, REST, BARO))
    assert message.fields_updated == 0x1A3F


def test_sensors_at_rest_have_the_recorded_signs() -> None:
    """Specific force down is negative; gravity and field point the same way as in the recording."""
    (ours,) = sent(HilLink().hil_sensor(1_004_000_000, REST, BARO, MAG))
    _, recorded = recorded_sensors(1)[0]
    for name in ("xacc", "yacc", "zacc", "xmag", "ymag", "zmag", "abs_pressure", "pressure_alt"):
        assert getattr(ours, name) == pytest.approx(getattr(recorded, name), abs=0.2), name


def test_time_moves_last_in_a_step() -> None:
    messages = sent(HilLink().sensor_frames(1_000_000_000, REST, BARO, 1.5, MAG))
    assert [m.get_type() for m in messages] == ["HEARTBEAT", "DISTANCE_SENSOR", "HIL_SENSOR"]


def test_rates_are_250_hz_sensors_20_hz_rangefinder_1_hz_heartbeat() -> None:
    link, kinds = HilLink(), []
    for i in range(2500):
        kinds += [m.get_type() for m in sent(link.sensor_frames(1_000_000_000 + i * STEP_NS, REST, None, 1.5))]
    assert {k: kinds.count(k) for k in set(kinds)} == {"HIL_SENSOR": 2500, "DISTANCE_SENSOR": 200, "HEARTBEAT": 10}


def test_rangefinder_looks_down_and_speaks_centimetres() -> None:
    """PX4.md: "HIL_OPTICAL_FLOW, DISTANCE_SENSOR"."""
    message = next(
        m for m in sent(HilLink().sensor_frames(STEP_NS, REST, None, 1.237)) if m.get_type() == "DISTANCE_SENSOR"
    )
    assert (message.current_distance, message.orientation, message.signal_quality) == (124, 25, 100)


def test_no_return_of_the_rangefinder_is_an_invalid_signal() -> None:
    message = next(
        m for m in sent(HilLink().sensor_frames(STEP_NS, REST, None, None)) if m.get_type() == "DISTANCE_SENSOR"
    )
    assert message.signal_quality == 1
    assert message.current_distance > message.max_distance


def test_recorded_answers_are_one_for_each_sensor_frame_in_its_own_time() -> None:
    """PX4.md: "PX4 answers each HIL_SENSOR with exactly one HIL_ACTUATOR_CONTROLS"."""
    link, controls = HilLink(), []
    for frame in recorded_answers():
        controls += link.receive(frame)
    times = np.array([c.t_us for c in controls])
    assert len(controls) == 4348
    assert set(np.diff(times)) == {4000}
    assert all(c.is_lockstep for c in controls)
    assert not link.dropped
    assert link.heartbeats == 1


def test_recorded_motors_are_off_until_armed_and_rise_together() -> None:
    link, controls = HilLink(), []
    for frame in recorded_answers():
        controls += link.receive(frame)
    armed = np.array([c.is_armed for c in controls])
    motors = np.array([c.motors for c in controls])
    seconds = np.array([c.t_us for c in controls]) / 1e6
    assert not motors[~armed].any()
    assert seconds[armed][0] == pytest.approx(1.0 + 10.02, abs=0.05)
    at_14 = motors[np.searchsorted(seconds, 15.0)]
    assert at_14 == pytest.approx(np.full(4, 0.45), abs=0.1)


def test_the_request_for_ground_truth_is_noted_and_not_answered() -> None:
    """PX4.md: "SET_MESSAGE_INTERVAL(115 HIL_STATE_QUATERNION, 5000 us) and one HEARTBEAT"."""
    link = HilLink()
    link.receive(recorded_answers()[0])
    assert link.truth_period_ns == 5_000_000
    kinds = {m.get_type() for m in sent(link.sensor_frames(STEP_NS, REST, BARO, 1.0, MAG))}
    assert "HIL_STATE_QUATERNION" not in kinds


@given(cuts=st.lists(st.integers(1, 200), min_size=1, max_size=40))
def test_frames_cut_anywhere_give_the_same_answers(cuts: list[int]) -> None:
    stream = b"".join(recorded_answers()[:20])
    link, got, at = HilLink(), [], 0
    for cut in [*cuts, len(stream)]:
        got += link.receive(stream[at : at + cut])
        at += cut
    assert [c.t_us for c in got] == [1_112_000 + 4000 * i for i in range(18)]


@given(noise=st.binary(max_size=400))
def test_noise_never_raises_and_the_next_answers_are_read(noise: bytes) -> None:
    link = HilLink()
    link.receive(noise)
    link.receive(bytes(600))  # long enough to end any frame that the noise began
    got = [c for frame in recorded_answers()[2:22] for c in link.receive(frame)]
    assert len(got) >= 10


def test_motors_that_are_not_finite_are_dropped() -> None:
    from pymavlink.dialects.v20 import common as mavlink

    link = HilLink()
    frame = mavlink.MAVLink_hil_actuator_controls_message(1, [float("nan")] * 16, 129, 1).pack(mavlink.MAVLink(None))
    assert link.receive(bytes(frame)) == []
    assert link.dropped["not_finite"] == 1
