"""Faults made of a recording: scans lost, stamps late, packets swapped, without a simulator.

An edit is a dict with one verb and its values; times are seconds from the first LiDAR packet.
"""

from __future__ import annotations

import dataclasses
import struct
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from companion.errors import FileFormatError
from companion.lidar.ouster import OusterDecoder
from companion.recording.run_files import Input
from companion.recording.tlog import split_frames

Edit = Callable[[list[Input], "EditContext"], list[Input]]


@dataclasses.dataclass(frozen=True, slots=True)
class EditContext:
    """start_ns: time of the first LiDAR packet. values: the edit's own."""

    start_ns: int
    values: dict[str, Any]

    def seconds(self, item: Input) -> float:
        return (item.t_ns - self.start_ns) * 1e-9

    def is_within(self, item: Input) -> bool:
        since, until = float(self.values.get("from_s", 0.0)), float(self.values.get("to_s", 1e9))
        return since <= self.seconds(item) < until


def edit_inputs(inputs: Sequence[Input], edits: Iterable[dict[str, Any]]) -> list[Input]:
    """The inputs after all edits, in their order. Raises: FileFormatError: an edit is not known."""
    edited = list(inputs)
    start_ns = next((i.t_ns for i in edited if i.kind == "lidar"), 0)
    for values in edits:
        verb = str(values.get("edit"))
        if verb not in _EDITS:
            raise FileFormatError(f"edit {verb!r} is none of {', '.join(_EDITS)}")
        edited = _EDITS[verb](edited, EditContext(start_ns, values))
    return edited


def _lose(inputs: list[Input], at: EditContext) -> list[Input]:
    """Nothing of that kind arrives; of `every`, only each n-th is lost."""
    kind, every = str(at.values["kind"]), int(at.values.get("every", 1))
    kept, n = [], 0
    for item in inputs:
        if item.kind == kind and at.is_within(item):
            n += 1
            if n % every == 0:
                continue
        kept.append(item)
    return kept


def _delay(inputs: list[Input], at: EditContext) -> list[Input]:
    """Everything of that kind arrives by_s later."""
    kind, by_ns = str(at.values["kind"]), round(float(at.values["by_s"]) * 1e9)
    moved = [
        item._replace(t_ns=item.t_ns + by_ns) if item.kind == kind and at.is_within(item) else item for item in inputs
    ]
    return sorted(moved, key=lambda item: item.t_ns)


def _swap(inputs: list[Input], at: EditContext) -> list[Input]:
    """Each two following packets of that kind arrive in the other order."""
    kind = str(at.values["kind"])
    places = [n for n, item in enumerate(inputs) if item.kind == kind and at.is_within(item)]
    swapped = list(inputs)
    for a, b in zip(places[::2], places[1::2], strict=False):
        swapped[a], swapped[b] = inputs[b]._replace(t_ns=inputs[a].t_ns), inputs[a]._replace(t_ns=inputs[b].t_ns)
    return swapped


def _repeat(inputs: list[Input], at: EditContext) -> list[Input]:
    """Every packet of that kind arrives twice."""
    kind = str(at.values["kind"])
    return [copy for item in inputs for copy in ((item, item) if item.kind == kind and at.is_within(item) else (item,))]


def _freeze(inputs: list[Input], at: EditContext) -> list[Input]:
    """The LiDAR sends the last turn before from_s again and again, with frame numbers and stamps that go on."""
    frozen: dict[int, bytes] = {}
    out = []
    for item in inputs:
        if item.kind == "lidar":
            (column,) = struct.unpack_from("<H", item.data, 40)
            if at.is_within(item) and column in frozen:
                item = item._replace(data=_with_pixels_of(item.data, frozen[column]))
            else:
                frozen[column] = item.data
        out.append(item)
    return out


def _with_pixels_of(packet: bytes, other: bytes) -> bytes:
    """packet's headers with other's measurements (profile RNG19_RFL8_SIG16_NIR16), without checksum."""
    size = (len(packet) - 64) // 16
    mixed = bytearray(packet)
    for n in range(16):
        start = 32 + n * size + 12
        mixed[start : start + size - 12] = other[start : start + size - 12]
    mixed[-8:] = bytes(8)
    return bytes(mixed)


def _short_sight(inputs: list[Input], at: EditContext) -> list[Input]:
    """Nothing comes back to the LiDAR from farther than max_m."""
    limit_mm = round(float(at.values["max_m"]) * 1000)
    return [
        item._replace(data=_without_far(item.data, limit_mm)) if item.kind == "lidar" and at.is_within(item) else item
        for item in inputs
    ]


def _without_far(packet: bytes, limit_mm: int) -> bytes:
    """A packet of profile RNG19_RFL8_SIG16_NIR16 whose far ranges are 0, without checksum."""
    size = (len(packet) - 64) // 16
    words = np.frombuffer(packet, dtype=np.uint8)[32:-32].reshape(16, size).copy()
    pixels = words[:, 12:].copy().view("<u4").reshape(16, -1, 3)
    pixels[..., 0] = np.where(
        (pixels[..., 0] & 0x7FFFF) > limit_mm, pixels[..., 0] & ~np.uint32(0x7FFFF), pixels[..., 0]
    )
    words[:, 12:] = pixels.reshape(16, -1).view(np.uint8)
    return packet[:32] + words.tobytes() + packet[-32:-8] + bytes(8)


def _flip(inputs: list[Input], at: EditContext) -> list[Input]:
    """One bit of every n-th packet of that kind is wrong."""
    kind, every = str(at.values["kind"]), int(at.values.get("every", 10))
    rng = np.random.default_rng(0)
    out, n = [], 0
    for item in inputs:
        if item.kind == kind and at.is_within(item):
            n += 1
            if n % every == 0:
                broken = bytearray(item.data)
                broken[int(rng.integers(len(broken)))] ^= 1 << int(rng.integers(8))
                item = item._replace(data=bytes(broken))
        out.append(item)
    return out


def _not_a_number(inputs: list[Input], at: EditContext) -> list[Input]:
    """Every n-th attitude of the flight controller is NaN, soundly framed."""
    from pymavlink.dialects.v20 import common

    every = int(at.values.get("every", 2))
    parser = common.MAVLink(None)
    out, n = [], 0
    for item in inputs:
        if item.kind == "mavlink" and at.is_within(item) and not _ATTITUDES.isdisjoint(message_ids(item.data)):
            n += 1
            if n % every == 0:
                item = item._replace(data=b"".join(_with_nan(common, parser, f) for f in split_frames(item.data)))
        out.append(item)
    return out


_ATTITUDES = {30, 31}  # ATTITUDE, ATTITUDE_QUATERNION


def _with_nan(common: Any, parser: Any, frame: bytes) -> bytes:
    for message in parser.parse_buffer(frame) or []:
        if message.get_msgId() in _ATTITUDES:
            setattr(message, "q1" if message.get_msgId() == 31 else "roll", float("nan"))
            sender = common.MAVLink(None, message.get_srcSystem(), message.get_srcComponent())
            sender.seq = message.get_seq()
            return bytes(message.pack(sender))
    return frame


def _restart(inputs: list[Input], at: EditContext) -> list[Input]:
    """The flight controller is silent for silent_s from from_s, and then says again what it said from the first byte."""
    begin_ns = at.start_ns + round(float(at.values["from_s"]) * 1e9)
    resume_ns = begin_ns + round(float(at.values.get("silent_s", 3.0)) * 1e9)
    said = [item for item in inputs if item.kind == "mavlink"]
    before = [item for item in inputs if item.kind != "mavlink" or item.t_ns < begin_ns]
    if not said:
        return before
    end_ns = inputs[-1].t_ns
    shift_ns = resume_ns - said[0].t_ns
    again = [i._replace(t_ns=i.t_ns + shift_ns) for i in said if i.t_ns + shift_ns <= end_ns]
    return sorted([*before, *again], key=lambda item: item.t_ns)


_EDITS: dict[str, Edit] = {
    "lose": _lose, "delay": _delay, "swap": _swap, "repeat": _repeat, "freeze": _freeze, "flip": _flip, "nan": _not_a_number,
    "short_sight": _short_sight,
    "restart": _restart,
}  # fmt: skip


def rebuild_scans(inputs: list[Input], metadata_json: str) -> list[Input]:
    """The begin and accept of each scan where the edited packets complete one, as the lockstep runner would call them."""
    decoder = OusterDecoder(metadata_json)
    out: list[Input] = []
    for item in inputs:
        if item.kind in ("begin", "accept"):
            continue
        out.append(item)
        if item.kind == "lidar":
            for _ in decoder.receive(item.data, item.t_ns, item.source):
                out += [Input("begin", item.t_ns, b""), Input("accept", item.t_ns, b"")]
    return out


def message_ids(data: bytes) -> list[int]:
    """The MAVLink message ids of a datagram."""
    return [int.from_bytes(f[7:10], "little") if f[0] == 0xFD else f[5] for f in split_frames(data)]
