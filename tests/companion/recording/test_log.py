"""The recorder: what it writes, what it sheds, and that it never troubles the flight."""

from __future__ import annotations

import errno
import io
import json
import os
import resource
import shutil
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from pymavlink.dialects.v20 import common

from companion import topics
from companion.errors import StockpilotError
from companion.messages import LevelledScan
from companion.recording import channels, codec
from companion.recording.log import MCAP_NAME, TLOG_NAME, TUM_NAME, Recorder
from companion.recording.mcap_read import McapScan
from companion.recording.recover import recover
from companion.recording.run_files import iter_inputs, read_run
from companion.recording.tlog import read_tlog, split_frames
from tests.companion.recording.samples import an_estimate, one_of_each

S = 1_000_000_000


def heartbeats(count: int, *, v1: bool = False) -> list[bytes]:
    link = common.MAVLink(None, srcSystem=1, srcComponent=191)
    out = []
    for n in range(count):
        link.seq = n
        out.append(bytes(common.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3).pack(link, force_mavlink1=v1)))
    return out


def a_recorder(folder: Path, *, lidar: bytes | None = None, **more: object) -> Recorder:
    attachments = {"companion.json": b"{}"} | ({} if lidar is None else {"lidar.json": lidar})
    return Recorder(folder, metadata={"mission": "m", "seed": "3"}, attachments=attachments, **more)  # type: ignore[arg-type]


def fill(recorder: Recorder, seconds: int = 3) -> list[tuple[str, int, bytes, tuple[str, int] | None]]:
    """A flight's worth of calls; returns the inputs as they went in."""
    rng = np.random.default_rng(0)
    frames = heartbeats(10)
    calls: list[tuple[str, int, bytes, tuple[str, int] | None]] = []
    for second in range(1, seconds + 1):
        for n in range(10):
            t_ns = second * S + n * 100_000_000
            calls += [
                ("lidar", t_ns, rng.bytes(1216), ("10.5.5.1", 7502)),
                ("mavlink", t_ns + 1, frames[n], ("127.0.0.1", 14540)),
                ("begin", t_ns + 2, b"", None),
                ("accept", t_ns + 3, b"", None),
                ("poll", t_ns + 4, b"", None),
            ]
            for call in calls[-5:]:
                recorder.input(*call)
            recorder.output(t_ns + 5, frames[n])
            recorder.tap(topics.ESTIMATE, t_ns + 6, an_estimate(t_ns, seed=n))
    return calls


def test_inputs_come_back_in_order_to_the_byte(tmp_path: Path) -> None:
    recorder = a_recorder(tmp_path)
    calls = fill(recorder)
    recorder.close({"state": "completed"})
    assert list(iter_inputs(tmp_path)) == calls
    run = read_run(tmp_path)
    assert run.is_whole
    assert run.metadata["run"] == {"mission": "m", "seed": "3"}
    assert run.metadata["outcome"] == {"state": "completed"}
    assert run.attachments == {"companion.json": b"{}"}
    assert run.topics
    without = read_run(tmp_path, with_topics=False)
    assert without.inputs == run.inputs
    assert not without.topics


def test_every_topic_is_recorded_to_the_bit(tmp_path: Path) -> None:
    recorder = a_recorder(tmp_path)
    by_type = {type(m): m for m in one_of_each()}
    sent = {}
    for n, topic in enumerate(t for t in topics.TOPICS if t.message in by_type):
        recorder.tap(topic, n, by_type[topic.message])
        if topic.recorded:
            sent[topic.name] = [(n, codec.encode(by_type[topic.message]))]
    recorder.close()
    got = {name: messages for name, messages in read_run_topics(tmp_path).items() if not name.startswith("/")}
    assert got == sent


def read_run_topics(folder: Path) -> dict[str, list[tuple[int, bytes]]]:
    return read_run(folder).topics


def test_same_calls_give_the_same_file(tmp_path: Path) -> None:
    for name in ("a", "b"):
        recorder = a_recorder(tmp_path / name)
        fill(recorder)
        recorder.close({"state": "x"})
    for name in (MCAP_NAME, TLOG_NAME, TUM_NAME):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_thread_writes_the_same_inputs_in_the_same_order(tmp_path: Path) -> None:
    recorder = a_recorder(tmp_path, threaded=True)
    calls = fill(recorder, seconds=5)
    recorder.close()
    assert list(iter_inputs(tmp_path)) == calls
    assert recorder.status.dropped == {}


def test_foxglove_schemas_hold_what_their_names_promise(tmp_path: Path) -> None:
    recorder = a_recorder(tmp_path)
    estimate = an_estimate(2 * S)
    recorder.tap(topics.ESTIMATE, 2 * S, estimate)
    recorder.tap(topics.EVENT, 2 * S, one_of_each()[8])
    points = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    recorder.points(
        LevelledScan(
            t_ns=2 * S, points_level=points, range_m=np.ones(2), row=np.zeros(2, int), column=np.zeros(2, int)
        ),
        estimate,
    )
    recorder.close()
    reader = make_reader(io.BytesIO((tmp_path / MCAP_NAME).read_bytes()), validate_crcs=True)
    drawn = {c.topic: (s, json.loads(m.data)) for s, c, m in reader.iter_messages() if c.topic.startswith("/")}
    assert {topic: s.name for topic, (s, _) in drawn.items()} == {
        "/pose": "foxglove.PoseInFrame",
        "/tf": "foxglove.FrameTransforms",
        "/points": "foxglove.PointCloud",
        "/log": "foxglove.Log",
    }
    for schema, content in drawn.values():
        assert schema.encoding == "jsonschema"
        assert set(content) == set(json.loads(schema.data)["properties"])
    assert drawn["/pose"][1]["pose"]["position"]["x"] == estimate.position_map_m[0]
    assert drawn["/points"][1]["point_stride"] == 12


def test_tlog_is_what_mavlink_tools_read(tmp_path: Path) -> None:
    from pymavlink import mavutil

    recorder = a_recorder(tmp_path, wall_offset_ns=1_700_000_000 * S)
    frames = heartbeats(4) + heartbeats(2, v1=True)
    recorder.input("mavlink", S, b"".join(frames[:3]), None)  # several frames in one datagram
    recorder.input("mavlink", 2 * S, frames[3], None)
    recorder.output(3 * S, b"".join(frames[4:]))
    recorder.close()
    data = (tmp_path / TLOG_NAME).read_bytes()
    assert [f for _, f in read_tlog(data)] == frames
    log = mavutil.mavlink_connection(str(tmp_path / TLOG_NAME), dialect="common")
    read = []
    while (message := log.recv_match()) is not None:
        read.append((message.get_type(), message._timestamp))
    log.close()
    assert read[0] == ("HEARTBEAT", 1_700_000_001.0)
    assert len(read) == 6


def test_frames_are_found_among_other_bytes() -> None:
    a, b = heartbeats(2)
    assert list(split_frames(b"\x00\x01" + a + b"noise" + b + a[:5])) == [a, b]


def test_trajectory_has_every_digit(tmp_path: Path) -> None:
    recorder = a_recorder(tmp_path)
    estimate = an_estimate(1_234_567_890_123_456_789)
    recorder.tap(topics.ESTIMATE, 1, estimate)
    recorder.close()
    words = (tmp_path / TUM_NAME).read_text().split()
    assert words[0] == "1234567890.123456789"
    assert [float(w) for w in words[1:4]] == list(estimate.position_map_m)
    assert [float(w) for w in words[4:]] == [0.0, 0.0, 0.0, 1.0]


def test_full_queue_sheds_raw_packets_before_messages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    held = threading.Event()
    real_write = os.write

    def slow_write(fd: int, data: bytes) -> int:
        held.wait(20)
        return real_write(fd, data)

    recorder = a_recorder(tmp_path, threaded=True, queue_bytes=200_000)
    monkeypatch.setattr("companion.recording.disk.os.write", slow_write)
    recorder.input("lidar", 0, bytes(200_000), None)  # the thread takes it and hangs at the disk
    time.sleep(0.6)
    slowest = 0.0
    for n in range(1000):
        began = time.perf_counter()
        recorder.input("lidar", n, bytes(1216), None)
        slowest = max(slowest, time.perf_counter() - began)
        if n % 20 == 0:
            recorder.tap(topics.ESTIMATE, n, an_estimate(n))
    held.set()
    recorder.close()
    run = read_run(tmp_path)
    assert slowest < 0.1, "the caller waited for the disk"
    assert recorder.status.dropped["queue full"] > 500
    assert len(run.topics["odometry/estimate"]) == 50, "messages were shed with the raw packets"
    assert int(run.metadata["recorder"]["queue full"]) == recorder.status.dropped["queue full"]
    assert [e.name for e in recorder.take_events(5)] == ["recording_incomplete"]


def test_nearly_full_disk_sheds_raw_packets_only_and_says_so_once(tmp_path: Path) -> None:
    free = shutil.disk_usage(tmp_path).free
    recorder = a_recorder(tmp_path, reserve_bytes=free + (1 << 40))
    fill(recorder, seconds=5)
    assert [e.name for e in recorder.take_events(1)] == ["recording_sheds_raw"]
    assert recorder.take_events(2) == []
    recorder.close()
    run = read_run(tmp_path)
    kinds = [i.kind for i in run.inputs]
    assert kinds.count("poll") == 50
    assert kinds.count("lidar") < 15
    assert recorder.status.dropped["disk nearly full"] == 50 - kinds.count("lidar")
    assert run.is_whole


def test_first_write_error_latches_and_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """AUTOPILOTS.md: "latch the first error"."""
    recorder = a_recorder(tmp_path)
    fill(recorder, seconds=2)
    real_write = os.write

    def fail(fd: int, data: bytes) -> int:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr("companion.recording.disk.os.write", fail)
    fill(recorder, seconds=2)
    monkeypatch.setattr("companion.recording.disk.os.write", real_write)  # the disk comes back: too late
    size = (tmp_path / MCAP_NAME).stat().st_size
    fill(recorder, seconds=2)
    recorder.close()
    assert (tmp_path / MCAP_NAME).stat().st_size == size
    assert [e.name for e in recorder.take_events(1)] == ["recording_failed"]
    assert "Input/output error" in str(recorder.status.error)
    assert recorder.status.dropped["disk error"] > 0


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 1 MiB where that may be mounted."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = os.geteuid() == 0 and subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(folder)], capture_output=True, check=False
    ).returncode == 0  # fmt: skip
    if not mounted:
        pytest.skip("a small file system cannot be mounted here (needs root); the size limit test covers the same")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def _fill_until_full(recorder: Recorder) -> None:
    rng = np.random.default_rng(0)
    for n in range(3000):
        recorder.input("lidar", n * 3_000_000, rng.bytes(1216), None)
        if n % 10 == 0:
            recorder.input("poll", n * 3_000_000)


def test_full_file_system_ends_the_recording_not_the_flight(small_disk: Path) -> None:
    recorder = a_recorder(small_disk)
    _fill_until_full(recorder)
    recorder.close({"state": "completed"})
    assert "No space left" in str(recorder.status.error)
    assert [e.name for e in recorder.take_events(1)] == ["recording_failed"]
    found = recover(small_disk / MCAP_NAME, small_disk.parent / "recovered.mcap")
    assert found.messages > 700
    assert not found.damage, "the file does not end where a write ended"
    assert McapScan((small_disk.parent / "recovered.mcap").read_bytes()).orphans == 0


def test_file_size_limit_ends_the_recording_not_the_flight(tmp_path: Path) -> None:
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    recorder = a_recorder(tmp_path)
    resource.setrlimit(resource.RLIMIT_FSIZE, (500_000, before[1]))  # Python ignores SIGXFSZ: writes fail with EFBIG
    try:
        _fill_until_full(recorder)
        recorder.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert "File too large" in str(recorder.status.error)
    found = recover(tmp_path / MCAP_NAME)
    assert found.messages > 300
    assert not found.damage


def test_folder_that_cannot_be_written_is_told_before_the_flight(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(StockpilotError, match="--out"):
        a_recorder(tmp_path / "file" / "run")


def test_message_that_cannot_be_written_is_counted_and_the_rest_goes_on(tmp_path: Path) -> None:
    recorder = a_recorder(tmp_path)
    recorder.tap(topics.ESTIMATE, 1, "no estimate")
    recorder.input("poll", 2)
    recorder.close()
    assert sum(recorder.status.dropped.values()) == 1
    assert [i.kind for i in iter_inputs(tmp_path)] == ["poll"]


def test_channel_numbers_are_those_of_older_recordings() -> None:
    assert {c.topic: c.id for c in channels.all_channels() if c.id < 20} == {
        "in/lidar": 1,
        "in/mavlink": 2,
        "in/poll": 3,
        "in/accept": 4,
        "in/operator": 5,
        "in/begin": 6,
        "in/told": 7,
        "out/mavlink": 8,
        "/pose": 10,
        "/tf": 11,
        "/points": 12,
        "/log": 13,
    }


def test_recording_costs_the_caller_little(tmp_path: Path) -> None:
    recorder = a_recorder(tmp_path, threaded=True)
    packet, estimate = bytes(1216), an_estimate()
    began = time.thread_time()
    for n in range(320):
        recorder.input("lidar", n, packet, ("10.0.0.1", 7502))
    for n in range(150):
        recorder.tap(topics.ESTIMATE, n, estimate)
    spent_s = time.thread_time() - began
    recorder.close()
    assert spent_s < 0.02, "a second of flight costs the flight loop more than 2 % of a core"
