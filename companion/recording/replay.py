"""A recorded flight again: the same calls into the same flight core, without tasks, sockets or clocks.

With the recorded configuration every estimate, setpoint and frame comes out as it was, to the last bit; with another one
it is the same flight seen by other settings (the vehicle flies as it flew).
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from companion import topics
from companion.errors import FileFormatError
from companion.flight import Flight
from companion.messages import OperatorCommand, OperatorCommandKind
from companion.odometry import ScanResult
from companion.recording import channels, codec
from companion.recording.run_types import Input
from companion.recording.scans import ScansHere, ScanSource


@dataclass(slots=True)
class Replay:
    """Feeds recorded inputs to `flight`. What comes out is kept: frames, messages by topic (encoded), scan results.

    keep_messages: encode and keep every message, for comparison; costs time.
    scans: where the scans are registered, ScansAhead for another process; else here.
    """

    flight: Flight
    keep_messages: bool = True
    on_scan: Callable[[ScanResult], None] | None = None
    scans: ScanSource = field(init=False)
    frames: list[tuple[int, bytes]] = field(init=False, default_factory=list)
    messages: dict[str, list[tuple[int, bytes]]] = field(init=False, default_factory=dict)
    first_ns: int | None = field(init=False, default=None)
    last_ns: int = field(init=False, default=0)
    _unmatched: int = field(init=False, default=0)
    _nested: deque[bytes] = field(init=False, default_factory=deque)
    _is_feeding: str = field(init=False, default="")

    def __post_init__(self) -> None:
        self.scans = ScansHere(self.flight)
        self.flight.record = self._hear
        if self.keep_messages:
            self.flight.tap = self._keep

    @property
    def unmatched(self) -> int:
        """Begins or accepts without a scan: parts of the recording are missing."""
        return self._unmatched + self.scans.unmatched

    @property
    def duration_s(self) -> float:
        return 0.0 if self.first_ns is None else (self.last_ns - self.first_ns) * 1e-9

    def run(self, inputs: Iterable[Input]) -> None:
        for item in inputs:
            self.feed(item)
        self.scans.finish()

    def feed(self, item: Input) -> None:
        """One recorded call."""
        kind, t_ns, data, source = item
        if self.first_ns is None:
            self.first_ns = t_ns
        self.last_ns = t_ns
        if kind == "lidar":
            self.scans.lidar(item)
            return
        flight, self._is_feeding = self.flight, kind
        if kind == "mavlink":
            flight.on_mavlink(data, t_ns, source)
        elif kind == "poll":
            flight.poll(t_ns)
        elif kind == "begin":
            self.scans.begin(t_ns)
        elif kind == "accept":
            self._accept(t_ns)
        elif kind == "operator":
            self._operator(item)
        elif kind == "told":
            flight.on_told(data, t_ns)
        for frame in flight.take_output():
            self.frames.append((t_ns, frame))

    def _accept(self, t_ns: int) -> None:
        accepted = self.scans.accept()
        if accepted is None:
            self._unmatched += 1
            return
        result = accepted.result
        belongs = self.flight.accept_scan(result, t_ns)
        if result is not None:
            if belongs:
                self.flight.mapper.add(result.levelled, result.estimate)
            if self.on_scan is not None:
                self.on_scan(result)

    def _operator(self, item: Input) -> None:
        """An operator's command, unless the flight core itself has just made it of a MAVLink frame."""
        if self._nested and self._nested[0] == item.data:
            self._nested.popleft()
            return
        self.flight.on_operator(parse_operator(item))

    def _hear(self, kind: str, t_ns: int, data: bytes, source: tuple[str, int] | None) -> None:
        if kind == "operator" and self._is_feeding == "mavlink":
            self._nested.append(data)

    def _keep(self, topic: topics.Topic, t_ns: int, message: object) -> None:
        if topic.recorded:
            self.messages.setdefault(topic.name, []).append((t_ns, codec.encode(message)))


def parse_operator(item: Input) -> OperatorCommand:
    """The command of an "operator" input, as Flight.on_operator records it: kind, then source."""
    word, _, source = item.data.decode(errors="replace").partition(" ")
    try:
        kind = OperatorCommandKind(word)
    except ValueError:
        raise FileFormatError(f"recording: operator command {word!r} at {item.t_ns} ns is not known") from None
    return OperatorCommand(t_ns=item.t_ns, kind=kind, source=source)


@dataclass(frozen=True, slots=True)
class TopicDifference:
    """first: where and how the first difference shows; None: all the same."""

    name: str
    recorded: int
    replayed: int
    first: str | None


def compare(
    recorded: dict[str, list[tuple[int, bytes]]], replay: Replay
) -> list[TopicDifference]:  # fmt: skip
    """Topic by topic, byte by byte, the frames sent included. Raises: FileFormatError: nothing was recorded to compare
    with (a comparison of nothing must not pass)."""
    names = [t.name for t in topics.TOPICS if t.recorded and (t.name in recorded or t.name in replay.messages)]
    found = [_difference(n, recorded.get(n, []), replay.messages.get(n, [])) for n in names]
    sent = [(t, channels.unpack_raw(data).data) for t, data in recorded.get(channels.OUTPUT_TOPIC, [])]
    found.append(_difference(channels.OUTPUT_TOPIC, sent, replay.frames, with_times=False))
    if not any(d.recorded for d in found):
        raise FileFormatError("nothing to compare with: the recording has no topics and no frames that were sent")
    return found


def _difference(
    name: str, recorded: list[tuple[int, bytes]], replayed: list[tuple[int, bytes]], *, with_times: bool = True
) -> TopicDifference:
    first: str | None = None
    for n, (a, b) in enumerate(zip(recorded, replayed, strict=False)):
        if a[1] != b[1] or (with_times and a[0] != b[0]):
            first = f"message {n} at {a[0]} ns: {_explain(a[1], b[1]) if a[1] != b[1] else f'time {a[0]}, now {b[0]}'}"
            break
    if first is None and len(recorded) != len(replayed):
        first = f"{len(recorded)} messages, now {len(replayed)}"
    return TopicDifference(name, len(recorded), len(replayed), first)


def _explain(recorded: bytes, replayed: bytes) -> str:
    """The first field that differs, or the bytes where they are no JSON."""
    try:
        a, b = codec.fields(recorded), codec.fields(replayed)
    except (ValueError, struct.error):
        return f"{recorded[:24].hex()}, now {replayed[:24].hex()}"
    for key in a:
        if a[key] != b.get(key):
            return f"{key} {_short(a[key])}, now {_short(b.get(key))}"
    return "the same fields in another form"


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= 60 else text[:57] + "..."
