"""Which channel of a recording carries what. The numbers never change: a recording is read by them for years.

Raw bytes are wrapped as a ROS 1 message (host, port, data), so that viewers open them without a plug-in.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from companion import topics
from companion.recording import foxglove
from companion.recording.mcap_write import Channel, Schema

_RAW_SCHEMA = Schema(1, "stockpilot/Datagram", "ros1msg", b"string host\nuint16 port\nuint8[] data\n")
_FOXGLOVE_FIRST = 2
_LENGTH = struct.Struct("<I")
_NO_SOURCE = b"\0\0\0\0\0\0"  # host "", port 0

INPUTS = (
    "lidar",
    "mavlink",
    "poll",
    "accept",
    "operator",
    "begin",
    "told",
)  # what goes into the flight core, in the order it went
INPUT_IDS = {kind: n + 1 for n, kind in enumerate(INPUTS)}
OUTPUT_ID = 8
POSE_ID, TRANSFORMS_ID, POINTS_ID, LOG_ID = 10, 11, 12, 13
TOPIC_IDS = {topic.name: 20 + n for n, topic in enumerate(topics.TOPICS)}
INPUT_PREFIX = "in/"
OUTPUT_TOPIC = "out/mavlink"


class Raw(NamedTuple):
    """data as it crossed. source: who sent it, where that is known."""

    data: bytes
    source: tuple[str, int] | None


def all_schemas() -> list[Schema]:
    return [_RAW_SCHEMA, *foxglove.schemas(_FOXGLOVE_FIRST)]


def all_channels() -> list[Channel]:
    raw = [Channel(n, 1, INPUT_PREFIX + kind, "ros1") for kind, n in INPUT_IDS.items()]
    raw.append(Channel(OUTPUT_ID, 1, OUTPUT_TOPIC, "ros1"))
    names = ("/pose", "/tf", "/points", "/log")
    drawn = [Channel(POSE_ID + n, _FOXGLOVE_FIRST + n, name, "json") for n, name in enumerate(names)]
    told = [
        Channel(TOPIC_IDS[t.name], 0, t.name, "json", {"message": t.message.__name__})
        for t in topics.TOPICS
        if t.recorded
    ]
    return raw + drawn + told


def pack_raw(data: bytes, source: tuple[str, int] | None) -> bytes:
    if source is None:
        return _NO_SOURCE + _LENGTH.pack(len(data)) + data
    host = source[0].encode()
    return struct.pack(f"<I{len(host)}sHI", len(host), host, source[1] & 0xFFFF, len(data)) + data


def unpack_raw(payload: bytes) -> Raw:
    """Raises: struct.error, UnicodeDecodeError: not a wrapped datagram."""
    if payload.startswith(_NO_SOURCE):
        (length,) = _LENGTH.unpack_from(payload, len(_NO_SOURCE))
        at = len(_NO_SOURCE) + _LENGTH.size
        return Raw(payload[at : at + length], None)
    (host_length,) = _LENGTH.unpack_from(payload)
    host, port, length = struct.unpack_from(f"<{host_length}sHI", payload, 4)
    at = 4 + host_length + 6
    return Raw(payload[at : at + length], (host.decode(), port) if host_length else None)
