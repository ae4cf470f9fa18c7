"""MCAP, read from the front, whole or broken: what can be read is read, what is lost is told.

Never needs the summary at the end. Damage is found by framing and by each chunk's checksum; the search then goes on
at the next place that looks like a record. Format: https://mcap.dev/spec
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import lz4.frame  # type: ignore[import-untyped, unused-ignore]
import zstandard

from companion.errors import FileFormatError
from companion.recording import mcap_write as op
from companion.recording.mcap_write import MAGIC, Channel, Schema

MAX_RECORD = 1 << 32
MAX_CHUNK = 256 << 20
_RECORD_HEAD = struct.Struct("<BQ")
_MESSAGE_FIXED = struct.Struct("<HIQQ")
_MESSAGE_START = struct.Struct("<BQHIQQ")  # both of them
_CHUNK_FIXED = struct.Struct("<QQQI")
_COMPRESSIONS = ("", "lz4", "zstd")


class Message(NamedTuple):
    channel: Channel
    sequence: int
    t_ns: int
    publish_ns: int
    data: bytes


class Attachment(NamedTuple):
    name: str
    media_type: str
    t_ns: int
    data: bytes


class Metadata(NamedTuple):
    name: str
    values: Mapping[str, str]


Item = Message | Attachment | Metadata | Schema | Channel


@dataclass(frozen=True, slots=True)
class Damage:
    """offset: where in the file. bytes_lost: how much of it could not be read."""

    offset: int
    bytes_lost: int
    what: str


@dataclass(slots=True)
class McapScan:
    """Iterate over it for the items in file order; then `damage` tells what was lost, `is_whole` whether nothing was.

    `schemas` and `channels` by id; a message of a channel that is not known is counted in `orphans`.
    """

    data: bytes | mmap.mmap
    schemas: dict[int, Schema] = field(init=False, default_factory=dict)
    channels: dict[int, Channel] = field(init=False, default_factory=dict)
    damage: list[Damage] = field(init=False, default_factory=list)
    orphans: int = field(init=False, default=0)
    is_finished: bool = field(init=False, default=False)  # data end, footer and closing magic are there
    _has_data_end: bool = field(init=False, default=False)
    _bodies: dict[tuple[int, bytes], bytes] = field(init=False, default_factory=dict)  # of schemas and channels

    @property
    def is_whole(self) -> bool:
        return self.is_finished and not self.damage and not self.orphans

    def __iter__(self) -> Iterator[Item]:
        end = len(self.data)
        if end == 0:
            return
        at = len(MAGIC)
        if self.data[:at] != MAGIC:
            at = self._resync(0, "the opening magic is not MCAP's")
        while at < end:
            if end - at == len(MAGIC) and self.data[at:end] == MAGIC:
                return
            head = self._head(at)
            if head is None:
                at = self._resync(at, "no record begins here" if end - at > 9 else "the file is cut here")
                continue
            opcode, start, stop = head
            if not self._follows(stop):
                if opcode == op.CHUNK:
                    yield from self._cut_chunk(start, end)
                at = self._resync(at, f"the {_name(opcode)} record is cut or its length is wrong")
                continue
            try:
                yield from self._record(opcode, start, stop)
            except (struct.error, UnicodeDecodeError, ValueError, RuntimeError, zstandard.ZstdError) as error:
                self.damage.append(Damage(at, stop - at, f"{_name(opcode)} record: {error}"))
            at = stop

    def _head(self, at: int) -> tuple[int, int, int] | None:
        """(opcode, start and end of the body) of the record at `at`; None if none can be there."""
        if at + 9 > len(self.data):
            return None
        opcode, length = _RECORD_HEAD.unpack_from(self.data, at)
        if not 1 <= opcode <= op.DATA_END or length > MAX_RECORD:
            return None
        return opcode, at + 9, at + 9 + length

    def _follows(self, stop: int) -> bool:
        """Whether what comes after a record may be one: else the record's length is wrong."""
        left = len(self.data) - stop
        if left <= 0 or left == len(MAGIC):
            return left == 0 or self.data[stop:] == MAGIC
        head = self._head(stop)
        return left < 9 or (head is not None and (head[0] == op.CHUNK or head[2] <= len(self.data)))

    def _record(self, opcode: int, start: int, stop: int) -> Iterator[Item]:
        if opcode == op.CHUNK:
            yield from self._chunk(start, stop)
        elif opcode in (op.MESSAGE, op.SCHEMA, op.CHANNEL) and not self._has_data_end:
            item = self._item(opcode, bytes(self.data[start:stop]))
            if item is not None:
                yield item
        elif opcode == op.ATTACHMENT:
            yield _attachment(bytes(self.data[start:stop]))
        elif opcode == op.METADATA:
            body = _Fields(bytes(self.data[start:stop]))
            yield Metadata(body.text(), body.text_map())
        elif opcode == op.DATA_END:
            self._has_data_end = True
        elif opcode == op.FOOTER:
            self._footer(start, stop)

    def _chunk(self, start: int, stop: int) -> Iterator[Item]:
        _, _, size, crc = _CHUNK_FIXED.unpack_from(self.data, start)
        if size > MAX_CHUNK:
            raise ValueError(f"a chunk of {size} bytes is not believed")
        at = start + _CHUNK_FIXED.size
        compression, at = self._text_at(at)
        (length,) = struct.unpack_from("<Q", self.data, at)
        if at + 8 + length != stop:
            raise ValueError("lengths within the chunk disagree")
        body = _decompress(compression, bytes(self.data[at + 8 : stop]), size)
        if len(body) != size or (crc and zlib.crc32(body) != crc):
            raise ValueError("checksum is wrong: all messages of this chunk are left out")
        yield from self._items(body, is_checked=True)

    def _cut_chunk(self, start: int, end: int) -> Iterator[Item]:
        """What of a chunk's messages came before the cut. No checksum can vouch for them; their framing does."""
        try:
            at = start + _CHUNK_FIXED.size
            compression, at = self._text_at(at)
            packed = bytes(self.data[at + 8 : end])
        except (struct.error, UnicodeDecodeError):
            return
        if compression not in _COMPRESSIONS or self._next_record(start) is not None:
            return
        try:
            yield from self._items(_decompress_start(compression, packed))
        except (struct.error, UnicodeDecodeError, ValueError, RuntimeError):
            return

    def _items(self, body: bytes, *, is_checked: bool = False) -> Iterator[Item]:
        at, end = 0, len(body)
        channels, unpack, start = self.channels, _MESSAGE_START.unpack_from, _MESSAGE_START.size
        while at + 9 <= end:
            if body[at] == op.MESSAGE:
                _, length, channel_id, sequence, t_ns, publish_ns = unpack(body, at)
                stop = at + 9 + length
                if stop > end:
                    return
                channel = channels.get(channel_id)
                if channel is None:
                    self.orphans += 1
                else:
                    yield Message(channel, sequence, t_ns, publish_ns, body[at + start : stop])
            else:
                opcode, length = _RECORD_HEAD.unpack_from(body, at)
                stop = at + 9 + length
                if stop > end:
                    return
                item = self._item(opcode, body[at + 9 : stop], is_checked=is_checked)
                if item is not None:
                    yield item
            at = stop

    def _item(self, opcode: int, body: bytes, *, is_checked: bool = False) -> Item | None:
        """A schema, channel or message outside or inside a chunk; None if it was known already. A channel within a
        chunk whose checksum holds corrects one outside, where nothing guards it."""
        key = opcode, body[:2]  # its id
        if self._bodies.get(key) == body:
            return None  # every chunk tells again what the first one told
        fields = _Fields(body)
        if opcode == op.SCHEMA:
            schema = Schema(fields.number("<H"), fields.text(), fields.text(), fields.blob("<I"))
            is_new = schema.id not in self.schemas
            self.schemas[schema.id], self._bodies[key] = schema, body
            return schema if is_new else None
        if opcode == op.CHANNEL:
            channel_id, schema_id = fields.number("<H"), fields.number("<H")
            channel = Channel(channel_id, schema_id, fields.text(), fields.text(), fields.text_map())
            known = self.channels.get(channel_id)
            if known == channel or (known is not None and not is_checked):
                return None
            if known is not None:
                self.damage.append(Damage(0, 0, f"channel {known.topic!r} was altered: it is {channel.topic!r}"))
            self.channels[channel_id], self._bodies[key] = channel, body
            return channel
        if opcode == op.MESSAGE:
            channel_id, sequence, t_ns, publish_ns = _MESSAGE_FIXED.unpack_from(body)
            sender = self.channels.get(channel_id)
            if sender is not None:
                return Message(sender, sequence, t_ns, publish_ns, body[22:])
            self.orphans += 1
        return None

    def _footer(self, start: int, stop: int) -> None:
        summary_start, _, crc = struct.unpack_from("<QQI", self.data, start)
        closed = self.data[stop : stop + len(MAGIC)] == MAGIC and stop + len(MAGIC) == len(self.data)
        is_sound = crc == 0 or zlib.crc32(self.data[(summary_start or start - 9) : stop - 4]) == crc
        if not is_sound:
            raise ValueError("checksum of the summary is wrong")
        self.is_finished = self._has_data_end and closed

    def _resync(self, at: int, why: str) -> int:
        """Where to go on: the next place that looks like a chunk, attachment, metadata or the data's end."""
        found = self._next_record(at + 1)
        stop = len(self.data) if found is None else found
        self.damage.append(Damage(at, stop - at, why))
        return stop

    def _next_record(self, at: int) -> int | None:
        """The next chunk whose own lengths agree, or the end of the data."""
        end = len(self.data)
        places = [p for p in (self._find_chunk(at), self._find_data_end(at)) if p is not None and p < end]
        return min(places, default=None)

    def _find_chunk(self, at: int) -> int | None:
        for name in _COMPRESSIONS[1:]:
            mark = struct.pack("<I", len(name)) + name.encode()
            lead = 9 + _CHUNK_FIXED.size
            here = self.data.find(mark, at + lead)
            while here >= 0:
                start = here - lead
                if self.data[start] == op.CHUNK and self._fits(start, here + len(mark)):
                    return start
                here = self.data.find(mark, here + 1)
        return None

    def _fits(self, start: int, at: int) -> bool:
        (length,) = struct.unpack_from("<Q", self.data, start + 1)
        if at + 8 > len(self.data):
            return False
        (inner,) = struct.unpack_from("<Q", self.data, at)
        return bool(start + 9 + length == at + 8 + inner <= len(self.data))

    def _find_data_end(self, at: int) -> int | None:
        here = self.data.find(struct.pack("<BQ", op.DATA_END, 4), at)
        return here if here >= 0 else None

    def _text_at(self, at: int) -> tuple[str, int]:
        (length,) = struct.unpack_from("<I", self.data, at)
        if length > 16:
            raise ValueError("compression has no sensible name")
        return bytes(self.data[at + 4 : at + 4 + length]).decode(), at + 4 + length


def open_mcap(path: Path) -> McapScan:
    """A scan over a file, mapped and not loaded. Raises: FileFormatError: empty, or cannot be read."""
    try:
        with path.open("rb") as file:
            if path.stat().st_size == 0:
                return McapScan(b"")
            return McapScan(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read: {error.strerror}") from None


class _Fields:
    """Reads a record's fields one after the other; struct.error where it is too short."""

    def __init__(self, body: bytes) -> None:
        self._body = body
        self._at = 0

    def number(self, fmt: str) -> int:
        (value,) = struct.unpack_from(fmt, self._body, self._at)
        self._at += struct.calcsize(fmt)
        return int(value)

    def blob(self, length_fmt: str) -> bytes:
        length = self.number(length_fmt)
        if self._at + length > len(self._body):
            raise ValueError("a field is longer than its record")
        value = self._body[self._at : self._at + length]
        self._at += length
        return value

    def text(self) -> str:
        return self.blob("<I").decode()

    def text_map(self) -> dict[str, str]:
        inner = _Fields(self.blob("<I"))
        values: dict[str, str] = {}
        while inner._at < len(inner._body):
            key = inner.text()
            values[key] = inner.text()
        return values


def _attachment(body: bytes) -> Attachment:
    fields = _Fields(body)
    t_ns = fields.number("<Q")
    fields.number("<Q")
    name, media_type, data = fields.text(), fields.text(), fields.blob("<Q")
    crc = fields.number("<I")
    if crc and zlib.crc32(body[:-4]) != crc:
        raise ValueError(f"checksum of attachment {name!r} is wrong")
    return Attachment(name, media_type, t_ns, data)


def _decompress(compression: str, packed: bytes, size: int) -> bytes:
    if compression == "zstd":
        return zstandard.ZstdDecompressor().decompress(packed, max_output_size=max(size, 1))
    if compression == "lz4":
        return bytes(lz4.frame.decompress(packed))
    if compression == "":
        return packed
    raise ValueError(f"compression {compression!r} is not known")


def _decompress_start(compression: str, packed: bytes) -> bytes:
    """As much as the beginning of a compressed stream gives."""
    if compression == "zstd":
        return zstandard.ZstdDecompressor().decompressobj().decompress(packed)
    if compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed))
    return packed


def _name(opcode: int) -> str:
    names = {op.CHUNK: "chunk", op.ATTACHMENT: "attachment", op.METADATA: "metadata", op.FOOTER: "footer"}
    return names.get(opcode, f"0x{opcode:02x}")
