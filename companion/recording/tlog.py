"""MAVLink frames as a `.tlog`, which QGroundControl and MAVExplorer open: before each frame its time, us since 1970."""

from __future__ import annotations

import struct
from collections.abc import Iterator

_MARKERS = {0xFD: 12, 0xFE: 8}  # MAVLink 2 and 1: bytes of a frame around its payload
_SIGNATURE_BYTES = 13
_SIGNED = 0x01  # incompat_flags


def split_frames(data: bytes) -> Iterator[bytes]:
    """The MAVLink frames of a datagram; bytes between them are left out, checksums are not looked at."""
    at = 0
    while at < len(data):
        around = _MARKERS.get(data[at])
        if around is None:
            at += 1
            continue
        if at + 3 > len(data):
            return
        length = data[at + 1] + around
        if data[at] == 0xFD and data[at + 2] & _SIGNED:
            length += _SIGNATURE_BYTES
        if at + length > len(data):
            return
        yield data[at : at + length]
        at += length


def tlog_records(data: bytes, wall_ns: int) -> bytes:
    """What to append to a tlog for a datagram that came or left at that wall time."""
    stamp = struct.pack(">Q", wall_ns // 1000)
    return b"".join(stamp + frame for frame in split_frames(data))


def read_tlog(data: bytes) -> Iterator[tuple[int, bytes]]:
    """(us since 1970, frame) of each entry; ends where the file is cut or is no tlog."""
    at = 0
    while at + 10 <= len(data):
        (t_us,) = struct.unpack_from(">Q", data, at)
        frame = next(split_frames(data[at + 8 : at + 8 + 280 + _SIGNATURE_BYTES]), None)
        if data[at + 8] not in _MARKERS or frame is None:
            return
        yield t_us, frame
        at += 8 + len(frame)
