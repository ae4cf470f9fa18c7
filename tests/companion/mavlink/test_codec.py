"""Bytes in, frames out: whatever comes, nothing is raised and nothing good is lost."""

from __future__ import annotations

import json
import random
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as m

from companion.config import MavlinkConfig
from companion.mavlink import wire
from companion.mavlink.codec import Decoder, crc, encode
from companion.mavlink.session import MavlinkSession
from tests.companion.mavlink.peer import packer
from tests.companion.mavlink.tlog import read_tlog
from tests.shared_data import shared_data

TLOGS = [
    *(f"ardupilot/{name}" for name in ("ev_guided", "setpoint_loss", "vision_loss", "wrong_input", "handshake")),
    "ardupilot/json_physics",
    *(f"px4/{name}" for name in ("ev_offboard", "setpoint_loss", "vision_loss", "wrong_input", "handshake")),
    "px4/origin_altitude",
    "px4/hil_lockstep",
]


def frame(number: int = 0) -> bytes:
    payload = wire.pack(wire.TIMESYNC, number, 7)
    return encode(wire.TIMESYNC, payload, system=1, component=1, sequence=number & 0xFF)


def test_checksum_is_mavlinks() -> None:
    for data in (b"", b"a", b"123456789", bytes(range(256))):
        assert crc(data) == m.x25crc(data).crc


def test_what_we_encode_pymavlink_reads() -> None:
    payload = wire.pack(wire.TIMESYNC, 123, 456)
    message = m.MAVLink(None).decode(bytearray(encode(wire.TIMESYNC, payload, system=3, component=191, sequence=250)))
    assert (message.tc1, message.ts1) == (123, 456)
    assert (message.get_srcSystem(), message.get_srcComponent(), message.get_seq()) == (3, 191, 250)


@pytest.mark.parametrize("mavlink1", [False, True])
def test_what_pymavlink_packs_we_decode(mavlink1: bool) -> None:
    data = m.MAVLink_heartbeat_message(2, 12, 29, 50593792, 3, 3).pack(packer(), force_mavlink1=mavlink1)
    (found,) = Decoder().receive(bytes(data))
    assert found.version == (1 if mavlink1 else 2)
    assert wire.unpack(wire.HEARTBEAT, found.payload) == (50593792, 2, 12, 29, 3, 3)


@given(data=st.binary(max_size=600))
@settings(max_examples=300, deadline=None)
def test_arbitrary_bytes_never_raise(data: bytes) -> None:
    decoder = Decoder()
    for found in decoder.receive(data):
        assert found.msg_id in wire.CRC_EXTRA
    session = MavlinkSession(MavlinkConfig())
    session.receive(data, 1)
    session.poll(1)


@given(
    msg_id=st.sampled_from(sorted(wire.CRC_EXTRA)),
    payload=st.binary(min_size=1, max_size=255),
    system=st.sampled_from([0, 1, 255]),
    component=st.sampled_from([1, 191, 197, 0]),
    t_ns=st.integers(0, 10**15),
)
@settings(max_examples=400, deadline=None)
def test_frames_with_right_checksum_and_any_content_never_raise(
    msg_id: int, payload: bytes, system: int, component: int, t_ns: int
) -> None:
    session = MavlinkSession(MavlinkConfig())
    hello = m.MAVLink_heartbeat_message(2, 12, 29, 50593792, 3, 3).pack(packer())
    session.receive(bytes(hello), t_ns)
    session.receive(encode(msg_id, payload, system=system, component=component, sequence=0), t_ns + 1)
    session.poll(t_ns + 2)
    assert session.vehicle_state(t_ns + 3).is_connected


@given(
    st.lists(st.one_of(st.just(None), st.binary(max_size=40)), max_size=12),
    st.randoms(use_true_random=False),
)
@settings(max_examples=150, deadline=None)
def test_every_good_frame_is_found_between_garbage_and_in_any_cut(
    parts: list[bytes | None], source: random.Random
) -> None:
    stream, sent = b"", 0
    for part in parts:
        if part is None:
            stream += frame(sent)
            sent += 1
        else:
            stream += part
    stream += b"\0" * 600  # so that a false start has all it waits for
    decoder, found = Decoder(), []
    while stream:
        cut = source.randint(1, 300)
        found += decoder.receive(stream[:cut])
        stream = stream[cut:]
    numbers = [wire.unpack(wire.TIMESYNC, f.payload)[0] for f in found if f.msg_id == wire.TIMESYNC]
    assert numbers == list(range(sent))


@given(at=st.integers(0, 27), bit=st.integers(0, 7))
@settings(max_examples=100, deadline=None)
def test_a_flipped_bit_costs_that_frame_and_no_other(at: int, bit: int) -> None:
    """FAULTS 14: corrupt MAVLink: dropped and counted."""
    damaged = bytearray(frame(1))
    at = min(at, len(damaged) - 1)
    damaged[at] ^= 1 << bit
    decoder = Decoder()
    found = decoder.receive(frame(0) + bytes(damaged) + frame(2) * 20)
    assert [wire.unpack(wire.TIMESYNC, f.payload)[0] for f in found] == [0, *[2] * 20]
    assert sum(decoder.dropped.values()) > 0


def test_flags_that_we_do_not_understand_drop_the_frame() -> None:
    data = bytearray(frame(0))
    data[2] = 0x02
    decoder = Decoder()
    assert decoder.receive(bytes(data) + frame(1))[0].payload == frame(1)[10:-2]
    assert decoder.dropped["incompatible_flags"] == 1


def test_an_unknown_message_is_stepped_over_and_counted() -> None:
    unknown = b"\xfd\x03\x00\x00\x00\x01\x01\x40\x42\x0f" + b"abc" + b"\x11\x22"
    decoder = Decoder()
    assert len(decoder.receive(unknown + frame(1))) == 1
    assert decoder.dropped["unknown_id"] == 1


@pytest.mark.parametrize("name", TLOGS)
@pytest.mark.parametrize("direction", ["from_fc", "to_fc"])
def test_every_recorded_frame_is_decoded(name: str, direction: str) -> None:
    """Issue 4: our MAVLink decoder reads every recorded frame. PX4.md: "All of it can be heard in
    data/autopilots/px4"."""
    records = read_tlog(shared_data("autopilots", f"{name}.{direction}.tlog"))
    decoder = Decoder()
    found = decoder.receive(b"".join(data for _, data in records))
    assert len(found) == len(records) > 100
    assert not +decoder.dropped


def test_text_of_ardupilots_boot_between_the_frames_is_stepped_over() -> None:
    """ARDUPILOT.md: plain text of the boot stands between the first frames."""
    path: Path = shared_data("autopilots", "ardupilot", "handshake.boot_raw.jsonl")
    datagrams = [bytes.fromhex(json.loads(line)["hex"]) for line in path.read_text().splitlines()]
    assert any(b"Init ArduCopter" in data for data in datagrams)
    decoder = Decoder()
    found = [f for data in datagrams for f in decoder.receive(data)]
    assert sum(f.msg_id == wire.HEARTBEAT for f in found) >= 3
    assert decoder.dropped["garbage_bytes"] > 20
    assert decoder.dropped["bad_checksum"] == 0
