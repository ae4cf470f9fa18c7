"""Bytes to MAVLink frames and back, sans-IO. Whatever comes in, nothing is raised: what is no frame is counted."""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

from fastcrc import crc16

from companion.mavlink import wire

_MAGIC_1 = 0xFE
_MAGIC_2 = 0xFD
_FLAG_SIGNED = 0x01
_SIGNATURE_LENGTH = 13


def crc(data: bytes) -> int:
    """CRC-16/MCRF4XX, MAVLink's checksum."""
    return crc16.mcrf4xx(data)


class Frame(NamedTuple):
    """One whole frame whose checksum is right. signature: 13 bytes (link, time, hash), empty when unsigned.
    signed_part: what the hash covers, from the magic to the end of the checksum."""

    msg_id: int
    system: int
    component: int
    sequence: int
    payload: bytes
    version: int
    signed_part: bytes
    signature: bytes


class Decoder:
    """Finds frames in a stream of bytes: steps over plain text and damage, and takes up again at the next frame."""

    def __init__(self, dropped: Counter[str] | None = None) -> None:
        self._buffer = b""
        self.dropped: Counter[str] = Counter() if dropped is None else dropped

    def receive(self, data: bytes) -> list[Frame]:
        """All frames that are complete by now. A cut frame waits for its rest."""
        buffer = self._buffer + data if self._buffer else data
        frames: list[Frame] = []
        at = 0
        while at < len(buffer):
            start = _next_magic(buffer, at)
            if start != at:
                self.dropped["garbage_bytes"] += start - at
                at = start
            size = _frame_size(buffer, at)
            if size is None or at + size > len(buffer):
                break
            frame, reason = _parse(buffer, at, size)
            if frame is not None:
                frames.append(frame)
                at += size
            else:
                self.dropped[reason] += 1
                at += 1  # its length cannot be believed either: a good frame may lie within
        self._buffer = buffer[at:]
        return frames


def _next_magic(buffer: bytes, at: int) -> int:
    if buffer[at] == _MAGIC_2:
        return at  # nearly always
    two = buffer.find(_MAGIC_2, at)
    one = buffer.find(_MAGIC_1, at, two if two >= 0 else len(buffer))
    if one >= 0:
        return one
    return two if two >= 0 else len(buffer)


def _frame_size(buffer: bytes, at: int) -> int | None:
    """Length of the frame that begins here; None while its header is not complete."""
    if at + 3 > len(buffer):
        return None
    if buffer[at] == _MAGIC_1:
        return 8 + buffer[at + 1]
    signed = _SIGNATURE_LENGTH if buffer[at + 2] & _FLAG_SIGNED else 0
    return 12 + buffer[at + 1] + signed


def _parse(buffer: bytes, at: int, size: int) -> tuple[Frame | None, str]:
    """The frame, or why it is none."""
    if buffer[at] == _MAGIC_1:
        header, msg_id, flags = 6, buffer[at + 5], 0
        sequence, system, component = buffer[at + 2 : at + 5]
        version = 1
    else:
        header, flags = 10, buffer[at + 2]
        msg_id = int.from_bytes(buffer[at + 7 : at + 10], "little")
        sequence, system, component = buffer[at + 4 : at + 7]
        version = 2
    if flags & ~_FLAG_SIGNED:
        return None, "incompatible_flags"  # MAVLink serialisation: a frame with flags not understood must be dropped
    extra = wire.CRC_EXTRA.get(msg_id)
    if extra is None:
        return None, "unknown_id"
    end = at + header + buffer[at + 1]
    if crc(buffer[at + 1 : end] + bytes((extra,))) != buffer[end] | buffer[end + 1] << 8:
        return None, "bad_checksum"
    payload = buffer[at + header : end]
    return Frame(
        msg_id, system, component, sequence, payload, version, buffer[at : end + 2], buffer[end + 2 : at + size]
    ), ""


def encode(
    msg_id: int, payload: bytes, *, system: int, component: int, sequence: int, is_signed: bool = False
) -> bytes:
    """A MAVLink 2 frame up to and with its checksum; trailing zeros of the payload are cut, as the standard wants."""
    payload = payload.rstrip(b"\0") or b"\0"
    body = bytes((len(payload), is_signed, 0, sequence, system, component)) + msg_id.to_bytes(3, "little") + payload
    check = crc(body + bytes((wire.CRC_EXTRA[msg_id],)))
    return b"\xfd" + body + check.to_bytes(2, "little")
