"""ArduPilot's JSON physics backend, without the socket: servo packets in, one line of JSON out for each.

Sources: ArduPilot `libraries/SITL/SIM_JSON.cpp`; the recordings json_physics. A packet whose frame count was answered
before is the autopilot asking again (each 1.1 s of silence): it gets the same answer, and nothing moves. The stamps of
the answers are the autopilot's clock, so they start at 0 for each start of the autopilot and never go back.
"""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SERVO_PACKET = struct.Struct("<HHI16H")  # magic, frame rate, frame count, pulse widths
MAGIC = 18458
MOTORS = 4
PWM_MIN_US, PWM_SPAN_US = 1000, 1000
NO_RETURN_M = 1000.0  # above any RNGFND1_MAX: out of range high


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoPacket:
    """One request of the autopilot. pwm_us: 16 pulse widths, 0 where an output is off. is_repeat: answered before, so
    it may only be answered again, without stepping. is_restart: the autopilot began anew."""

    rate_hz: int
    count: int
    pwm_us: tuple[int, ...]
    is_repeat: bool
    is_restart: bool

    def controls(self) -> Array:
        """(4,) 0..1 in motor order, 0 for an output that is off."""
        return np.array([min(max((pwm - PWM_MIN_US) / PWM_SPAN_US, 0.0), 1.0) for pwm in self.pwm_us[:MOTORS]])


@dataclass(frozen=True, slots=True, kw_only=True)
class PhysicsState:
    """What the autopilot is told. FRD body, NED from the place of the start; accel is specific force.

    gyro_radps, accel_mps2, position_m, velocity_mps: (3,). q_ned_frd_wxyz: (4,) unit. rangefinder_m: None: no return.
    """

    gyro_radps: Array
    accel_mps2: Array
    position_m: Array
    q_ned_frd_wxyz: Array
    velocity_mps: Array
    rangefinder_m: float | None = None


class JsonPhysics:
    """Tells new frames from repeated ones and keeps the clock of the answers."""

    def __init__(self, *, sends_rangefinder: bool = True) -> None:
        self.time_s = 0.0
        self.dropped: Counter[str] = Counter()
        self._sends_rangefinder = sends_rangefinder
        self._count: int | None = None
        self._answered: int | None = None
        self._last_reply: bytes | None = None

    def receive(self, datagram: bytes) -> ServoPacket | None:
        """The request in a datagram; None (and counted in `dropped`) if it is none."""
        if len(datagram) != SERVO_PACKET.size:
            self.dropped["length"] += 1
            return None
        magic, rate, count, *_ = fields = SERVO_PACKET.unpack(datagram)
        if magic != MAGIC or rate == 0:
            self.dropped["magic" if magic != MAGIC else "rate"] += 1
            return None
        is_restart = self._count is not None and count < self._count
        is_repeat = count == self._answered
        if is_restart:
            self.time_s, self._answered = 0.0, None
        self._count = count
        return ServoPacket(rate_hz=rate, count=count, pwm_us=fields[3:], is_repeat=is_repeat, is_restart=is_restart)

    def reply(self, state: PhysicsState, step_s: float) -> bytes:
        """The answer to the newest request, step_s (> 0) after the one before."""
        if not step_s > 0:
            raise ValueError(f"step_s: the autopilot's clock may only go forward, got {step_s}")
        self.time_s += step_s
        self._answered = self._count
        self._last_reply = encode(self.time_s, state, self._sends_rangefinder)
        return self._last_reply

    def repeated_reply(self) -> bytes:
        """The last answer once more, for a request that came again. ValueError if there was none yet."""
        if self._last_reply is None:
            raise ValueError("repeated_reply: no request was answered before this one")
        return self._last_reply


def encode(time_s: float, state: PhysicsState, sends_rangefinder: bool) -> bytes:
    """One line of JSON with a newline at both ends and no space after a colon: the parser wants it so."""
    rangefinder = ""
    if sends_rangefinder:
        rangefinder = f',"rng_1":{NO_RETURN_M if state.rangefinder_m is None else round(state.rangefinder_m, 4)}'
    return (
        f'\n{{"timestamp":{round(time_s, 6)},"imu":{{"gyro":{_list(state.gyro_radps, 6)},'
        f'"accel_body":{_list(state.accel_mps2, 6)}}},"position":{_list(state.position_m, 6)},'
        f'"quaternion":{_list(state.q_ned_frd_wxyz, 7)},"velocity":{_list(state.velocity_mps, 6)},'
        f'"no_time_sync":0{rangefinder}}}\n'
    ).encode("ascii")


def _list(values: Array, digits: int) -> str:
    return "[" + ",".join([repr(round(v, digits)) for v in values.tolist()]) + "]"
