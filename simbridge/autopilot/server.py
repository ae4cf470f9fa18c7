"""One MAVLink link of the emulated PX4: its streams, its heartbeats, its texts, its time synchronisation."""

from __future__ import annotations

import heapq
import math
import struct
from collections import deque
from typing import TYPE_CHECKING, Any

from simbridge.autopilot.events import LAYOUT as EVENT_LAYOUT
from simbridge.autopilot.events import Event
from simbridge.autopilot.streams import NORMAL_HZ, ONBOARD_HZ, PACKERS, SILENT_IDS
from simbridge.autopilot.timesync import TimeSync
from simbridge.autopilot.wire import BY_NAME, LAYOUTS, Decoder, Encoder

if TYPE_CHECKING:
    from simbridge.autopilot.autopilot import Autopilot

GROUND_STATION, ONBOARD_CONTROLLER = 6, 18  # MAV_TYPE
HEARTBEAT_TIMEOUT_NS = 2_500_000_000  # TelemetryStatus.msg
TEXT_AGE_NS = 5_000_000_000  # a ground station that appears gets the texts of the last 5 s
TEXT_SPACING_NS = 48_000_000  # no more than 20 a second (recorded every 48 to 52 ms)
TEXT_QUEUE = 8  # texts waiting; older ones are lost (recorded: 78 of 105 texts left, the last 0.4 s late)
CHUNK = 50
PARAMS_PER_STEP = 4  # of a PARAM_REQUEST_LIST: PX4 sends about 1000 a second


class Link:
    """Everything PX4 keeps per MAVLink instance."""

    def __init__(self, name: str, rates_hz: dict[str, float], encoder: Encoder, start_ns: int) -> None:
        self.name = name
        self.decoder = Decoder()
        self.encoder = encoder
        self.timesync = TimeSync()
        self.out: list[bytes] = []
        self.heartbeats: dict[tuple[int, int, int], int] = {}
        self.params_left: deque[str] = deque()
        self._intervals: dict[str, int] = {}
        self._default = {name: round(1e9 / hz) for name, hz in rates_hz.items()}
        self._queue: list[tuple[int, int, str]] = []
        self._order = 0
        self._texts: deque[tuple[int, int, str]] = deque(maxlen=TEXT_QUEUE)
        self._text_id = 0
        self._next_text_ns = 0
        self.unsent = 0
        for stream, interval in self._default.items():
            self._schedule(stream, interval, start_ns + (interval if interval >= 10**9 else 0))

    def _schedule(self, stream: str, interval_ns: int, due_ns: int) -> None:
        self._intervals[stream] = interval_ns
        self._order += 1
        heapq.heappush(self._queue, (due_ns, self._order, stream))

    def send(self, name: str, **fields: Any) -> None:
        """Queue one message by field names."""
        self.out.append(self.encoder.pack_named(name, **fields))

    def send_stream(self, a: Autopilot, name: str) -> bool:
        """Queue one stream message now. False if there is nothing to say yet."""
        try:
            values = PACKERS[name](a)
            if values is None:
                return False
            self.out.append(self.encoder.pack(BY_NAME[name], values))
        except (struct.error, OverflowError, ValueError):  # an estimate driven off the wire's number range
            self.unsent += 1
            return False
        return True

    def step(self, a: Autopilot, t_ns: int) -> None:
        """Queue what is due."""
        queue = self._queue
        while queue and queue[0][0] <= t_ns:
            due, order, name = queue[0]
            interval = self._intervals[name]
            if interval <= 0 or order < 0:
                heapq.heappop(queue)
                continue
            following = due + interval
            heapq.heapreplace(queue, (following if following > t_ns else t_ns + interval, order, name))
            self.send_stream(a, name)
        if self._texts and t_ns >= self._next_text_ns:
            self._send_text(t_ns)
        if self.params_left:
            for _ in range(min(PARAMS_PER_STEP, len(self.params_left))):
                a.parameters.send_value(self, self.params_left.popleft())

    # intervals

    def set_interval(self, msgid: int, interval_us: float, t_ns: int) -> bool:
        """SET_MESSAGE_INTERVAL: 0 the default rate, -1 off. False: a message that PX4 does not have."""
        name = LAYOUTS[msgid].name if msgid in LAYOUTS else ""
        if name not in PACKERS:
            return msgid in SILENT_IDS
        if not math.isfinite(interval_us):
            return False
        interval = self._default.get(name, 0) if interval_us == 0 else round(interval_us * 1000)
        self._queue = [entry for entry in self._queue if entry[2] != name]
        heapq.heapify(self._queue)
        self._intervals[name] = 0
        if interval > 0:
            self._schedule(name, interval, t_ns + interval)
        return True

    def interval_us(self, msgid: int) -> int:
        """GET_MESSAGE_INTERVAL: -1 where it is not streamed."""
        name = LAYOUTS[msgid].name if msgid in LAYOUTS else ""
        interval = self._intervals.get(name, 0)
        return round(interval / 1000) if interval > 0 else -1

    # heartbeats and texts

    def heartbeat(self, system: int, component: int, kind: int, t_ns: int) -> None:
        self.heartbeats[system, component, kind] = t_ns

    def has_ground_station(self, t_ns: int) -> bool:
        return any(
            kind == GROUND_STATION and t_ns - at < HEARTBEAT_TIMEOUT_NS for (_, _, kind), at in self.heartbeats.items()
        )

    def text(self, severity: int, text: str, t_ns: int) -> None:
        """Queue a text; it leaves once this link carries a ground station's heartbeat."""
        self._texts.append((t_ns, severity, text))

    def event(self, event: Event, boot_ms: int, sequence: int) -> None:
        """Queue one EVENT, broadcast."""
        values = (event.id, boot_ms & 0xFFFFFFFF, sequence, 0, 0, event.levels, event.arguments)
        self.out.append(self.encoder.pack(EVENT_LAYOUT, values))

    def _send_text(self, t_ns: int) -> None:
        while self._texts and t_ns - self._texts[0][0] > TEXT_AGE_NS and not self.has_ground_station(t_ns):
            self._texts.popleft()
        if not self._texts or not self.has_ground_station(t_ns):
            return
        _, severity, text = self._texts.popleft()
        self._next_text_ns = t_ns + TEXT_SPACING_NS
        for chunk, start in enumerate(range(0, len(text), CHUNK)):
            part = text[start : start + CHUNK]
            self.send("STATUSTEXT", severity=severity, text=part, id=self._text_id, chunk_seq=chunk)
        self._text_id = (self._text_id + 1) & 0xFFFF


def onboard_link(encoder: Encoder, start_ns: int) -> Link:
    """UDP 14540: mode Onboard."""
    return Link("offboard", ONBOARD_HZ, encoder, start_ns)


def ground_link(encoder: Encoder, start_ns: int) -> Link:
    """UDP 14550: mode Normal."""
    return Link("gcs", NORMAL_HZ, encoder, start_ns)
