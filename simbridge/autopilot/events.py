"""EVENT (410): what PX4 says to every link, a companion alone included, where STATUSTEXT wants a ground station.

No dialect of pymavlink 2.4.50 knows the message; layout and CRC byte are those of MAVLink's common.xml. Only the events of
arming, modes, take-off, landing and failsafes are sent; PX4's periodic arming-check summaries are not.
"""

from __future__ import annotations

from dataclasses import dataclass
from struct import Struct

from simbridge.autopilot.wire import Layout

DESCEND = 8
LAYOUT = Layout(410, "EVENT", bytes([160]), Struct("<IIHBBB40s"), {}, frozenset())


def event_id(name: str) -> int:
    """libevents: component autopilot (1) and the low 24 bits of FNV-1a of the name."""
    value = 0x811C9DC5
    for byte in name.encode():
        value = ((value ^ byte) * 0x01000193) & 0xFFFFFFFF
    return 1 << 24 | value & 0xFFFFFF


@dataclass(frozen=True, slots=True)
class Event:
    """levels: log level inside (high) and outside (low nibble), as recorded."""

    id: int
    levels: int
    arguments: bytes = b""


def armed() -> Event:
    return Event(event_id("commander_armed_by"), 0x66, b"\x04")  # by an external command


def disarmed(by_landing: bool) -> Event:
    return Event(event_id("commander_disarmed_by"), 0x66, b"\x06" if by_landing else b"\x04")


def arming_denied() -> Event:
    return Event(event_id("commander_arm_denied_resolve_failures"), 0x62)


def landing(landed: bool) -> Event:
    return Event(event_id("commander_landing_detected" if landed else "commander_takeoff_detected"), 0x66)


def unsupported_main_mode() -> Event:
    return Event(event_id("commander_unsupported_main_mode"), 0x33)


def no_offboard_signal() -> Event:
    return Event(event_id("check_modes_offboard_signal_lost"), 0x33, bytes.fromhex("0040000014"))


def failsafe(custom_mode: int, action: int) -> Event:
    """A failsafe took over from the mode asked for. action: of PX4's framework, 5 Hold, 6 Return, 7 Land, 8 Descend."""
    name = "commander_failsafe_enter_autopilot_disengaged" if action == DESCEND else "commander_failsafe_enter_generic"
    return Event(event_id(name), 0x42, custom_mode.to_bytes(4, "little") + bytes([action]))


def unsupported_estimator(kind: int) -> Event:
    return Event(event_id("mavlink_rcv_odom_unsup_estimator_type"), 0x33, bytes([kind]))
