"""Whom the companion believes: one autopilot, at one address. All else is counted, and what looks like a forgery is a
security event."""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable

from companion.mavlink import wire
from companion.mavlink.codec import Frame
from companion.messages import Event, Severity

_REPEAT_NS = 10_000_000_000
_MAX_REMEMBERED = 64
_SECURITY = {
    "wrong_address": "frames in the autopilot's name from another address",
    "our_own_name": "frames in the companion's own name",
    "second_autopilot": "a second autopilot on the link",
    "bad_signature": "frames with a wrong signature",
    "unsigned": "unsigned frames though signing is on",
    "mavlink1_while_signing": "MAVLink 1 frames, which cannot be signed, though signing is on",
    "replayed": "signed frames sent again",
    "future_stamped": "signed frames stamped far ahead",
}


class Sources:
    """Judges each frame by who says to have sent it and from where it came."""

    def __init__(self, system: int) -> None:
        self.system = system
        self.address: Hashable | None = None
        self.refused: Counter[str] = Counter()
        self._told: dict[tuple[str, Hashable], int] = {}

    def judge(self, frame: Frame, source: Hashable | None) -> str | None:
        """None when the frame is the autopilot's; else why it is not."""
        if frame.system != self.system:
            if frame.component == wire.COMP_AUTOPILOT and _is_autopilot_heartbeat(frame):
                return "second_autopilot"
            return "other_system"
        if frame.component in (wire.COMP_COMPANION, wire.COMP_ESTIMATOR):
            return "our_own_name"
        if frame.component != wire.COMP_AUTOPILOT:
            return "other_component"
        if source is not None and self.address is not None and source != self.address:
            return "wrong_address"
        if source is not None and self.address is None and _is_autopilot_heartbeat(frame):
            self.address = source
        return None

    def drop(self, reason: str) -> None:
        """Count a message whose content cannot be used."""
        self.refused[reason] += 1

    def release(self) -> None:
        """The link is lost: whoever answers next as the autopilot is taken."""
        self.address = None

    def refuse(self, reason: str, frame: Frame, source: Hashable | None, t_ns: int) -> list[Event]:
        """Count it; for a likely forgery an event, at most one each 10 s for a reason and source."""
        self.refused[reason] += 1
        what = _SECURITY.get(reason)
        if what is None:
            return []
        key = (reason, source)
        last = self._told.get(key)
        if last is not None and t_ns - last < _REPEAT_NS:
            return []
        if last is None and len(self._told) >= _MAX_REMEMBERED:
            self._told.clear()
        self._told[key] = t_ns
        where = f" from {source}" if source is not None else ""
        text = (
            f"Refused {what}{where}: system {frame.system}, component {frame.component}, "
            f"{wire.message_name(frame.msg_id)}; {self.refused[reason]} so far"
        )
        return [Event(t_ns=t_ns, severity=Severity.ALERT, name="security", text=text)]


def _is_autopilot_heartbeat(frame: Frame) -> bool:
    if frame.msg_id != wire.HEARTBEAT:
        return False
    _, _, autopilot, _, _, _ = wire.unpack(wire.HEARTBEAT, frame.payload)
    return autopilot in (wire.AUTOPILOT_PX4, wire.AUTOPILOT_ARDUPILOT)
