"""What is cut, killed or damaged is rebuilt beside the original, and loses little."""

from __future__ import annotations

import io
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from mcap.reader import make_reader

from companion.errors import FileFormatError
from companion.recording.mcap_read import McapScan, Message
from companion.recording.recover import recover
from tests.companion.recording.samples import small_recording

WHOLE = small_recording(messages=60, chunk_bytes=600)
TINY = small_recording(messages=15, chunk_bytes=250)


def count(path: Path) -> int:
    return sum(isinstance(item, Message) for item in McapScan(path.read_bytes()))


def test_cut_at_every_byte_recovers_to_a_whole_file_and_leaves_the_original_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("companion.recording.recover.os.fsync", lambda fd: None)  # thousands of them take a minute
    path, out = tmp_path / "cut.mcap", tmp_path / "out.mcap"
    recovered = 0
    for cut in range(len(TINY)):
        path.write_bytes(TINY[:cut])
        out.unlink(missing_ok=True)
        found = recover(path, out)
        assert path.read_bytes() == TINY[:cut]
        assert not found.is_whole
        assert found.messages >= recovered
        recovered = found.messages
        if found.messages == 0:
            assert found.output is None
            assert not out.exists()
        else:
            scan = McapScan(out.read_bytes())
            assert sum(isinstance(item, Message) for item in scan) == found.messages
            assert scan.is_whole
    assert recovered == 15


def test_what_is_recovered_is_read_by_the_library(tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(WHOLE[: len(WHOLE) * 2 // 3])
    found = recover(path)
    assert found.output == tmp_path / "cut.recovered.mcap"
    reader = make_reader(io.BytesIO(found.output.read_bytes()), validate_crcs=True)
    assert len(list(reader.iter_messages())) == found.messages > 20
    kept = {m.name: m.metadata for m in reader.iter_metadata()}
    assert kept["run"] == {"mission": "small"}
    assert kept["recovered"], "what was lost is not said in it"
    assert [a.data for a in reader.iter_attachments()] == [b'{"a": 1}']


def test_whole_file_is_left_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "whole.mcap"
    path.write_bytes(WHOLE)
    found = recover(path)
    assert found.is_whole
    assert found.output is None
    assert [p.name for p in tmp_path.iterdir()] == ["whole.mcap"]


def test_flipped_bit_in_a_chunk_loses_that_chunk_only(tmp_path: Path) -> None:
    path = tmp_path / "flipped.mcap"
    body = bytearray(WHOLE)
    body[body.index(b"zstd", 1500) + 40] ^= 8
    path.write_bytes(body)
    found = recover(path)
    assert found.output is not None
    assert "checksum" in found.damage[0].what or "decompress" in found.damage[0].what.lower()
    assert 35 <= found.messages < 60
    assert McapScan(found.output.read_bytes()).is_whole or count(found.output) == found.messages


def test_the_original_is_never_written_to(tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(WHOLE[:1500])
    with pytest.raises(FileFormatError, match="original"):
        recover(path, path)
    assert path.read_bytes() == WHOLE[:1500]


WRITER = """
import sys, time
from pathlib import Path
from companion.recording.log import Recorder
recorder = Recorder(Path(sys.argv[1]), metadata={}, attachments={}, threaded=True)
print("ready", flush=True)
n = 0
while True:
    t_ns = time.monotonic_ns()
    recorder.input("lidar", t_ns, bytes(1216))
    recorder.input("poll", t_ns)
    n += 1
    time.sleep(0.003)
"""


def test_kill_at_a_random_time_loses_at_most_a_second(tmp_path: Path) -> None:
    """AUTOPILOTS.md: "with 1 MiB chunks 7 % of the messages were lost at SIGKILL, with 64 KiB 0.3 %"."""
    rng = random.Random(os.getpid())
    writers = []
    for n in range(3):
        folder = tmp_path / str(n)
        command = [sys.executable, "-c", WRITER, str(folder)]
        writers.append((folder, subprocess.Popen(command, stdout=subprocess.PIPE, text=True)))
    killed_ns = []
    for _, process in writers:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        time.sleep(0.8 + rng.random())
        process.send_signal(signal.SIGKILL)
        killed_ns.append(time.monotonic_ns())
        process.wait()
        process.stdout.close()
    for (folder, _), t_ns in zip(writers, killed_ns, strict=True):
        found = recover(folder / "recording.mcap")
        assert found.last_ns is not None
        assert (t_ns - found.last_ns) * 1e-9 < 1.0
        assert found.output is not None
        assert McapScan(found.output.read_bytes()).damage == []
