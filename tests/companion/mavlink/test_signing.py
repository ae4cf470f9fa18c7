"""Signing: the hash first, then the time; a refused frame changes nothing. pymavlink is the other end."""

from __future__ import annotations

import hashlib
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as m

from companion.config import MavlinkConfig
from companion.mavlink.codec import Decoder, Frame
from companion.mavlink.session import MavlinkSession
from companion.mavlink.signing import Signer
from companion.messages import Event
from tests.companion.mavlink.peer import SECOND, heartbeat

KEY = bytes(range(32))
NOW = 100 * SECOND
STAMP = 500_000_000_000


def other_end(timestamp: int = STAMP, key: bytes = KEY) -> Any:
    mav = m.MAVLink(None, srcSystem=1, srcComponent=1)
    mav.signing.secret_key = key
    mav.signing.sign_outgoing = True
    mav.signing.timestamp = timestamp
    return mav


def signed(mav: Any) -> Frame:
    (frame,) = Decoder().receive(bytes(heartbeat().pack(mav)))
    return frame


def signer(timestamp: int = STAMP) -> Signer:
    return Signer(key=KEY, timestamp=timestamp)


def test_pymavlinks_signature_is_accepted() -> None:
    assert signer().refusal(signed(other_end(STAMP + 2_000_000)), NOW) is None


def test_our_signature_is_accepted_by_pymavlink() -> None:
    session = MavlinkSession(MavlinkConfig(), signer=signer())
    session.poll(NOW)
    reader = other_end()
    reader.signing.allow_unsigned_callback = None
    messages = reader.parse_buffer(b"".join(session.data_to_send()))
    assert [message.get_type() for message in messages] == ["HEARTBEAT", "HEARTBEAT"]
    assert all(message.get_signed() for message in messages)


def test_one_forged_packet_with_a_high_time_does_not_lock_the_link() -> None:
    """AUTOPILOTS.md: pymavlink stores the time before it checks the hash; here the hash comes first."""
    ours = signer()
    genuine = other_end(STAMP + 2_000_000)
    assert ours.refusal(signed(genuine), NOW) is None
    before = (ours.timestamp, dict(ours._streams))
    assert ours.refusal(signed(other_end((1 << 48) - 2, key=b"x" * 32)), NOW + 1) == "bad_signature"
    assert (ours.timestamp, dict(ours._streams)) == before
    assert ours.refusal(signed(genuine), NOW + 2) is None


def test_the_same_frame_again_is_refused() -> None:
    """FAULTS 16: replayed: refused without side effect."""
    ours, frame = signer(), signed(other_end(STAMP + 2_000_000))
    assert ours.refusal(frame, NOW) is None
    before = ours.timestamp
    assert ours.refusal(frame, NOW + 1) == "replayed"
    assert ours.timestamp == before


def test_a_new_stream_older_than_a_minute_is_refused() -> None:
    assert signer().refusal(signed(other_end(STAMP - 7_000_000)), NOW) == "replayed"


def test_a_leap_far_ahead_on_a_living_link_is_refused() -> None:
    """FAULTS 16: future-stamped: refused without side effect, and the genuine stream goes on."""
    ours = signer()
    assert ours.refusal(signed(other_end(STAMP + 2_000_000)), NOW) is None
    assert ours.refusal(signed(other_end(STAMP + 100_000_000)), NOW + SECOND) == "future_stamped"
    assert ours.refusal(signed(other_end(STAMP + 2_200_000)), NOW + SECOND) is None


def test_mavlink_1_is_refused_while_signing_is_on() -> None:
    """AUTOPILOTS.md: refuse MAVLink 1 frames when signing is on."""
    data = heartbeat().pack(m.MAVLink(None, srcSystem=1, srcComponent=1), force_mavlink1=True)
    (frame,) = Decoder().receive(bytes(data))
    assert signer().refusal(frame, NOW) == "mavlink1_while_signing"


def test_an_unsigned_frame_is_refused_and_told_as_security_event() -> None:
    """FAULTS 15: spoofed sender: refused; security event."""
    session = MavlinkSession(MavlinkConfig(), signer=signer())
    out = session.receive(bytes(heartbeat().pack(m.MAVLink(None, srcSystem=1, srcComponent=1))), NOW)
    assert [message.name for message in out if isinstance(message, Event)] == ["security"]
    assert session.autopilot is None
    assert session.counts["refused.unsigned"] == 1


def test_our_times_never_go_back_over_a_restart_without_a_clock() -> None:
    """AUTOPILOTS.md: timestamps must never go back: persist them (a companion has no clock at boot)."""
    kept: list[int] = []
    first = Signer(key=KEY, timestamp=STAMP, save=kept.append)
    used = 0
    for second in range(120):
        data = first.sign(b"frame", NOW + second * SECOND)
        stamp = int.from_bytes(data[-12:-6], "little")
        assert stamp > used
        used = stamp
    again = Signer(key=KEY, timestamp=kept[-1], save=kept.append)
    data = again.sign(b"frame", 0)
    assert int.from_bytes(data[-12:-6], "little") > used
    assert len(kept) < 60, "a save for each frame would wear the disk out"


def test_the_hash_covers_key_frame_link_and_time() -> None:
    data = signer().sign(b"frame", NOW)
    assert data[-6:] == hashlib.sha256(KEY + data[:-6]).digest()[:6]


def test_a_key_of_wrong_length_is_refused() -> None:
    with pytest.raises(ValueError, match="32 bytes, got 5"):
        Signer(key=b"short", timestamp=0)
