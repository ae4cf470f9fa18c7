"""What the autopilot says in words (STATUSTEXT, EVENT), and our own STATUSTEXT in chunks of 50 bytes."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

from companion.mavlink import wire
from companion.mavlink.px4_events import EVENT_TEXTS
from companion.messages import Event, Severity

_CHUNK = 50
_MAX_OPEN = 8
_AGAIN_NS = 60_000_000_000
_MAX_TOLD = 256


def pack_text(event: Event, text_id: int) -> list[bytes]:
    """STATUSTEXT payloads; several, under one id, when the text is longer than 50 bytes."""
    data = event.text.encode()
    chunks = [data[i : i + _CHUNK] for i in range(0, len(data), _CHUNK)] or [b""]
    if len(chunks) == 1:
        return [wire.pack(wire.STATUSTEXT, event.severity, chunks[0], 0, 0)]
    if len(chunks[-1]) == _CHUNK:
        chunks.append(b"")  # a full last chunk would not show that the text has ended
    chunks = chunks[:256]
    return [wire.pack(wire.STATUSTEXT, event.severity, chunk, text_id, n) for n, chunk in enumerate(chunks)]


@dataclass(slots=True)
class _Open:
    severity: int
    parts: dict[int, bytes]


class Texts:
    """Puts the chunks of STATUSTEXT together again; a text whose chunk was lost shows the gap as [...]."""

    def __init__(self) -> None:
        self._open: OrderedDict[int, _Open] = OrderedDict()
        self._event_sequence: int | None = None
        self._told: OrderedDict[tuple[int, int] | str, int] = OrderedDict()

    def on_text(self, payload: bytes, t_ns: int) -> list[Event]:
        """The text that this ends. The same again is told once a minute: ArduCopter with its origin at altitude 0 says
        each second on the ground that it has set its field elevation."""
        return [event for event in self._whole_texts(payload, t_ns) if self._is_news(event.text, t_ns)]

    def _whole_texts(self, payload: bytes, t_ns: int) -> list[Event]:
        severity, text, text_id, sequence = wire.unpack(wire.STATUSTEXT, payload)
        end = text.find(b"\0")
        piece = text if end < 0 else text[:end]
        if text_id == 0:
            return [_text_event(t_ns, severity, piece)]
        entry = self._open.setdefault(text_id, _Open(severity, {}))
        entry.parts[sequence] = piece
        if end < 0:
            if len(self._open) > _MAX_OPEN:
                return [self._close(next(iter(self._open)), t_ns)]
            return []
        return [self._close(text_id, t_ns)]

    def on_event(self, payload: bytes, t_ns: int) -> list[Event]:
        """EVENT (410), by which alone PX4 speaks to a companion (PX4.md, 7). Those of its arming checks come again
        every two seconds: each is told once a minute."""
        event_id, _, sequence, _, _, levels, _ = wire.unpack(wire.EVENT, payload)
        level = levels & 0x0F  # external; 8 and above are PX4's own protocol, not for people
        is_repeated, self._event_sequence = sequence == self._event_sequence, sequence
        if is_repeated or level > Severity.DEBUG or not self._is_news((event_id, level), t_ns):
            return []
        text = EVENT_TEXTS.get(event_id, f"PX4 event {event_id} (no text known here)")
        return [Event(t_ns=t_ns, severity=Severity(level), name="autopilot_event", text=text)]

    def _is_news(self, what: tuple[int, int] | str, t_ns: int) -> bool:
        told_ns = self._told.get(what)
        if told_ns is not None and t_ns - told_ns < _AGAIN_NS:
            return False
        self._told[what] = t_ns
        self._told.move_to_end(what)
        if len(self._told) > _MAX_TOLD:
            self._told.popitem(last=False)
        return True

    def _close(self, text_id: int, t_ns: int) -> Event:
        entry = self._open.pop(text_id)
        parts = [entry.parts.get(i, b"[...]") for i in range(max(entry.parts) + 1)]
        return _text_event(t_ns, entry.severity, b"".join(parts))


def _text_event(t_ns: int, severity: int, text: bytes) -> Event:
    words = text.decode(errors="replace").rstrip("\0").strip()  # PX4's end in a tab
    return Event(t_ns=t_ns, severity=Severity(min(severity, 7)), name="autopilot_text", text=words)
