"""The recorder: every byte that crosses and every message, into one MCAP file, a tlog and a trajectory. An edge.

It never slows or ends a flight: on the vehicle a thread of its own writes from a bounded queue, raw LiDAR packets are
shed first, and the first failed write latches and is told.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion import topics
from companion.geometry import yaw_from_quat
from companion.messages import Event, LevelledScan, OdometryEstimate, Severity
from companion.recording import channels, codec, foxglove
from companion.recording.disk import AppendFile
from companion.recording.mcap_write import McapWriter
from companion.recording.tlog import tlog_records
from companion.recording.tum import tum_line

MCAP_NAME, TLOG_NAME, TUM_NAME = "recording.mcap", "telemetry.tlog", "trajectory.tum"
FLUSH_NS = 250_000_000  # a kill loses this much at most, and what the thread had not yet taken (WAKE_S)
SYNC_NS = 1_000_000_000
WAKE_S = 0.05
QUEUE_BYTES = 32 << 20  # over a minute of a 5 x 512 sensor: the longest stall of a disk that loses nothing
DRAWN_PERIOD_NS = 200_000_000  # poses and transforms for viewers
POINTS_PERIOD_NS = 1_000_000_000
_LIDAR_ID = channels.INPUT_IDS["lidar"]
_MAVLINK_IDS = (channels.INPUT_IDS["mavlink"], channels.OUTPUT_ID)
_ESTIMATE_ID = channels.TOPIC_IDS[topics.ESTIMATE.name]
_EVENT_ID = channels.TOPIC_IDS[topics.EVENT.name]

_Entry = tuple[int, int, Any, Any]  # channel, time, payload, source or second payload


@dataclass(frozen=True, slots=True, kw_only=True)
class RecorderStatus:
    """dropped: messages that were not written, by why."""

    bytes_written: int
    messages: int
    dropped: Mapping[str, int]
    is_shedding: bool
    error: str | None


class Recorder:
    """Call `input`, `output` and `tap` for all that crosses; `tick` now and then; `close` at the end.

    Args:
        folder: of the run; made if need be. The files in it are written anew.
        metadata: said of the recording: mission, seed, commit. attachments: files by name, e.g. the configuration.
        reserve_bytes: free space below which raw LiDAR packets are no longer written.
        wall_offset_ns: wall clock minus companion time: labels of the tlog only.
        threaded: on the vehicle. Otherwise all is written by the calls themselves, the same bytes for the same calls.
    Raises: StockpilotError: the files cannot be created.
    """

    def __init__(
        self,
        folder: Path,
        *,
        metadata: Mapping[str, str],
        attachments: Mapping[str, bytes],
        reserve_bytes: int = 0,
        wall_offset_ns: int = 0,
        threaded: bool = False,
        queue_bytes: int = QUEUE_BYTES,
    ) -> None:
        self.folder = folder
        self._files = [AppendFile(folder / name) for name in (MCAP_NAME, TLOG_NAME, TUM_NAME)]
        self._mcap_file, self._tlog_file, self._tum_file = self._files
        self._reserve_bytes = reserve_bytes
        self._wall_offset_ns = wall_offset_ns
        self._dropped: Counter[str] = Counter()
        self._is_shedding = False
        self._error: str | None = None
        self._told: set[str] = set()
        self._tlog = bytearray()
        self._tum: list[str] = []
        self._drawn_ns = self._points_ns = -(1 << 62)
        self._flushed_ns: int | None = None
        self._synced_ns = 0
        self._mcap = McapWriter(self._mcap_file.write)
        self._begin(metadata, attachments)
        self._queue: deque[_Entry] = deque()
        self._queued_bytes = 0
        self._queue_limit = queue_bytes
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        if threaded:
            self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
            self._thread.start()

    # ---- what crosses -----------------------------------------------------------------------------------------------

    def input(self, kind: str, t_ns: int, data: bytes = b"", source: tuple[str, int] | None = None) -> None:
        """A call into the flight core, in the order of the calls: kind is one of channels.INPUTS."""
        self._put((channels.INPUT_IDS[kind], t_ns, data, source), len(data))

    def output(self, t_ns: int, data: bytes) -> None:
        """A MAVLink frame that left."""
        self._put((channels.OUTPUT_ID, t_ns, data, None), len(data))

    def tap(self, topic: topics.Topic, t_ns: int, message: object) -> None:
        """A message of a topic, as Flight's tap gives it."""
        if topic.recorded:
            self._put((channels.TOPIC_IDS[topic.name], t_ns, message, None), 1000)

    def points(self, levelled: LevelledScan, estimate: OdometryEstimate) -> None:
        """A scan with its pose, for viewers: one a second is kept."""
        if estimate.t_ns - self._points_ns >= POINTS_PERIOD_NS:
            self._points_ns = estimate.t_ns
            self._put((channels.POINTS_ID, estimate.t_ns, levelled, estimate), 50_000)

    # ---- how it goes ------------------------------------------------------------------------------------------------

    @property
    def status(self) -> RecorderStatus:
        return RecorderStatus(
            bytes_written=sum(f.bytes_written for f in self._files),
            messages=self._mcap.messages,
            dropped=dict(sorted(self._dropped.items())),
            is_shedding=self._is_shedding,
            error=self._error,
        )

    def take_events(self, t_ns: int) -> list[Event]:
        """What an operator must know of the recording and has not been told: call once a second."""
        news: list[Event] = []
        if self._error is not None and "error" not in self._told:
            self._told.add("error")
            text = f"Recording stopped: {self._error}"
            news.append(Event(t_ns=t_ns, severity=Severity.ERROR, name="recording_failed", text=text))
        if self._is_shedding and "shedding" not in self._told:
            self._told.add("shedding")
            text = f"Disk nearly full (reserve {self._reserve_bytes >> 20} MiB): LiDAR packets are not recorded"
            news.append(Event(t_ns=t_ns, severity=Severity.WARNING, name="recording_sheds_raw", text=text))
        if self._dropped["queue full"] and "queue" not in self._told:
            self._told.add("queue")
            text = "The disk is too slow: parts of the recording are missing"
            news.append(Event(t_ns=t_ns, severity=Severity.WARNING, name="recording_incomplete", text=text))
        return news

    def close(self, outcome: Mapping[str, str] | None = None) -> None:
        """Finish the files. outcome: how the flight ended, kept as metadata."""
        if self._thread is not None:
            self._stop.set()
            self._thread.join()
            self._thread = None
        self._drain()
        if outcome:
            self._mcap.add_metadata("outcome", outcome)
        self._mcap.add_metadata("recorder", {k: str(n) for k, n in sorted(self._dropped.items())})
        self._mcap.finish()
        self._flush_side_files()
        for file in self._files:
            file.close()
        self._latch_errors()

    # ---- within -----------------------------------------------------------------------------------------------------

    def _begin(self, metadata: Mapping[str, str], attachments: Mapping[str, bytes]) -> None:
        for schema in channels.all_schemas():
            self._mcap.add_schema(schema)
        for channel in channels.all_channels():
            self._mcap.add_channel(channel)
        self._mcap.add_metadata("run", metadata)
        for name, data in attachments.items():
            media = "application/json" if name.endswith(".json") else "text/plain"
            self._mcap.add_attachment(name, media, data, 0)

    def _put(self, entry: _Entry, size: int) -> None:
        if self._thread is None:
            self._store_safely(entry)
            self._flush_if_due(entry[1])
            return
        limit = self._queue_limit if entry[0] == _LIDAR_ID else self._queue_limit * 3 // 2
        with self._lock:
            if self._queued_bytes + size > limit:
                self._dropped["queue full"] += 1
                return
            self._queued_bytes += size
            self._queue.append(entry)

    def _work(self) -> None:
        """The thread: takes what is queued, and flushes by the clock even when nothing comes."""
        while not self._stop.wait(WAKE_S):
            self._drain()
            self._flush_if_due(time.monotonic_ns(), sync=True)

    def _drain(self) -> None:
        with self._lock:
            entries, self._queue = self._queue, deque()
            self._queued_bytes = 0
        for entry in entries:
            self._store_safely(entry)

    def _store_safely(self, entry: _Entry) -> None:
        try:
            self._store(entry)
        except Exception as error:  # one odd message may not end the recording, nor the recording the flight
            self._dropped[f"cannot be written: {type(error).__name__}"] += 1

    def _store(self, entry: _Entry) -> None:
        channel_id, t_ns, payload, more = entry
        if self._error is not None:
            self._dropped["disk error"] += 1
            return
        if channel_id == _LIDAR_ID and self._is_shedding:
            self._dropped["disk nearly full"] += 1
            return
        if channel_id <= channels.OUTPUT_ID:
            self._mcap.add_message(channel_id, t_ns, channels.pack_raw(payload, more))
            if channel_id in _MAVLINK_IDS:
                self._tlog += tlog_records(payload, t_ns + self._wall_offset_ns)
        elif channel_id == channels.POINTS_ID:
            self._draw_points(payload, more)
        else:
            self._mcap.add_message(channel_id, t_ns, codec.encode(payload))
            if channel_id == _ESTIMATE_ID:
                self._draw_pose(payload)
            elif channel_id == _EVENT_ID:
                self._mcap.add_message(channels.LOG_ID, t_ns, foxglove.log(payload))

    def _draw_pose(self, estimate: OdometryEstimate) -> None:
        self._tum.append(tum_line(estimate))
        if estimate.t_ns - self._drawn_ns >= DRAWN_PERIOD_NS:
            self._drawn_ns = estimate.t_ns
            self._mcap.add_message(channels.POSE_ID, estimate.t_ns, foxglove.pose_in_frame(estimate))
            self._mcap.add_message(channels.TRANSFORMS_ID, estimate.t_ns, foxglove.frame_transforms(estimate))

    def _draw_points(self, levelled: LevelledScan, estimate: OdometryEstimate) -> None:
        yaw = yaw_from_quat(estimate.q_map_body_wxyz)
        points = foxglove.points_in_map(levelled, yaw, estimate.position_map_m)
        self._mcap.add_message(channels.POINTS_ID, estimate.t_ns, foxglove.point_cloud(points, estimate.t_ns))

    def _flush_if_due(self, now_ns: int, *, sync: bool = False) -> None:
        if self._flushed_ns is None or now_ns < self._flushed_ns:
            self._flushed_ns = self._synced_ns = now_ns
        if now_ns - self._flushed_ns < FLUSH_NS:
            return
        self._flushed_ns = now_ns
        self._mcap.flush()
        self._flush_side_files()
        if now_ns - self._synced_ns >= SYNC_NS:
            self._synced_ns = now_ns
            self._watch_disk()
            if sync:
                for file in self._files:
                    file.sync()
        self._latch_errors()

    def _flush_side_files(self) -> None:
        if self._tlog:
            self._tlog_file.write(bytes(self._tlog))
            self._tlog.clear()
        if self._tum:
            self._tum_file.write("".join(self._tum).encode())
            self._tum.clear()

    def _watch_disk(self) -> None:
        if self._reserve_bytes:
            self._is_shedding = self._mcap_file.free_bytes() < self._reserve_bytes

    def _latch_errors(self) -> None:
        if self._error is None:
            self._error = self._mcap_file.error
        for file in (self._tlog_file, self._tum_file):
            if file.error is not None and self._error is None:
                self._dropped[f"{file.path.name} failed"] += 1
