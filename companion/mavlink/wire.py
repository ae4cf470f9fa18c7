"""Which MAVLink messages the companion speaks, and their layout: the generated dialect's own, plus what it lacks."""

from __future__ import annotations

import struct
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as dialect

# Components (MAV_COMPONENT) and types that the companion uses.
COMP_AUTOPILOT = 1
COMP_COMPANION = 191  # MAV_COMP_ID_ONBOARD_COMPUTER
COMP_ESTIMATOR = 197  # MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
TYPE_GCS = 6
TYPE_ONBOARD_CONTROLLER = 18
AUTOPILOT_ARDUPILOT = 3
AUTOPILOT_PX4 = 12
AUTOPILOT_INVALID = 8

HEARTBEAT = 0
SYS_STATUS = 1
PARAM_REQUEST_READ = 20
PARAM_VALUE = 22
ATTITUDE_QUATERNION = 31
LOCAL_POSITION_NED = 32
GLOBAL_POSITION_INT = 33
SET_GPS_GLOBAL_ORIGIN = 48
GPS_GLOBAL_ORIGIN = 49
VFR_HUD = 74
COMMAND_LONG = 76
COMMAND_ACK = 77
SET_POSITION_TARGET_LOCAL_NED = 84
TIMESYNC = 111
DISTANCE_SENSOR = 132
ALTITUDE = 141
BATTERY_STATUS = 147
EKF_STATUS_REPORT = 193
ESTIMATOR_STATUS = 230
EXTENDED_SYS_STATE = 245
STATUSTEXT = 253
OBSTACLE_DISTANCE = 330
ODOMETRY = 331
PARAM_ERROR = 345
ONBOARD_COMPUTER_STATUS = 390
EVENT = 410
CURRENT_MODE = 436

CMD_NAV_TAKEOFF = 22
CMD_DO_SET_MODE = 176
CMD_COMPONENT_ARM_DISARM = 400
CMD_SET_MESSAGE_INTERVAL = 511
CMD_REQUEST_MESSAGE = 512

# CRC_EXTRA of messages that PX4 sends and no dialect of pymavlink 2.4.50 knows; each verified on every such frame of
# the recorded conversations. Without it a frame cannot be told from noise.
_EXTRA_CRC = {8: 117, 290: 251, 291: 10, 380: 232, 397: 182, 410: 160, 411: 106, 436: 193, 441: 169, 514: 197}

_CLASSES: dict[int, Any] = dialect.mavlink_map
CRC_EXTRA: dict[int, int] = {**_EXTRA_CRC, **{msg_id: int(cls.crc_extra) for msg_id, cls in _CLASSES.items()}}

# id u32, event_time_boot_ms u32, sequence u16, destination component u8, system u8, log levels u8, arguments u8[40]
_EVENT_LAYOUT = struct.Struct("<IIHBBB40s")  # MAVLink common.xml, EVENT
_CURRENT_MODE_LAYOUT = struct.Struct("<IIB")  # custom_mode, intended_custom_mode, standard_mode


def layout(msg_id: int) -> struct.Struct:
    """The payload's fields in wire order (largest first, extensions last)."""
    if msg_id == EVENT:
        return _EVENT_LAYOUT
    if msg_id == CURRENT_MODE:
        return _CURRENT_MODE_LAYOUT
    unpacker: struct.Struct = _CLASSES[msg_id].unpacker
    return unpacker


_LAYOUTS = {
    msg_id: layout(msg_id)
    for msg_id in (
        HEARTBEAT,
        SYS_STATUS,
        PARAM_REQUEST_READ,
        PARAM_VALUE,
        ATTITUDE_QUATERNION,
        LOCAL_POSITION_NED,
        SET_GPS_GLOBAL_ORIGIN,
        GPS_GLOBAL_ORIGIN,
        COMMAND_LONG,
        COMMAND_ACK,
        SET_POSITION_TARGET_LOCAL_NED,
        TIMESYNC,
        DISTANCE_SENSOR,
        BATTERY_STATUS,
        EKF_STATUS_REPORT,
        ESTIMATOR_STATUS,
        EXTENDED_SYS_STATE,
        STATUSTEXT,
        OBSTACLE_DISTANCE,
        ODOMETRY,
        PARAM_ERROR,
        EVENT,
        CURRENT_MODE,
    )
}


def unpack(msg_id: int, payload: bytes) -> tuple[Any, ...]:
    """Fields in wire order. A short payload is filled with zeros: MAVLink 2 cuts them off; a longer one is of a newer
    definition and its tail is not ours."""
    fields = _LAYOUTS[msg_id]
    size = fields.size
    if len(payload) != size:
        payload = payload[:size].ljust(size, b"\0")
    return fields.unpack(payload)


def pack(msg_id: int, *fields: Any) -> bytes:
    """The payload for fields in wire order."""
    return _LAYOUTS[msg_id].pack(*fields)


def message_name(msg_id: int) -> str:
    """For people: ODOMETRY, or UNKNOWN_514."""
    cls = _CLASSES.get(msg_id)
    return (
        str(cls.msgname)
        if cls is not None
        else {EVENT: "EVENT", CURRENT_MODE: "CURRENT_MODE"}.get(msg_id, f"UNKNOWN_{msg_id}")
    )
