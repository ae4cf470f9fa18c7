"""Edits of recordings do what they say and nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from pymavlink.dialects.v20 import common

from companion.errors import FileFormatError
from companion.lidar.ouster import OusterDecoder
from companion.recording.packed import pack, unpack
from companion.recording.run_types import Input
from stockpilot.replay_edit import edit_inputs, message_ids, rebuild_scans
from tests.companion.lidar.packets import frame_packets, sensor

INFO = sensor()
STEP_NS = 3_125_000


def attitude(n: int) -> bytes:
    link = common.MAVLink(None, 1, 1)
    link.seq = n % 256
    return bytes(common.MAVLink_attitude_quaternion_message(n, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0).pack(link))


def a_flight(turns: int = 5) -> list[Input]:
    inputs = []
    packets = [p for n in range(turns) for p in frame_packets(INFO, n)]
    for n, packet in enumerate(packets):
        t_ns = 10_000_000_000 + n * STEP_NS
        inputs.append(Input("lidar", t_ns, packet))
        if n % 6 == 0:
            inputs.append(Input("mavlink", t_ns, attitude(n)))
        inputs.append(Input("poll", t_ns, b""))
    return rebuild_scans(inputs, INFO.to_json_string())


def edited(*edits: dict) -> list[Input]:
    return edit_inputs(a_flight(), edits)


def scans_of(inputs: list[Input]) -> tuple[list, OusterDecoder]:
    decoder = OusterDecoder(INFO.to_json_string())
    return [s for i in inputs if i.kind == "lidar" for s in decoder.receive(i.data, i.t_ns)], decoder


def test_no_edit_changes_nothing() -> None:
    assert edited() == a_flight()


def test_lost_packets_are_gone_from_then_on() -> None:
    left = [i for i in edited({"edit": "lose", "kind": "lidar", "from_s": 0.2}) if i.kind == "lidar"]
    assert len(left) == 64
    assert sum(i.kind == "mavlink" for i in edited({"edit": "lose", "kind": "lidar"})) == 27


def test_frozen_sensor_is_seen_as_stuck() -> None:
    scans, decoder = scans_of(edited({"edit": "freeze", "from_s": 0.2}))
    assert [s.frame_id for s in scans] == [0, 1]
    assert decoder.dropped["frozen"] == 3


def test_flipped_bits_are_seen_as_checksum_or_header() -> None:
    _, decoder = scans_of(edited({"edit": "flip", "kind": "lidar", "every": 8}))
    dropped = decoder.dropped
    assert sum(dropped.values()) == 20
    assert dropped["checksum"] >= 18


def test_swapped_and_repeated_packets_make_the_same_scans() -> None:
    plain, _ = scans_of(a_flight())
    scans, decoder = scans_of(edited({"edit": "swap", "kind": "lidar"}, {"edit": "repeat", "kind": "lidar"}))
    assert decoder.dropped["repeated"] == 160
    for a, b in zip(plain, scans, strict=True):
        np.testing.assert_array_equal(a.range_m, b.range_m)


def test_late_packets_are_late_and_in_order() -> None:
    late = edited({"edit": "delay", "kind": "lidar", "by_s": 0.06})
    assert [i.t_ns for i in late] == sorted(i.t_ns for i in late)
    first = next(i for i in late if i.kind == "lidar")
    assert first.t_ns == 10_060_000_000


def test_short_sight_takes_far_returns_only() -> None:
    plain, _ = scans_of(a_flight())
    scans, decoder = scans_of(edited({"edit": "short_sight", "max_m": 20.0}))
    assert sum(decoder.dropped.values()) == 0
    for a, b in zip(plain, scans, strict=True):
        near = a.range_m <= 20.0
        np.testing.assert_array_equal(a.range_m[near], b.range_m[near])
        assert not b.range_m[~near].any()
        np.testing.assert_array_equal(a.signal, b.signal)


def test_attitude_that_is_not_a_number_is_soundly_framed() -> None:
    parser = common.MAVLink(None)
    values = [
        message.q1
        for i in edited({"edit": "nan", "every": 2})
        if i.kind == "mavlink"
        for message in parser.parse_buffer(i.data) or []
    ]
    assert len(values) == 27
    assert np.isnan(values).sum() == 13


def test_restart_is_silent_and_then_speaks_from_the_beginning() -> None:
    inputs = edited({"edit": "restart", "from_s": 0.2, "silent_s": 0.1})
    said = [i for i in inputs if i.kind == "mavlink"]
    times = np.array([(i.t_ns - 10_000_000_000) * 1e-9 for i in said])
    assert not ((times >= 0.2) & (times < 0.3)).any()
    again = [i.data for i, t in zip(said, times, strict=True) if t >= 0.3]
    assert again == [i.data for i in said][: len(again)]
    assert message_ids(again[0]) == [31]


def test_unknown_edit_is_told() -> None:
    with pytest.raises(FileFormatError, match="none of"):
        edited({"edit": "paint"})


def test_packed_recording_comes_back_to_the_byte() -> None:
    inputs = a_flight()
    inputs[3] = inputs[3]._replace(source=("10.0.0.1", 7502))
    run = unpack(pack(inputs, {"run": {"mission": "m"}}, {"a.json": b"{}"}))
    assert run.inputs == inputs
    assert run.metadata == {"run": {"mission": "m"}}
    assert run.attachments == {"a.json": b"{}"}


@pytest.mark.parametrize("cut", [0, 10, 100, -1])
def test_packed_recording_that_is_cut_is_told(cut: int) -> None:
    with pytest.raises(FileFormatError, match="packed"):
        unpack(pack(a_flight(), {}, {})[:cut])
