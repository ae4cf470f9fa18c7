"""MCAP, written: bytes out, no file. Made for recordings that are cut at any moment.

Other than the library's writer it repeats the channels in every chunk, so that a chunk can be read though an earlier
one is broken; it never holds more than one chunk; and a message costs 2 us here, not 15.
Format: https://mcap.dev/spec
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import zstandard

MAGIC = b"\x89MCAP0\r\n"
CHUNK_BYTES = 64 << 10  # with 64 KiB a kill lost 0.3 % of a recording, with 1 MiB 7 % (measured, AUTOPILOTS.md)
ZSTD_LEVEL = 1

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(9, 16)

_MESSAGE_HEAD = struct.Struct("<BQHIQQ")
_MESSAGE_FIXED = 22


@dataclass(frozen=True, slots=True)
class Schema:
    id: int
    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Channel:
    """schema_id 0: none."""

    id: int
    schema_id: int
    topic: str
    encoding: str
    metadata: Mapping[str, str] = field(default_factory=dict)


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def text(value: str) -> bytes:
    raw = value.encode()
    return struct.pack("<I", len(raw)) + raw


def text_map(values: Mapping[str, str]) -> bytes:
    raw = b"".join(text(k) + text(v) for k, v in values.items())
    return struct.pack("<I", len(raw)) + raw


def schema_record(schema: Schema) -> bytes:
    head = struct.pack("<H", schema.id) + text(schema.name) + text(schema.encoding)
    return record(SCHEMA, head + struct.pack("<I", len(schema.data)) + schema.data)


def channel_record(channel: Channel) -> bytes:
    head = struct.pack("<HH", channel.id, channel.schema_id)
    return record(CHANNEL, head + text(channel.topic) + text(channel.encoding) + text_map(channel.metadata))


class McapWriter:
    """Turns messages into an MCAP file, a chunk at a time, through `sink`. The same calls give the same bytes."""

    def __init__(self, sink: Callable[[bytes], object], *, chunk_bytes: int = CHUNK_BYTES):
        self._sink = sink
        self._chunk_limit = chunk_bytes
        self._offset = 0
        self._schemas: dict[int, bytes] = {}
        self._channels: dict[int, bytes] = {}
        self._counts: dict[int, int] = {}
        self._parts: list[bytes] = []
        self._size = 0
        self._index: dict[int, list[int]] = {}
        self._start_ns = self._end_ns = 0
        self._first_ns: int | None = None
        self._last_ns = 0
        self._chunk_indexes: list[bytes] = []
        self._attachment_indexes: list[bytes] = []
        self._metadata_indexes: list[bytes] = []
        self._compressor = zstandard.ZstdCompressor(level=ZSTD_LEVEL)
        self._emit(MAGIC + record(HEADER, text("") + text("stockpilot")))

    @property
    def pending_bytes(self) -> int:
        """What a cut would lose now."""
        return self._size

    @property
    def messages(self) -> int:
        return sum(self._counts.values())

    def add_schema(self, schema: Schema) -> None:
        self._schemas[schema.id] = schema_record(schema)
        self._emit(self._schemas[schema.id])

    def add_channel(self, channel: Channel) -> None:
        self._channels[channel.id] = channel_record(channel)
        self._emit(self._channels[channel.id])

    def add_message(self, channel_id: int, t_ns: int, data: bytes, *, publish_ns: int | None = None) -> None:
        """t_ns orders the file; publish_ns (the same unless given) is the time within the message."""
        count = self._counts.get(channel_id, 0)
        self._counts[channel_id] = count + 1
        length = _MESSAGE_FIXED + len(data)
        if not self._parts:
            self._start_ns = self._end_ns = t_ns
        elif t_ns > self._end_ns:
            self._end_ns = t_ns
        elif t_ns < self._start_ns:
            self._start_ns = t_ns
        index = self._index.get(channel_id)
        if index is None:
            index = self._index[channel_id] = []
        index += (t_ns, self._size)
        published = t_ns if publish_ns is None else publish_ns
        self._parts += (_MESSAGE_HEAD.pack(MESSAGE, length, channel_id, count & 0xFFFFFFFF, t_ns, published), data)
        self._size += 9 + length
        if self._size >= self._chunk_limit:
            self.flush()

    def add_attachment(self, name: str, media_type: str, data: bytes, t_ns: int) -> None:
        self.flush()
        body = struct.pack("<QQ", t_ns, t_ns) + text(name) + text(media_type) + struct.pack("<Q", len(data)) + data
        whole = record(ATTACHMENT, body + struct.pack("<I", zlib.crc32(body)))
        index = struct.pack("<QQQQQ", self._offset, len(whole), t_ns, t_ns, len(data)) + text(name) + text(media_type)
        self._attachment_indexes.append(record(ATTACHMENT_INDEX, index))
        self._emit(whole)

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        self.flush()
        whole = record(METADATA, text(name) + text_map(values))
        index = struct.pack("<QQ", self._offset, len(whole)) + text(name)
        self._metadata_indexes.append(record(METADATA_INDEX, index))
        self._emit(whole)

    def flush(self) -> None:
        """Close the chunk: all messages so far are then in the sink."""
        if not self._parts:
            return
        used = sorted(self._index)
        prefix = b"".join(self._channels[channel_id] for channel_id in used)
        body = prefix + b"".join(self._parts)
        packed = self._compressor.compress(body)
        head = struct.pack("<QQQI", self._start_ns, self._end_ns, len(body), zlib.crc32(body))
        chunk = record(CHUNK, head + text("zstd") + struct.pack("<Q", len(packed)) + packed)
        chunk_at = self._offset
        indexes, places = self._message_indexes(used, len(prefix), chunk_at + len(chunk))
        self._chunk_indexes.append(
            record(
                CHUNK_INDEX,
                struct.pack("<QQQQ", self._start_ns, self._end_ns, chunk_at, len(chunk))
                + struct.pack("<I", len(places)) + places + struct.pack("<Q", len(indexes))
                + text("zstd") + struct.pack("<QQ", len(packed), len(body)),
            )
        )  # fmt: skip
        self._first_ns = self._start_ns if self._first_ns is None else min(self._first_ns, self._start_ns)
        self._last_ns = max(self._last_ns, self._end_ns)
        self._parts, self._size, self._index = [], 0, {}
        self._emit(chunk + indexes)

    def finish(self) -> None:
        """Close the file: data end, summary, footer."""
        self.flush()
        self._emit(record(DATA_END, struct.pack("<I", 0)))
        groups = [
            (SCHEMA, list(self._schemas.values())),
            (CHANNEL, list(self._channels.values())),
            (STATISTICS, [self._statistics()]),
            (CHUNK_INDEX, self._chunk_indexes),
            (ATTACHMENT_INDEX, self._attachment_indexes),
            (METADATA_INDEX, self._metadata_indexes),
        ]
        start = self._offset
        summary, offsets = b"", b""
        for opcode, records in groups:
            joined = b"".join(records)
            if joined:
                where = struct.pack("<BQQ", opcode, start + len(summary), len(joined))
                offsets += record(SUMMARY_OFFSET, where)
                summary += joined
        footer_head = struct.pack("<BQQQ", FOOTER, 20, start, start + len(summary))
        crc = zlib.crc32(footer_head, zlib.crc32(summary + offsets))
        self._emit(summary + offsets + footer_head + struct.pack("<I", crc) + MAGIC)

    def _message_indexes(self, used: list[int], shift: int, at: int) -> tuple[bytes, bytes]:
        """The chunk's message index records, and where each begins, by channel."""
        records, places = b"", b""
        for channel_id in used:
            pairs = self._index[channel_id]
            pairs[1::2] = [offset + shift for offset in pairs[1::2]]
            places += struct.pack("<HQ", channel_id, at + len(records))
            body = struct.pack("<HI", channel_id, 8 * len(pairs)) + struct.pack(f"<{len(pairs)}Q", *pairs)
            records += record(MESSAGE_INDEX, body)
        return records, places

    def _statistics(self) -> bytes:
        counts = b"".join(struct.pack("<HQ", k, n) for k, n in sorted(self._counts.items()))
        return record(
            STATISTICS,
            struct.pack(
                "<QHIIIIQQ", self.messages, len(self._schemas), len(self._channels), len(self._attachment_indexes),
                len(self._metadata_indexes), len(self._chunk_indexes), self._first_ns or 0, self._last_ns,
            )
            + struct.pack("<I", len(counts)) + counts,
        )  # fmt: skip

    def _emit(self, data: bytes) -> None:
        self._offset += len(data)
        self._sink(data)
