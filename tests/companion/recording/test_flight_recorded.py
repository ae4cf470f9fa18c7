"""The recorder on a flight core at work: killed at any time it has lost a second at most, and a full disk is said aloud."""

from __future__ import annotations

import asyncio
import errno
import os
import random
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import common

from companion import topics
from companion.config import CompanionConfig
from companion.flight import Flight
from companion.messages import Event
from companion.recording.recover import recover
from companion.recording.replay import Replay, compare
from companion.recording.run_files import read_run
from stockpilot import fly
from stockpilot.replay import recorded_config
from tests.companion.recording.test_log import a_recorder, fill

S = 1_000_000_000
REPLAYS = Path(__file__).resolve().parents[3] / "missions" / "replays"

FLIGHT = """
import sys, time
from pathlib import Path
from companion.flight import Flight
from companion.recording.log import Recorder
from companion.recording.replay import Replay
from companion.recording.run_files import read_run
from stockpilot.recorded import listen
from stockpilot.replay import recorded_config
from stockpilot.replay_edit import rebuild_scans
source = read_run(Path(sys.argv[2]))
metadata = source.attachments["lidar.json"].decode()
flight = Flight(config=recorded_config(source), lidar_metadata_json=metadata)
recorder = Recorder(Path(sys.argv[1]), metadata={}, attachments=source.attachments)
replay = Replay(flight, keep_messages=False)
listen(recorder, flight)
sent = 0
for item in rebuild_scans(source.inputs, metadata):
    replay.feed(item)
    for t_ns, frame in replay.frames[sent:]:
        recorder.output(t_ns, frame)
    sent = len(replay.frames)
    print(item.t_ns, flush=True)
time.sleep(60)
"""


def statustext_of(flight: Flight) -> str:
    """All that left as STATUSTEXT, its chunks put together."""
    parser = common.MAVLink(None)
    said = [m for frame in flight.take_output() for m in parser.parse_buffer(frame) or []]
    return "".join(m.text for m in said if m.get_type() == "STATUSTEXT")


@pytest.mark.timeout(400)  # two programs compile or load what flies
def test_flight_killed_at_a_random_time_has_lost_a_second_at_most_and_replays_to_the_bit(tmp_path: Path) -> None:
    """As `stockpilot run` flies: the recorder writes in the calls themselves."""
    command = [sys.executable, "-c", FLIGHT, str(tmp_path), str(REPLAYS / "straight_wall")]
    inputs = read_run(REPLAYS / "straight_wall").inputs
    lidar_ns = [i.t_ns for i in inputs if i.kind == "lidar"]
    kill_at_ns = random.Random(os.getpid()).randrange(lidar_ns[300], lidar_ns[-300])
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        flown_ns = next((t for line in program.stdout if (t := int(line)) >= kill_at_ns), 0)
        program.send_signal(signal.SIGKILL)
    assert flown_ns
    found = recover(tmp_path / "recording.mcap")
    assert found.output is not None
    assert found.last_ns is not None
    assert (flown_ns - found.last_ns) * 1e-9 < 1.0
    run = read_run(found.output)
    metadata = run.attachments["lidar.json"].decode()
    again = Replay(Flight(config=recorded_config(run), lidar_metadata_json=metadata))
    again.run(run.inputs)
    assert again.flight.scans > 5
    # All that was written came out the same; what the last call made may have been cut off.
    for difference in compare(run.topics, again):
        assert difference.first is None or "messages, now" in difference.first, difference
        assert difference.replayed >= difference.recorded, difference
        lost = again.messages.get(difference.name, again.frames)[difference.recorded :]
        assert all(t_ns >= run.inputs[-1].t_ns - S for t_ns, _ in lost), difference


def test_full_disk_is_an_event_and_a_statustext(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """FAULTS 21; the companion's own housekeeping, once a second on the vehicle."""
    flight = Flight(CompanionConfig())
    heard: list[Event] = []
    flight.tap = lambda topic, t_ns, message: heard.append(message) if topic is topics.EVENT else None
    recorder = a_recorder(tmp_path)
    fill(recorder, seconds=1)

    def full(fd: int, data: bytes) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("companion.recording.disk.os.write", full)
    fill(recorder, seconds=3)
    monkeypatch.setattr(fly, "HOUSEKEEPING_PERIOD_S", 0.01)

    async def some_rounds() -> None:
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(fly._housekeeping(recorder, flight, tmp_path)(), 0.5)

    asyncio.run(some_rounds())
    recorder.close()
    assert [e.name for e in heard if e.name.startswith("recording")] == ["recording_failed"]
    assert any("No space left on device" in e.text for e in flight.events)
    assert "Recording stopped: recording.mcap: No space left on device" in statustext_of(flight)


def test_raw_packets_are_shed_first_and_what_was_shed_is_said_aloud(tmp_path: Path) -> None:
    """FAULTS 21: "stop raw first, keep trajectory, events, map": free space sinks below the reserve in the flight."""
    free = [10 << 30]
    recorder = a_recorder(tmp_path, reserve_bytes=2 << 30)
    recorder._mcap_file.free_bytes = lambda: free[0]  # type: ignore[method-assign]
    fill(recorder, seconds=3)
    assert recorder.take_events(1) == []
    free[0] = 1 << 30
    fill(recorder, seconds=9)
    (told,) = recorder.take_events(2)
    recorder.close()
    run = read_run(tmp_path)
    flight = Flight(CompanionConfig())
    flight.on_event(told)
    assert "LiDAR packets are not recorded" in statustext_of(flight)
    kinds = [i.kind for i in run.inputs]
    assert kinds.count("poll") == kinds.count("mavlink") == 120
    assert 30 < kinds.count("lidar") < 100
    assert len(run.topics["odometry/estimate"]) == 120
    assert (tmp_path / "trajectory.tum").read_text().count("\n") == 120
