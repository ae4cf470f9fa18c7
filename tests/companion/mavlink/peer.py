"""The other end of the link, made by pymavlink: what the session sends is read by code that is not ours, and what it
hears was packed by code that is not ours."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as m

from companion.config import MavlinkConfig
from companion.mavlink.manifest import ARDUPILOT_MANIFEST, PX4_MANIFEST
from companion.mavlink.session import MavlinkSession, Received
from companion.messages import Event, OdometryEstimate, RequestKind, Setpoint, SetpointKind, VehicleRequest

SECOND = 1_000_000_000
MS = 1_000_000
OUR_START_NS = 5_000 * SECOND  # our clock runs far ahead of the autopilot's on purpose
PX4_OFFBOARD = 6 << 16
PX4_HOLD = 4 << 16 | 3 << 24
PX4_LAND = 4 << 16 | 6 << 24
PX4_POSITION = 3 << 16
PX4_FUSED = 511
PX4_NOT_FUSED = 229
AP_FUSED = 0x33F
AP_NOT_FUSED = 0x0A7
PX4_GOOD = {expected.name: expected.mend for expected in PX4_MANIFEST.parameters}
ARDUPILOT_GOOD = {expected.name: expected.mend for expected in ARDUPILOT_MANIFEST.parameters}


def packer(system: int = 1, component: int = 1) -> Any:
    return m.MAVLink(None, srcSystem=system, srcComponent=component)


def parse(frames: list[bytes]) -> list[Any]:
    """Read by pymavlink; a damaged frame would raise."""
    reader = m.MAVLink(None)
    return [reader.decode(bytearray(frame)) for frame in frames]


def heartbeat(autopilot: int = 12, custom_mode: int = PX4_HOLD, armed: bool = False, status: int = 3) -> Any:
    return m.MAVLink_heartbeat_message(2, autopilot, 29 | (128 if armed else 0), custom_mode, status, 3)


def estimator_status(flags: int) -> Any:
    return m.MAVLink_estimator_status_message(0, flags, 0, 0, 0, 0, 0, 0, 0, 0)


def ekf_report(flags: int) -> Any:
    return m.MAVLink_ekf_status_report_message(flags, 0, 0, 0, 0, 0)


def attitude(boot_ms: int, q: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)) -> Any:
    return m.MAVLink_attitude_quaternion_message(boot_ms, *q, 0.0, 0.0, 0.0)


def estimate(t_ns: int, **changes: Any) -> OdometryEstimate:
    fields: dict[str, Any] = {
        "t_ns": t_ns,
        "t_scan_ns": t_ns,
        "position_map_m": np.zeros(3),
        "q_map_body_wxyz": np.array([1.0, 0.0, 0.0, 0.0]),
        "velocity_body_mps": np.zeros(3),
        "rate_body_radps": np.zeros(3),
        "pose_covariance": np.eye(6) * 0.01,
        "velocity_covariance": np.eye(3) * 0.01,
        "quality": 90,
        "reset_counter": 0,
        "converged": True,
        "is_degenerate": False,
        "inliers": 400,
        "iterations": 5,
        "keyframe_id": 0,
        "is_keyframe": False,
    }
    return OdometryEstimate(**{**fields, **changes})


def setpoint(t_ns: int, velocity: tuple[float, float, float] = (0.0, 0.0, 0.0), yaw_rate: float = 0.0) -> Setpoint:
    kind = SetpointKind.VELOCITY
    return Setpoint(t_ns=t_ns, kind=kind, velocity_map_mps=np.array(velocity), yaw_rate_radps=yaw_rate)


class Peer:
    """A session and an autopilot that answers as told, on one clock of ours. `boot_ns`: the autopilot's own clock.

    ack: MAV_RESULT for every command, None: it does not answer. origin: it has one. answers_origin_after: how many
    SET_GPS_GLOBAL_ORIGIN it ignores first.
    """

    def __init__(self, autopilot: int = 12, *, signer: Any = None) -> None:
        self.session = MavlinkSession(MavlinkConfig(), signer=signer)
        self.autopilot = autopilot
        self.t_ns = OUR_START_NS
        self.boot_ns = 3 * SECOND
        self.ack: int | None = 0
        self.has_origin = False
        self.answers_origin_after = 0
        self.custom_mode = PX4_HOLD if autopilot == 12 else 0
        self.armed = False
        self.status = 3
        self.flags = PX4_NOT_FUSED if autopilot == 12 else AP_NOT_FUSED
        self.streams_attitude = True
        self.answers_timesync = True
        self.q = (1.0, 0.0, 0.0, 0.0)
        self.silent = False
        self.parameters: dict[str, float] = dict(PX4_GOOD if autopilot == 12 else ARDUPILOT_GOOD)
        self.answers_parameters = True
        self.sent: list[Any] = []  # what the session sent, as pymavlink read it
        self.events: list[Event] = []
        self.received: list[Received] = []
        self._mav = packer()
        self._origins_ignored = 0

    def say(self, message: Any, source: Any = None) -> list[Received]:
        """The autopilot sends a message."""
        data = message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256
        return self.hear(data, source)

    def hear(self, data: bytes, source: Any = None) -> list[Received]:
        out = self.session.receive(bytes(data), self.t_ns, source)
        self.received.extend(out)
        self.events.extend(event for event in out if isinstance(event, Event))
        return out

    def take(self) -> list[Any]:
        """What the session wants to send now."""
        messages = parse(self.session.data_to_send())
        self.sent.extend(messages)
        return messages

    def run(self, seconds: float, *, vision: bool = False, setpoints: bool = False) -> None:
        """Both go on for so long in steps of 4 ms: streams, heartbeats, answers."""
        for _ in range(round(seconds * 250)):
            self.step(vision=vision, setpoints=setpoints)

    def step(self, *, vision: bool = False, setpoints: bool = False) -> None:
        self.t_ns += 4 * MS
        self.boot_ns += 4 * MS
        tick = self.boot_ns // (4 * MS)
        if not self.silent:
            self._stream(tick)
        if vision and tick % 8 == 0:
            self.session.send_odometry(estimate(self.t_ns))
        if setpoints and tick % 12 == 0:
            self.session.send_setpoint(setpoint(self.t_ns))
        if self.t_ns >= self.session.next_deadline_ns():
            self.session.poll(self.t_ns)
        for message in self.take():
            if not self.silent:
                self._answer(message)
        self.events.extend(self.session.take_events())

    def _stream(self, tick: int) -> None:
        if tick % 250 == 0:
            self.say(heartbeat(self.autopilot, self.custom_mode, self.armed, self.status))
        if tick % 125 == 0:
            self.say(estimator_status(self.flags) if self.autopilot == 12 else ekf_report(self.flags))
        if tick % 5 == 0 and self.streams_attitude:
            self.say(attitude(self.boot_ns // MS, self.q))
        if tick % 25 == 0 and self.autopilot == 12:
            self.say(m.MAVLink_timesync_message(0, self.boot_ns))

    def _answer(self, message: Any) -> None:
        name = message.get_type()
        if name == "TIMESYNC" and message.tc1 == 0 and self.answers_timesync:
            self.say(m.MAVLink_timesync_message(self.boot_ns, message.ts1))
        elif name == "COMMAND_LONG":
            if message.command == 512 and self.has_origin:
                self._say_origin()
            if self.ack is not None:
                self.say(m.MAVLink_command_ack_message(message.command, self.ack, 0, 0, 1, 191))
        elif name == "PARAM_REQUEST_READ" and self.answers_parameters:
            self.say_parameter(message.param_id)
        elif name == "SET_GPS_GLOBAL_ORIGIN":
            if self._origins_ignored < self.answers_origin_after:
                self._origins_ignored += 1
            else:
                self.has_origin = True
                self._say_origin()

    def say_parameter(self, name: str) -> None:
        """PX4: integers bytewise, an error for what it does not have. ArduPilot: cast, no answer at all."""
        value = self.parameters.get(name)
        if value is None:
            if self.autopilot == 12:
                self.say(m.MAVLink_param_error_message(255, 190, name.encode(), -1, 1))
            return
        is_real = value != int(value) or name in (
            "COM_OF_LOSS_T",
            "RTL_RETURN_ALT",
            "GF_MAX_HOR_DIST",
            "GF_MAX_VER_DIST",
        )
        if self.autopilot == 12 and not is_real:
            (wired,) = struct.unpack("<f", struct.pack("<i", int(value)))
        else:
            wired = value
        self.say(m.MAVLink_param_value_message(name.encode(), wired, 9 if is_real else 6, 900, 65535))

    def _say_origin(self) -> None:
        self.say(m.MAVLink_gps_global_origin_message(474000000, 85000000, 0, 0))

    def make_ready(self) -> None:
        """All that arming needs: handshake, 50 s of time sync, vision fused."""
        self.run(3.0)
        self.flags = PX4_FUSED if self.autopilot == 12 else AP_FUSED
        self.run(52.0 if self.autopilot == 12 else 3.0, vision=True)

    def request(self, kind: RequestKind) -> None:
        self.session.request(VehicleRequest(t_ns=self.t_ns, kind=kind))

    def of(self, name: str) -> list[Any]:
        """All messages of a type that the session has sent."""
        return [message for message in self.sent if message.get_type() == name]

    def event_names(self) -> list[str]:
        return [event.name for event in self.events]
