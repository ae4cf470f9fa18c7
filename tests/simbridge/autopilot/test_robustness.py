"""Whatever arrives, nothing raises; the same input gives the same bytes; the pieces keep their own promises."""

from __future__ import annotations

import hashlib
import math
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import development as dialect

from simbridge.autopilot import Autopilot
from simbridge.autopilot.geo import Origin
from simbridge.autopilot.params import DEFAULTS, INT32, ParamStore, from_float, to_float, wire_type
from simbridge.autopilot.wire import BY_NAME, Decoder, Encoder
from simbridge.sensors import ImuSample
from tests.simbridge.autopilot.rig import Rig

REST = ImuSample(accel_frd_mps2=np.array([0.0, 0.0, -9.81]), gyro_frd_radps=np.zeros(3))
FLOATS = st.one_of(st.floats(width=32), st.sampled_from([0.0, math.nan, math.inf, 3.4e38, -3.4e38]))
_autopilot = Autopilot({"EKF2_EV_CTRL": 15, "EKF2_HGT_REF": 3})
_clock = {"t": 1_000_000_000}


def _steps(count: int) -> None:
    for _ in range(count):
        _clock["t"] += 4_000_000
        _autopilot.step(_clock["t"], REST, None, None)
        _autopilot.take_output()


@given(st.binary(max_size=400))
@settings(max_examples=100, deadline=None)
def test_any_bytes_are_survived(data: bytes) -> None:
    _steps(1)
    _autopilot.receive("offboard", data, _clock["t"])
    _autopilot.receive("offboard", b"\xfd" + data, _clock["t"])


HANDLED = (
    "ODOMETRY", "VISION_POSITION_ESTIMATE", "SET_POSITION_TARGET_LOCAL_NED", "TIMESYNC", "HEARTBEAT", "COMMAND_LONG",
    "COMMAND_INT", "SET_MODE", "SET_GPS_GLOBAL_ORIGIN", "PARAM_REQUEST_READ", "PARAM_SET", "PING", "MISSION_COUNT",
    "MISSION_ITEM_INT", "MISSION_REQUEST_INT", "MISSION_REQUEST_LIST", "MISSION_ACK", "MISSION_CLEAR_ALL",
    "FILE_TRANSFER_PROTOCOL",
)  # fmt: skip


@given(st.sampled_from(HANDLED), st.data())
@settings(max_examples=150, deadline=None)
def test_any_field_values_are_survived(name: str, data: st.DataObject) -> None:
    layout = BY_NAME[name]
    raw = data.draw(st.binary(min_size=layout.struct.size, max_size=layout.struct.size))
    values = list(layout.struct.unpack(raw))
    if name == "COMMAND_LONG":
        values[7] = data.draw(st.sampled_from([20, 21, 22, 176, 192, 246, 400, 510, 511, 512, 519]))
    for i, value in enumerate(values):
        if isinstance(value, float):
            values[i] = data.draw(FLOATS)
    for field in ("target_system", "target_component"):
        if field in layout.slots:
            values[layout.slots[field][0]] = 1
    _steps(2)
    for _ in range(3):
        _autopilot.receive("offboard", Encoder(255, 190).pack(layout, values), _clock["t"])
    _steps(3)


def test_broken_inertial_samples_are_not_taken() -> None:
    rig = Rig()
    rig.fly(2.0)
    broken = ImuSample(accel_frd_mps2=np.array([math.nan, 0.0, 0.0]), gyro_frd_radps=np.full(3, math.inf))
    for _ in range(10):
        rig.autopilot.step(rig.t_ns, broken, None, None)
        rig.t_ns += 4_000_000
    assert np.isfinite(rig.autopilot.ekf.o).all()
    assert np.isfinite(rig.autopilot.ekf.x).all()


def _digest(seed: int) -> str:
    rig, digest = Rig(seed=seed), hashlib.sha256()
    rig.on_output = lambda link, frame: digest.update(frame)
    rig.takeoff(1.0)
    return digest.hexdigest()


def test_the_same_flight_gives_the_same_bytes() -> None:
    assert _digest(11) == _digest(11)
    assert _digest(11) != _digest(12)


def test_frames_agree_with_the_dialects_own_both_ways() -> None:
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=191)
    message = dialect.MAVLink_odometry_message(
        123456789,
        1,
        12,
        1.5,
        -2.5,
        3.5,
        [0.5, 0.5, -0.5, 0.5],
        0.1,
        0.2,
        0.3,
        0.0,
        0.0,
        0.0,
        [0.25] * 21,
        [0.5] * 21,
        3,
        3,
        77,
    )
    (frame,) = Decoder().receive(message.pack(mav))
    for name in message.get_fieldnames():
        value: Any = getattr(message, name)
        expected = tuple(value) if isinstance(value, list) else value
        assert frame.fields[name] == pytest.approx(expected)
    again = Encoder(1, 191).pack_named("ODOMETRY", **frame.fields)
    assert again == message.pack(dialect.MAVLink(None, srcSystem=1, srcComponent=191))


def test_a_stream_cut_anywhere_gives_every_frame() -> None:
    encoder = Encoder(1, 1)
    data = b"".join(encoder.pack_named("HEARTBEAT", type=18) for _ in range(20))
    decoder = Decoder()
    frames = [f for i in range(0, len(data), 7) for f in decoder.receive(data[i : i + 7])]
    assert len(frames) == 20
    assert decoder.bad == 0


def test_a_damaged_frame_is_dropped_and_counted() -> None:
    data = bytearray(Encoder(1, 1).pack_named("HEARTBEAT", type=18))
    data[12] ^= 1
    decoder = Decoder()
    assert list(decoder.receive(bytes(data))) == []
    assert decoder.bad >= 1


@given(st.integers(-(2**31), 2**31 - 1))
def test_integers_travel_bytewise(value: int) -> None:
    if math.isnan(to_float(value)):
        return  # a NaN's bits may not survive a float in between, in PX4 neither
    assert from_float(to_float(value), INT32) == value


def test_every_default_has_the_type_and_name_length_that_the_wire_takes() -> None:
    assert len(DEFAULTS) >= 80
    assert all(len(name) <= 16 for name in DEFAULTS)
    assert wire_type("EKF2_EV_CTRL") == INT32
    assert struct.unpack("<i", struct.pack("<f", to_float(15)))[0] == 15


@pytest.mark.parametrize(
    ("params", "said"),
    [({"NO_SUCH": 1.0}, "NO_SUCH"), ({"EKF2_EV_CTRL": 1.5}, "whole number"), ({"MPC_XY_P": math.nan}, "finite")],
)
def test_wrong_parameters_are_refused_by_name(params: dict[str, float], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        ParamStore(params)


def test_the_projection_is_its_own_inverse_and_px4s() -> None:
    origin = Origin(47.3977432, 8.5455942, 0.0)
    assert origin.project(0.0, 0.0) == pytest.approx((-5227321.0, -1067128.125), abs=0.5)  # recorded, float32
    lat, lon = origin.reproject(*origin.project(47.4, 8.55))
    assert (lat, lon) == pytest.approx((47.4, 8.55), abs=1e-9)
