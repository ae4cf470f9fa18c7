"""MAVLink 2 message signing, of our own: the library's stores a packet's time before it has checked its hash, so that
one forged packet locks out every later genuine one (AUTOPILOTS.md, measured). Here the hash comes first, in constant
time, and a refused frame leaves no trace but a count.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Callable
from dataclasses import dataclass, field

from companion.mavlink.codec import Frame

# Signature times count 10 us since 2015-01-01 (MAVLink, message signing).
TICK_NS = 10_000
_TICKS_PER_MINUTE = 6_000_000
_STREAM_ALIVE_NS = 5_000_000_000
_SAVE_STEP = 10 * 100_000  # 10 s: after a restart the saved time, plus this, is newer than anything sent before


@dataclass(slots=True)
class _Stream:
    timestamp: int
    t_ns: int


@dataclass(slots=True)
class Signer:
    """Signs what leaves and checks what comes. Time never goes back, not even over a restart without a clock:
    start with the timestamp that `save` was last given.

    key: 32 bytes. timestamp: the newest known to have been used. save: called with a timestamp to keep, rarely.
    """

    key: bytes
    timestamp: int
    save: Callable[[int], None] = lambda _: None
    link_id: int = 0
    _saved: int = 0
    _t_ns: int | None = None
    _streams: dict[tuple[int, int, int], _Stream] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if len(self.key) != 32:
            raise ValueError(f"signing key: expected 32 bytes, got {len(self.key)}")
        self.timestamp += _SAVE_STEP
        self._keep()

    def _keep(self) -> None:
        self._saved = self.timestamp
        self.save(self.timestamp)

    def _advance(self, t_ns: int) -> None:
        """Carry our own signing clock on by the monotonic time that went by."""
        if self._t_ns is not None and t_ns > self._t_ns:
            ticks = (t_ns - self._t_ns) // TICK_NS
            self.timestamp += ticks
            self._t_ns += ticks * TICK_NS
        elif self._t_ns is None:
            self._t_ns = t_ns
        if self.timestamp - self._saved >= _SAVE_STEP // 2:
            self._keep()

    def sign(self, frame: bytes, t_ns: int) -> bytes:
        """The frame with its 13 bytes of signature behind."""
        self._advance(t_ns)
        self.timestamp += 1  # each frame has a time of its own
        stamped = frame + bytes((self.link_id,)) + self.timestamp.to_bytes(6, "little")
        return stamped + hashlib.sha256(self.key + stamped).digest()[:6]

    def refusal(self, frame: Frame, t_ns: int) -> str | None:
        """Why this frame must not be believed; None when it may. Only an accepted frame changes anything."""
        if frame.version == 1:
            return "mavlink1_while_signing"
        if len(frame.signature) != 13:
            return "unsigned"
        expected = hashlib.sha256(self.key + frame.signed_part + frame.signature[:7]).digest()[:6]
        if not hmac.compare_digest(expected, frame.signature[7:]):
            return "bad_signature"
        self._advance(t_ns)
        stamp = int.from_bytes(frame.signature[1:7], "little")
        stream_id = (frame.system, frame.component, frame.signature[0])
        stream = self._streams.get(stream_id)
        if stream is not None and stamp <= stream.timestamp:
            return "replayed"
        if stream is None and stamp + _TICKS_PER_MINUTE < self.timestamp:
            return "replayed"  # a new stream may be at most a minute behind us (MAVLink, message signing)
        if stream is not None and t_ns - stream.t_ns < _STREAM_ALIVE_NS:
            elapsed = (t_ns - stream.t_ns) // TICK_NS
            if stamp > stream.timestamp + elapsed + _TICKS_PER_MINUTE:
                return "future_stamped"
        self._streams[stream_id] = _Stream(stamp, t_ns)
        self.timestamp = max(self.timestamp, stamp)
        return None
