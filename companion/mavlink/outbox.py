"""Frames waiting to leave: each component counts its own sequence; signed when signing is on."""

from __future__ import annotations

from collections import deque

from companion.mavlink import wire
from companion.mavlink.codec import encode
from companion.mavlink.signing import Signer

_LIMIT = 512  # nobody takes them: the oldest go first


class Outbox:
    def __init__(self, system: int, signer: Signer | None) -> None:
        self._system = system
        self._signer = signer
        self._sequence = dict.fromkeys((wire.COMP_COMPANION, wire.COMP_ESTIMATOR), 0)
        self._frames: deque[bytes] = deque(maxlen=_LIMIT)

    def put(self, msg_id: int, payload: bytes, t_ns: int, component: int = wire.COMP_COMPANION) -> None:
        sequence = self._sequence[component]
        self._sequence[component] = (sequence + 1) & 0xFF
        frame = encode(
            msg_id,
            payload,
            system=self._system,
            component=component,
            sequence=sequence,
            is_signed=self._signer is not None,
        )
        self._frames.append(self._signer.sign(frame, t_ns) if self._signer is not None else frame)

    def take(self) -> list[bytes]:
        frames = list(self._frames)
        self._frames.clear()
        return frames
