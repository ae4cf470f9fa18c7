"""Texts of the PX4 events (MAVLink EVENT, 410) that matter to a companion, by id.

An id is 1 << 24 (component autopilot) plus the low 24 bits of FNV-1a of the event's name, as PX4's libevents make it.
"""

from __future__ import annotations


def event_id(name: str) -> int:
    """The id of a PX4 event by its name."""
    value = 0x811C9DC5
    for byte in name.encode():
        value = (value ^ byte) * 0x01000193 & 0xFFFFFFFF
    return 1 << 24 | value & 0xFFFFFF


_TEXTS = {
    "commander_failsafe_enter_generic": "Failsafe activated",
    "commander_landing_detected": "Landing detected",
    "commander_takeoff_detected": "Takeoff detected",
}
EVENT_TEXTS = {event_id(name): text for name, text in _TEXTS.items()}
