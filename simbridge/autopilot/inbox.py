"""What the emulated PX4 does with each message that arrives: commands, setpoints, vision, parameters, missions.

Rules: PX4's mavlink_receiver.cpp; answers as recorded in `handshake` and `wrong_input`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from simbridge.autopilot import events
from simbridge.autopilot.commander import (
    ACCEPTED,
    CRITICAL,
    DENIED,
    FAILED,
    FORCE,
    TEMPORARILY_REJECTED,
    UNSUPPORTED,
)
from simbridge.autopilot.modes import AUTO, Mode
from simbridge.autopilot.server import GROUND_STATION, Link
from simbridge.autopilot.streams import PACKERS
from simbridge.autopilot.vision import BODY_NED, LOCAL_NED, Refused, from_odometry, from_vision_position
from simbridge.autopilot.wire import LAYOUTS, Frame

if TYPE_CHECKING:
    from simbridge.autopilot.autopilot import Autopilot

NAN = math.nan
_SETPOINT = "SET_POSITION_TARGET_LOCAL_NED"
_MODE_COMMANDS = {20: Mode.RTL, 21: Mode.LAND, 22: Mode.TAKEOFF}
FTP_TERMINATE, FTP_RESET, FTP_ACK, FTP_NAK, FTP_NOT_FOUND = 1, 2, 128, 129, 10
FORCE_BIT, YAW_IGNORED, YAW_RATE_IGNORED = 512, 1024, 2048


class Inbox:
    """Handlers by message name."""

    def __init__(self, autopilot: Autopilot) -> None:
        self._a = autopilot
        self._handlers = {
            "ODOMETRY": self._odometry,
            "VISION_POSITION_ESTIMATE": self._vision_position,
            _SETPOINT: self._position_target,
            "TIMESYNC": self._timesync,
            "HEARTBEAT": self._heartbeat,
            "COMMAND_LONG": self._command_long,
            "COMMAND_INT": self._command_int,
            "SET_MODE": self._set_mode,
            "SET_GPS_GLOBAL_ORIGIN": self._origin,
            "PARAM_REQUEST_LIST": self._param_list,
            "PARAM_REQUEST_READ": self._param_read,
            "PARAM_SET": self._param_set,
            "PING": self._ping,
            "FILE_TRANSFER_PROTOCOL": self._file_transfer,
            "LOG_REQUEST_LIST": self._log_list,
        }

    def take(self, frame: Frame, link: Link, t_ns: int) -> None:
        """Act on one message. What is not for us, or not known, is passed over in silence."""
        if frame.system == 1 and frame.component == 1:
            return
        target = frame.fields.get("target_system", 0)
        if target not in (0, self._a.system) or frame.fields.get("target_component", 0) not in (0, 1):
            return
        handler = self._handlers.get(frame.name)
        if handler is not None:
            handler(frame, link, t_ns)
        elif frame.name.startswith("MISSION_"):
            self._a.missions.receive(frame.name, frame.fields, (frame.system, frame.component), link)

    # streams in

    def _heartbeat(self, frame: Frame, link: Link, t_ns: int) -> None:
        kind = frame.fields["type"]
        link.heartbeat(frame.system, frame.component, kind, t_ns)
        if kind == GROUND_STATION:
            self._a.commander.ground_station_ns = t_ns

    def _timesync(self, frame: Frame, link: Link, t_ns: int) -> None:
        f = frame.fields
        if f["tc1"] == 0:
            link.send("TIMESYNC", tc1=self._a.boot_ns, ts1=f["ts1"])
        else:
            link.timesync.answer(f["ts1"], f["tc1"], self._a.boot_ns)

    def _ping(self, frame: Frame, link: Link, t_ns: int) -> None:
        f = frame.fields
        if f["target_system"] == 0:
            link.send(
                "PING",
                time_usec=f["time_usec"],
                seq=f["seq"],
                target_system=frame.system,
                target_component=frame.component,
            )

    def _file_transfer(self, frame: Frame, link: Link, t_ns: int) -> None:
        """MAVLink FTP of a vehicle without files: sessions end, everything else is not found (NAK 10)."""
        request = frame.fields["payload"]
        sequence = (request[0] | request[1] << 8) + 1
        payload = [0] * 251
        payload[0:2] = (sequence & 0xFF, sequence >> 8 & 0xFF)
        payload[2], payload[5] = request[2], request[3]
        if request[3] in (FTP_TERMINATE, FTP_RESET):
            payload[3] = FTP_ACK
        else:
            payload[3], payload[4], payload[12] = FTP_NAK, 1, FTP_NOT_FOUND
        link.send(
            "FILE_TRANSFER_PROTOCOL", target_system=frame.system, target_component=frame.component, payload=payload
        )

    def _log_list(self, frame: Frame, link: Link, t_ns: int) -> None:
        link.send("LOG_ENTRY")  # num_logs 0: this vehicle keeps none

    def _odometry(self, frame: Frame, link: Link, t_ns: int) -> None:
        stamp = link.timesync.stamp(frame.fields["time_usec"] * 1000, self._a.boot_ns)
        sample = from_odometry(frame.fields, stamp)
        if isinstance(sample, Refused):
            if sample.text is not None:
                self._a.tell(CRITICAL, sample.text, events.unsupported_estimator(frame.fields["estimator_type"]))
            return
        self._a.ekf.add_vision(sample)

    def _vision_position(self, frame: Frame, link: Link, t_ns: int) -> None:
        stamp = link.timesync.stamp(frame.fields["usec"] * 1000, self._a.boot_ns)
        self._a.ekf.add_vision(from_vision_position(frame.fields, stamp))

    def _position_target(self, frame: Frame, link: Link, t_ns: int) -> None:
        f = frame.fields
        mask, kind = f["type_mask"], f["coordinate_frame"]
        if kind not in (LOCAL_NED, BODY_NED):
            self._a.tell(CRITICAL, f"{_SETPOINT} coordinate frame {kind} unsupported\t")
            return
        sp = [
            NAN if mask & (1 << i) or not math.isfinite(f[n]) else f[n]
            for i, n in enumerate(("x", "y", "z", "vx", "vy", "vz", "afx", "afy", "afz"))
        ]
        if kind == BODY_NED:
            sp[0:3] = [NAN] * 3
            for first in (3, 6):
                sp[first : first + 3] = self._turned(sp[first : first + 3])
        if all(math.isnan(v) for v in sp):
            self._a.tell(CRITICAL, f"{_SETPOINT} invalid\t")
            return
        has_acceleration = any(not math.isnan(v) for v in sp[6:9])
        if mask & FORCE_BIT and has_acceleration:
            self._a.tell(CRITICAL, f"{_SETPOINT} force not supported\t")
            return
        sp.append(NAN if mask & YAW_IGNORED or not math.isfinite(f["yaw"]) else f["yaw"])
        sp.append(NAN if mask & YAW_RATE_IGNORED or not math.isfinite(f["yaw_rate"]) else f["yaw_rate"])
        self._a.tasks.offboard[:] = sp
        position = any(not math.isnan(v) for v in sp[0:3])
        velocity = any(not math.isnan(v) for v in sp[3:6])
        self._a.commander.signal.note(t_ns, position=position, velocity=velocity and not position)
        self._a.commander.now_ns = t_ns

    def _turned(self, v: list[float]) -> list[float]:
        """Horizontal axes of the body's heading to north and east; all three are needed."""
        if any(math.isnan(c) for c in v):
            return [NAN] * 3
        yaw = self._a.ekf.yaw_rad
        c, s = math.cos(yaw), math.sin(yaw)
        return [c * v[0] - s * v[1], s * v[0] + c * v[1], v[2]]

    def _origin(self, frame: Frame, link: Link, t_ns: int) -> None:
        f = frame.fields
        if abs(f["latitude"]) > 90 * 10**7 or abs(f["longitude"]) > 180 * 10**7:
            return
        self._a.ekf.set_origin(f["latitude"] * 1e-7, f["longitude"] * 1e-7, f["altitude"] * 1e-3)
        for each in self._a.links.values():
            each.send_stream(self._a, "GPS_GLOBAL_ORIGIN")

    # parameters

    def _param_list(self, frame: Frame, link: Link, t_ns: int) -> None:
        self._a.parameters.list_all(link)

    def _param_read(self, frame: Frame, link: Link, t_ns: int) -> None:
        self._a.parameters.read(link, frame.fields, frame.system, frame.component)

    def _param_set(self, frame: Frame, link: Link, t_ns: int) -> None:
        self._a.parameters.set(link, frame.fields, frame.system, frame.component, t_ns)

    # commands

    def _set_mode(self, frame: Frame, link: Link, t_ns: int) -> None:
        custom = frame.fields["custom_mode"]
        self._a.commander.now_ns = t_ns
        self._a.commander.request_mode_number(custom >> 16 & 0xFF, custom >> 24 & 0xFF)

    def _command_long(self, frame: Frame, link: Link, t_ns: int) -> None:
        f = frame.fields
        self._command(f["command"], [f[f"param{i}"] for i in range(1, 8)], frame, link, t_ns)

    def _command_int(self, frame: Frame, link: Link, t_ns: int) -> None:
        f = frame.fields
        p = [f["param1"], f["param2"], f["param3"], f["param4"], f["x"] * 1e-7, f["y"] * 1e-7, f["z"]]
        self._command(f["command"], p, frame, link, t_ns)

    def _command(self, command: int, p: list[float], frame: Frame, link: Link, t_ns: int) -> None:
        self._a.commander.now_ns = t_ns
        result = self._result(command, p, link, t_ns)
        link.send(
            "COMMAND_ACK",
            command=command,
            result=result,
            target_system=frame.system,
            target_component=frame.component,
        )

    def _result(self, command: int, p: list[float], link: Link, t_ns: int) -> int:
        c = self._a.commander
        if command == 176:  # DO_SET_MODE
            if not _whole(p[0]) & 1:
                return TEMPORARILY_REJECTED
            return c.request_mode_number(_whole(p[1]), _whole(p[2]))
        if command == 400:  # COMPONENT_ARM_DISARM
            if p[0] not in (0.0, 1.0):
                return DENIED
            return c.request_arm(p[0] == 1.0, p[1] == FORCE)
        if command in _MODE_COMMANDS:
            return c.request_mode(_MODE_COMMANDS[command])
        if command == 511:  # SET_MESSAGE_INTERVAL
            return ACCEPTED if link.set_interval(_whole(p[0]), p[1], t_ns) else FAILED
        if command == 510:  # GET_MESSAGE_INTERVAL
            msgid = _whole(p[0])
            link.send("MESSAGE_INTERVAL", message_id=msgid & 0xFFFF, interval_us=link.interval_us(msgid))
            return ACCEPTED
        if command == 512:  # REQUEST_MESSAGE
            return self._request_message(_whole(p[0]), link)
        if command == 192:  # DO_REPOSITION: only "stop here" is known
            return c.request_mode_number(AUTO, 3)
        if command == 246:  # PREFLIGHT_REBOOT_SHUTDOWN
            if c.is_armed or p[0] != 1.0:
                return DENIED
            self._a.request_reboot()
            return ACCEPTED
        return UNSUPPORTED

    def _request_message(self, msgid: int, link: Link) -> int:
        name = LAYOUTS[msgid].name if msgid in LAYOUTS else ""
        if name in PACKERS:
            return ACCEPTED if link.send_stream(self._a, name) else DENIED
        return DENIED


def _whole(value: float) -> int:
    return int(value) if math.isfinite(value) else -1
