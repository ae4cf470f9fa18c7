"""MAVLink 2 frames to fields and back, by the tables of pymavlink's generated dialect.

The dialect's own classes take 50 us to pack an ODOMETRY and 120 us to parse one; these take a tenth of that, which is
what lets a whole flight run many times faster than real time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from struct import Struct
from typing import Any

from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import development

STX_V2, STX_V1 = 0xFD, 0xFE
SIGNED = 0x01
CRC_START = 0xFFFF


@dataclass(frozen=True, slots=True)
class Layout:
    """How one message lies on the wire. `slots`: field name to (first, count) in the unpacked tuple; count 0: scalar."""

    id: int
    name: str
    crc_extra: bytes
    struct: Struct
    slots: dict[str, tuple[int, int]]
    is_text: frozenset[str]
    is_flat: bool = False  # nothing but scalars


@dataclass(frozen=True, slots=True)
class Frame:
    """A received message. `fields`: by name; arrays as tuples, texts as str."""

    id: int
    name: str
    system: int
    component: int
    fields: dict[str, Any]


def _layout(cls: Any) -> Layout:
    slots, at, texts = {}, 0, []
    kinds = [cls.fieldtypes[cls.fieldnames.index(name)] for name in cls.ordered_fieldnames]
    for name, kind, count in zip(cls.ordered_fieldnames, kinds, cls.array_lengths, strict=True):
        if kind == "char":
            texts.append(name)
            count = 0  # one `Ns` item
        slots[name] = (at, count)
        at += max(count, 1)
    return Layout(
        cls.id,
        cls.msgname,
        bytes([cls.crc_extra]),
        cls.unpacker,
        slots,
        frozenset(texts),
        len(slots) == at and not texts,
    )


LAYOUTS: dict[int, Layout] = {msgid: _layout(cls) for msgid, cls in development.mavlink_map.items()}
BY_NAME: dict[str, Layout] = {layout.name: layout for layout in LAYOUTS.values()}


def _fields(layout: Layout, payload: bytes) -> dict[str, Any]:
    size = layout.struct.size
    if len(payload) < size:  # MAVLink 2 cuts trailing zeros
        payload = payload + bytes(size - len(payload))
    values = layout.struct.unpack_from(payload)
    if layout.is_flat:
        return dict(zip(layout.slots, values, strict=True))
    fields: dict[str, Any] = {}
    for name, (first, count) in layout.slots.items():
        value: Any = values[first : first + count] if count else values[first]
        if name in layout.is_text:
            value = value.split(b"\0", 1)[0].decode("ascii", "replace")
        fields[name] = value
    return fields


class Decoder:
    """Splits a byte stream into frames. What is not a whole, known, intact frame is skipped and counted in `bad`."""

    def __init__(self) -> None:
        self._rest = b""
        self.bad = 0

    def receive(self, data: bytes) -> Iterator[Frame]:
        """Yield the frames that `data` completes, MAVLink 1 and 2; signatures are not checked."""
        data = self._rest + data if self._rest else data
        at, end = 0, len(data)
        while at < end:
            start = data[at]
            if start not in (STX_V2, STX_V1):
                at += 1
                continue
            head = 10 if start == STX_V2 else 6
            if end - at < head:
                break
            body = at + head
            stop = body + data[at + 1]
            total = stop + 2 + (13 if start == STX_V2 and data[at + 2] & SIGNED else 0)
            if total > end:
                break
            frame = self._frame(data, at, body, stop)
            if frame is None:
                self.bad += 1
                at += 1
                continue
            yield frame
            at = total
        self._rest = data[at:]

    @staticmethod
    def _frame(data: bytes, at: int, body: int, stop: int) -> Frame | None:
        if data[at] == STX_V2:
            msgid = data[at + 7] | data[at + 8] << 8 | data[at + 9] << 16
            system, component = data[at + 5], data[at + 6]
        else:
            system, component, msgid = data[at + 3], data[at + 4], data[at + 5]
        layout = LAYOUTS.get(msgid)
        if layout is None:
            return None
        crc = mcrf4xx(data[at + 1 : stop] + layout.crc_extra, CRC_START)
        if crc != data[stop] | data[stop + 1] << 8:
            return None
        return Frame(msgid, layout.name, system, component, _fields(layout, data[body:stop]))


class Encoder:
    """Packs frames of one sender with sequence numbers without gaps."""

    def __init__(self, system: int, component: int) -> None:
        self.system = system
        self.component = component
        self._sequence = 0

    def pack(self, layout: Layout, values: Sequence[Any]) -> bytes:
        """One MAVLink 2 frame. values: in wire order (by size of type, largest first), arrays spread out."""
        payload = layout.struct.pack(*values).rstrip(b"\0") or b"\0"
        sequence = self._sequence
        self._sequence = (sequence + 1) & 0xFF
        msgid = layout.id
        head = bytes(
            (len(payload), 0, 0, sequence, self.system, self.component, msgid & 0xFF, msgid >> 8 & 0xFF, msgid >> 16)
        )
        body = head + payload
        return b"\xfd" + body + mcrf4xx(body + layout.crc_extra, CRC_START).to_bytes(2, "little")

    def pack_named(self, name: str, **fields: Any) -> bytes:
        """One frame by field names; what is left out is 0. For messages that are rarely sent."""
        layout = BY_NAME[name]
        values: list[Any] = []
        for field, (_, count) in layout.slots.items():
            if count:
                values += list(fields.pop(field, (0,) * count))
            elif field in layout.is_text:
                values.append(str(fields.pop(field, "")).encode("ascii", "replace"))
            else:
                values.append(fields.pop(field, 0))
        if fields:
            raise ValueError(f"{name} has no field {', '.join(fields)}")
        return self.pack(layout, values)
