"""Reads the recorded exchanges: what real autopilots and their simulators said to each other."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from tests.shared_data import shared_data

TLOG_TIME = struct.Struct(">Q")
HEADER, CRC, SIGNATURE = 10, 2, 13


def tlog_frames(*parts: str) -> Iterator[tuple[int, bytes]]:
    """Time in microseconds and whole frame, each."""
    data = shared_data(*parts).read_bytes()
    at = 0
    while at < len(data):
        (t_us,) = TLOG_TIME.unpack_from(data, at)
        at += TLOG_TIME.size
        length = HEADER + data[at + 1] + CRC + (SIGNATURE if data[at + 2] & 1 else 0)
        yield t_us, data[at : at + length]
        at += length


def decode(frame: bytes) -> Any:
    """The message in a frame."""
    (message,) = mavlink.MAVLink(None).parse_buffer(frame)
    return message


@dataclass(frozen=True)
class Datagram:
    t_ns: int
    is_from_fc: bool
    data: bytes


def json_physics(part: str) -> list[Datagram]:
    """part: start, armed or stall."""
    path = shared_data("autopilots", "ardupilot", f"json_physics.{part}.jsonl")
    rows = (json.loads(line) for line in path.read_text(encoding="ascii").splitlines())
    return [Datagram(r["t_ns"], r["from"] == "fc", bytes.fromhex(r["hex"])) for r in rows]
