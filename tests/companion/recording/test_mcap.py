"""MCAP that this project writes is read by the format's own library; what is cut or flipped costs little."""

from __future__ import annotations

import io
import random

import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from companion.recording.mcap_read import Attachment, McapScan, Message, Metadata
from companion.recording.mcap_write import MAGIC, McapWriter
from tests.companion.recording.samples import small_recording

WHOLE = small_recording()


def messages_of(data: bytes) -> tuple[list[Message], McapScan]:
    scan = McapScan(data)
    return [item for item in scan if isinstance(item, Message)], scan


def test_the_library_reads_what_is_written_by_its_index() -> None:
    reader = make_reader(io.BytesIO(WHOLE), validate_crcs=True)
    summary = reader.get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == 300
    assert summary.statistics.channel_message_counts == {1: 150, 2: 150}
    assert (summary.statistics.message_start_time, summary.statistics.message_end_time) == (1000, 3990)
    assert len(summary.chunk_indexes) == summary.statistics.chunk_count > 5
    read = [(c.topic, m.log_time, m.data, m.sequence) for _, c, m in reader.iter_messages()]
    assert read == [("ab"[n % 2], 1000 + n * 10, b"%d " % n * 10, n // 2) for n in range(300)]
    assert [a.data for a in reader.iter_attachments()] == [b'{"a": 1}']
    assert [(m.name, m.metadata) for m in reader.iter_metadata()] == [("run", {"mission": "small"})]
    assert len(list(reader.iter_messages(topics=["b"]))) == 150


@pytest.mark.parametrize("compression", list(CompressionType))
def test_what_the_library_writes_is_read(compression: CompressionType) -> None:
    out = io.BytesIO()
    writer = Writer(out, chunk_size=500, compression=compression)
    writer.start()
    schema = writer.register_schema("s", "jsonschema", b"{}")
    channel = writer.register_channel("topic", "json", schema)
    writer.add_attachment(1, 2, "n", "text/plain", b"data")
    writer.add_metadata("m", {"k": "v"})
    for n in range(100):
        writer.add_message(channel, n, b"%d" % n, n + 7)
    writer.finish()
    scan = McapScan(out.getvalue())
    items = list(scan)
    assert scan.is_whole
    assert [(i.t_ns, i.publish_ns, i.data) for i in items if isinstance(i, Message)] == [
        (n, n + 7, b"%d" % n) for n in range(100)
    ]
    assert [i.data for i in items if isinstance(i, Attachment)] == [b"data"]
    assert [i.values for i in items if isinstance(i, Metadata)] == [{"k": "v"}]


def test_the_same_calls_give_the_same_bytes() -> None:
    assert small_recording() == WHOLE


def test_whole_recording_is_whole() -> None:
    messages, scan = messages_of(WHOLE)
    assert len(messages) == 300
    assert scan.is_whole
    assert not scan.damage


def test_recording_cut_at_every_byte_gives_what_came_before_and_is_told() -> None:
    """AUTOPILOTS.md: "the indexed reader fails on a cut file, the stream reader does not"."""
    whole = small_recording(messages=100, chunk_bytes=800)
    expected, _ = messages_of(whole)
    whole_from = 0
    for cut in range(len(whole)):
        messages, scan = messages_of(whole[:cut])
        assert messages == expected[: len(messages)], cut
        assert len(messages) >= whole_from, cut
        assert not scan.is_whole, cut
        whole_from = len(messages)
    assert whole_from == 100


def test_flipped_bit_costs_at_most_its_chunk_and_is_never_taken_for_truth() -> None:
    expected, _ = messages_of(WHOLE)
    known = {(m.t_ns, m.data) for m in expected}
    largest = 300 // 9 + 20
    rng = random.Random(1)
    for _ in range(600):
        at, bit = rng.randrange(len(WHOLE)), rng.randrange(8)
        flipped = bytearray(WHOLE)
        flipped[at] ^= 1 << bit
        messages, _ = messages_of(bytes(flipped))
        payloads = {(m.t_ns, m.data) for m in messages}
        assert payloads <= known, at
        assert len(messages) >= 300 - largest, at


def test_chunk_whose_length_lies_does_not_take_the_next_ones_with_it() -> None:
    expected, _ = messages_of(WHOLE)
    at = WHOLE.index(b"\x06", len(MAGIC) + 200)
    second = WHOLE.find(b"zstd", at) - 4 - 28 - 9
    broken = bytearray(WHOLE)
    broken[second + 2] ^= 0x10  # the record's length grows by 4096 and reaches into later chunks
    messages, scan = messages_of(bytes(broken))
    assert len(messages) > 250
    assert scan.damage
    assert {(m.t_ns, m.data) for m in messages} <= {(m.t_ns, m.data) for m in expected}


@pytest.mark.parametrize("data", [b"", MAGIC, b"x" * 5000, MAGIC + bytes(5000), b"\xff" * 5000])
def test_what_is_no_recording_gives_nothing_and_ends(data: bytes) -> None:
    messages, scan = messages_of(data)
    assert messages == []
    assert not scan.is_whole


def test_writer_holds_at_most_one_chunk() -> None:
    out = bytearray()
    writer = McapWriter(out.extend, chunk_bytes=1000)
    from companion.recording.mcap_write import Channel

    writer.add_channel(Channel(1, 0, "t", "raw"))
    for n in range(100):
        writer.add_message(1, n, bytes(90))
        assert writer.pending_bytes < 1000
