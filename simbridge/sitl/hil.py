"""PX4's simulator link, without the socket: sensor frames out, motor commands in.

HIL_SENSOR.time_usec sets PX4's clock, and from its first answer on PX4 sends exactly one HIL_ACTUATOR_CONTROLS for each
HIL_SENSOR, with the same time. Sources: PX4 `simulator_mavlink/SimulatorMavlink.cpp`; MAVLink common, messages 107, 93,
132; the recording hil_lockstep.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import common as mavlink

from simbridge.sensors import BaroSample, ImuSample
from simbridge.sitl.rates import Beat, HeldRange

Array = NDArray[np.float64]

ACCEL_FIELDS = 0x007
GYRO_FIELDS = 0x038
MAG_FIELDS = 0x1C0
BARO_FIELDS = 0x1A00  # pressure, its altitude, temperature: PX4 takes the barometer only with all three
SYSTEM_ID, COMPONENT_ID = 1, 51  # as the recorded simulator
MAV_SENSOR_ROTATION_PITCH_270 = 25  # looking down
NO_RETURN_CM = 65535
RANGEFINDER_PERIOD_NS = 50_000_000
HEARTBEAT_PERIOD_NS = 1_000_000_000
MAV_CMD_SET_MESSAGE_INTERVAL = 511
MOTORS = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class ActuatorControls:
    """One HIL_ACTUATOR_CONTROLS.

    motors: (4,) float64, 0..1, in PX4's order; all 0 while disarmed. t_us: the time of the HIL_SENSOR that it answers.
    """

    t_us: int
    motors: Array
    is_armed: bool
    is_lockstep: bool


class HilLink:
    """Both directions of one connection. Give it a new instance for each connection: PX4 starts anew with it."""

    def __init__(self, *, rangefinder_min_m: float = 0.2, rangefinder_max_m: float = 50.0) -> None:
        """rangefinder_min_m, rangefinder_max_m: what DISTANCE_SENSOR says of the sensor; metres."""
        self._rangefinder_limits_cm = (round(rangefinder_min_m * 100), round(rangefinder_max_m * 100))
        self._mav = mavlink.MAVLink(None, srcSystem=SYSTEM_ID, srcComponent=COMPONENT_ID)
        self._mav.robust_parsing = True
        self._rangefinder = HeldRange()
        self._rangefinder_beat = Beat(RANGEFINDER_PERIOD_NS)
        self._heartbeat_beat = Beat(HEARTBEAT_PERIOD_NS)
        self.truth_period_ns: int | None = None
        self.heartbeats = 0
        self.dropped: Counter[str] = Counter()

    def sensor_frames(
        self,
        t_ns: int,
        imu: ImuSample,
        baro: BaroSample | None,
        rangefinder_m: float | None,
        mag_frd_gauss: Array | None = None,
    ) -> bytes:
        """What goes to PX4 for one step: HIL_SENSOR last, since it is what moves PX4's clock.

        Args:
            t_ns: simulated time since boot; becomes PX4's clock, in whole microseconds.
            baro, rangefinder_m: None where they did not measure in this step.
            mag_frd_gauss: (3,), or None for a vehicle without one.
        """
        frames = []
        if self._heartbeat_beat.due(t_ns):
            frames.append(self._heartbeat())
        held_m = self._rangefinder.update(t_ns, rangefinder_m)
        if self._rangefinder_beat.due(t_ns):
            frames.append(self._distance_sensor(t_ns, held_m))
        frames.append(self.hil_sensor(t_ns, imu, baro, mag_frd_gauss))
        return b"".join(frames)

    def hil_sensor(
        self, t_ns: int, imu: ImuSample, baro: BaroSample | None, mag_frd_gauss: Array | None = None
    ) -> bytes:
        """One HIL_SENSOR frame; what was not measured is 0 and its bits in fields_updated are too."""
        fields = ACCEL_FIELDS | GYRO_FIELDS
        mag = (0.0, 0.0, 0.0)
        if mag_frd_gauss is not None:
            fields |= MAG_FIELDS
            mag = tuple(mag_frd_gauss.tolist())
        pressure, altitude, temperature = 0.0, 0.0, 0.0
        if baro is not None:
            fields |= BARO_FIELDS
            pressure, altitude, temperature = baro.pressure_hpa, baro.pressure_altitude_m, baro.temperature_c
        accel, gyro = imu.accel_frd_mps2.tolist(), imu.gyro_frd_radps.tolist()
        message = mavlink.MAVLink_hil_sensor_message(
            t_ns // 1000, *accel, *gyro, *mag, pressure, 0.0, altitude, temperature, fields, 0
        )
        return self._pack(message)

    def receive(self, data: bytes) -> list[ActuatorControls]:
        """The motor commands among what PX4 sent, in order. What cannot be read is counted in `dropped`."""
        controls = []
        for message in self._mav.parse_buffer(data) or ():
            kind = message.get_type()
            if kind == "HIL_ACTUATOR_CONTROLS":
                controls += self._actuator_controls(message)
            elif kind == "HEARTBEAT":
                self.heartbeats += 1
            elif kind == "COMMAND_LONG" and message.command == MAV_CMD_SET_MESSAGE_INTERVAL:
                self._set_interval(message)
            else:
                self.dropped[kind.lower()] += 1
        return controls

    def _actuator_controls(self, message: mavlink.MAVLink_hil_actuator_controls_message) -> list[ActuatorControls]:
        motors = message.controls[:MOTORS]
        if not all(map(math.isfinite, motors)):
            self.dropped["not_finite"] += 1
            return []
        return [
            ActuatorControls(
                t_us=message.time_usec,
                motors=np.clip(np.array(motors, dtype=np.float64), 0.0, 1.0),
                is_armed=bool(message.mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED),
                is_lockstep=bool(message.flags & 1),
            )
        ]

    def _set_interval(self, message: mavlink.MAVLink_command_long_message) -> None:
        """PX4 asks for ground truth (115) on connecting. It flies without, and is not given any: only noted."""
        if message.param1 == mavlink.MAVLINK_MSG_ID_HIL_STATE_QUATERNION and message.param2 > 0:
            self.truth_period_ns = int(message.param2) * 1000
        else:
            self.dropped["set_message_interval"] += 1

    def _heartbeat(self) -> bytes:
        return self._pack(
            mavlink.MAVLink_heartbeat_message(
                mavlink.MAV_TYPE_GENERIC, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE, 3
            )
        )

    def _distance_sensor(self, t_ns: int, distance_m: float | None) -> bytes:
        low, high = self._rangefinder_limits_cm
        quality = 100 if distance_m is not None else 1  # 1: invalid signal (0 would be unknown)
        current = NO_RETURN_CM if distance_m is None else min(max(round(distance_m * 100), 0), NO_RETURN_CM)
        return self._pack(
            mavlink.MAVLink_distance_sensor_message(
                time_boot_ms=t_ns // 1_000_000 & 0xFFFFFFFF,
                min_distance=low,
                max_distance=high,
                current_distance=current,
                type=mavlink.MAV_DISTANCE_SENSOR_LASER,
                id=0,
                orientation=MAV_SENSOR_ROTATION_PITCH_270,
                covariance=0,
                signal_quality=quality,
            )
        )

    def _pack(self, message: mavlink.MAVLink_message) -> bytes:
        frame: bytes = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        return frame
