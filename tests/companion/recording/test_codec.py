"""Messages as JSON and back, exact to the last bit."""

from __future__ import annotations

import dataclasses
import json
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion import messages, topics
from companion.recording import codec
from tests.companion.recording.samples import one_of_each


def same(a: object, b: object) -> bool:
    """Equal to the last bit, NaN and the sign of zero included."""
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, float) and isinstance(b, float):
        return struct.pack("d", a) == struct.pack("d", b)
    return type(a) is type(b) and a == b


@pytest.mark.parametrize("message", one_of_each(), ids=lambda m: type(m).__name__)
def test_message_comes_back_to_the_last_bit(message: object) -> None:
    data = codec.encode(message)
    again = codec.decode(type(message), data)
    for f in dataclasses.fields(message):  # type: ignore[arg-type]
        assert same(getattr(message, f.name), getattr(again, f.name)), f.name
    assert codec.encode(again) == data


@pytest.mark.parametrize("message", one_of_each(), ids=lambda m: type(m).__name__)
def test_what_is_written_is_json_that_any_reader_takes(message: object) -> None:
    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is no JSON")

    json.loads(codec.encode(message), parse_constant=refuse)


def test_every_recorded_topic_is_held_by_these_tests() -> None:
    tested = {type(m) for m in one_of_each()}
    assert {t.message for t in topics.TOPICS if t.recorded} - tested <= {messages.LidarScan}


@given(st.floats(), st.floats())
def test_every_double_comes_back(a: float, b: float) -> None:
    message = messages.RangefinderSample(t_ns=0, distance_m=a)
    assert same(codec.decode(messages.RangefinderSample, codec.encode(message)).distance_m, a) or a != a
    values = np.array([a, b, 0.0])
    setpoint = messages.Setpoint(
        t_ns=0, kind=messages.SetpointKind.VELOCITY, velocity_map_mps=values, yaw_rate_radps=0.0
    )
    np.testing.assert_array_equal(codec.decode(messages.Setpoint, codec.encode(setpoint)).velocity_map_mps, values)


def test_without_cpythons_c_encoder_the_same_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    values = [codec._fields_of(message) for message in one_of_each()[3:9]]
    fast = ["".join(codec._finite_pieces(value, 0)) for value in values if "ranges_m" not in value]
    monkeypatch.setattr(json.encoder, "c_make_encoder", None)
    plain = codec._pieces_of(codec._unlisted)
    assert fast
    assert ["".join(plain(value, 0)) for value in values if "ranges_m" not in value] == fast
