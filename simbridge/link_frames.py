"""As much of MAVLink as a fault on the link needs: which message a frame holds, and how to put a false number in it."""

from __future__ import annotations

from typing import Any

from pymavlink.dialects.v20 import development as mavlink

VISION = frozenset({mavlink.MAVLINK_MSG_ID_ODOMETRY, mavlink.MAVLINK_MSG_ID_VISION_POSITION_ESTIMATE})
SETPOINTS = frozenset(
    {mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED, mavlink.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET}
)
MESSAGES: dict[str, frozenset[int]] = {"vision": VISION, "setpoint": SETPOINTS}
MAVLINK2_START = 0xFD
SIGNED_FLAG = 0x01


def message_id(frame: bytes) -> int:
    """Of a MAVLink 2 or 1 frame; -1 where it is neither. Source: MAVLink serialization, packet format."""
    if len(frame) >= 12 and frame[0] == MAVLINK2_START:
        return int.from_bytes(frame[7:10], "little")
    return frame[5] if len(frame) >= 8 and frame[0] == 0xFE else -1


def bent(frame: bytes, by: float) -> bytes:
    """The same frame, sound in itself, with its x (vision) or velocity x (setpoint) off by `by`; others unchanged.

    A signed frame stays as it is: nobody on the link can alter it and sign it again.
    """
    kind = message_id(frame)
    if kind not in VISION | SETPOINTS or frame[0] != MAVLINK2_START or frame[2] & SIGNED_FLAG:
        return frame
    reader = mavlink.MAVLink(None)
    message: Any = reader.decode(bytearray(frame))
    name = "x" if kind in VISION else "vx"
    if not hasattr(message, name):
        return frame
    setattr(message, name, getattr(message, name) + by)
    writer = mavlink.MAVLink(None, srcSystem=frame[5], srcComponent=frame[6])
    writer.seq = frame[4]
    return bytes(message.pack(writer))
