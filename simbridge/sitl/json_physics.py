"""ArduPilot's JSON physics backend, without the socket: servo packets in, one line of JSON out for each.

Sources: ArduPilot `libraries/SITL/SIM_JSON.cpp`; the recordings json_physics. A packet whose frame count was answered
before is the autopilot asking again (each 1.1 s of silence): it gets the same answer, and nothing moves. The stamps of
the answers are the autopilot's clock, so they start at 0 for each start of the autopilot and never go back.
"""

from __future__ import annotations

import json
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
    """One request of the autopilot. pwm_us: (16,) int, 0 where an output is off. is_repeat: asked before; answer again
    without stepping. is_restart: the autopilot began anew."""

    rate_hz: int
    count: int
    pwm_us: NDArray[np.int64]
    is_repeat: bool
    is_restart: bool

    def controls(self) -> Array:
        """(4,) 0..1 in motor order, 0 for an output that is off."""
        u: Array = np.clip((self.pwm_us[:MOTORS].astype(np.float64) - PWM_MIN_US) / PWM_SPAN_US, 0.0, 1.0)
        return u


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
        magic, rate, count, *pwm = SERVO_PACKET.unpack(datagram)
        if magic != MAGIC or rate == 0:
            self.dropped["magic" if magic != MAGIC else "rate"] += 1
            return None
        is_restart = self._count is not None and count < self._count
        is_repeat = count == self._answered
        if is_restart:
            self.time_s, self._answered = 0.0, None
        self._count = count
        return ServoPacket(rate_hz=rate, count=count, pwm_us=np.array(pwm), is_repeat=is_repeat, is_restart=is_restart)

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
    line: dict[str, object] = {
        "timestamp": round(time_s, 6),
        "imu": {"gyro": _rounded(state.gyro_radps, 6), "accel_body": _rounded(state.accel_mps2, 6)},
        "position": _rounded(state.position_m, 6),
        "quaternion": _rounded(state.q_ned_frd_wxyz, 7),
        "velocity": _rounded(state.velocity_mps, 6),
        "no_time_sync": 0,
    }
    if sends_rangefinder:
        line["rng_1"] = NO_RETURN_M if state.rangefinder_m is None else round(state.rangefinder_m, 4)
    return b"\n" + json.dumps(line, separators=(",", ":")).encode() + b"\n"


def _rounded(values: Array, digits: int) -> list[float]:
    return [round(v, digits) for v in values.tolist()]
