"""The recorded conversations with a real PX4, given to the emulated one.

What was sent to PX4 (`to_fc`) goes to the emulation at the recorded times. The vehicle is kinematic: it moves as PX4's
vehicle truly moved, whatever our motors say, because the recorded companion flew by that vehicle's true position: in closed
loop two vehicles would part, and then the recorded vision would contradict our inertial unit. So times, modes, answers and
texts can be compared; motor commands and paths cannot. The path is that of the recorded ODOMETRY (30 Hz, exact truth), and
after vision stopped that of `truth.tlog` (5 Hz).
"""

from __future__ import annotations

import struct
from bisect import bisect_right
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import development as dialect
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from simbridge.autopilot import Autopilot
from simbridge.sensors import BaroSample, ImuSample, isa_pressure_hpa
from tests.shared_data import shared_data

STEP_NS = 4_000_000
FIRST_NS = 400_000_000  # the recordings begin 0.4 to 0.5 s after PX4's boot
GRAVITY = np.array([0.0, 0.0, 9.80665])
FLIGHT_PARAMS = {
    "SENS_EN_GPSSIM": 0, "SYS_HAS_GPS": 0, "EKF2_GPS_CTRL": 0, "EKF2_EV_CTRL": 15, "EKF2_HGT_REF": 3, "EKF2_EV_DELAY": 0,
    "EKF2_MAG_TYPE": 5, "COM_ARM_WO_GPS": 2, "COM_RC_IN_MODE": 4, "NAV_DLL_ACT": 0, "COM_OBL_RC_ACT": 4, "COM_LOW_BAT_ACT": 3,
}  # fmt: skip

Event = tuple[float, Any]


def frames(path: Path) -> Iterator[tuple[int, bytes, Any]]:
    """(record time in us, frame, message or None) of a tlog."""
    data, at = path.read_bytes(), 0
    parser = dialect.MAVLink(None)
    parser.robust_parsing = True
    while at < len(data):
        (t_us,) = struct.unpack_from(">Q", data, at)
        size = data[at + 9] + (12 + (13 if data[at + 10] & 1 else 0) if data[at + 8] == 0xFD else 8)
        frame = data[at + 8 : at + 8 + size]
        at += 8 + size
        message = parser.decode(bytearray(frame))
        yield t_us, frame, (None if message.get_type().startswith("UNKNOWN") and not is_event(message) else message)


def is_event(message: Any) -> bool:
    """EVENT (410), which pymavlink does not know."""
    return bool(message.get_type() == "UNKNOWN_410")


def event_ids(events: list[Event]) -> list[tuple[float, int, bytes]]:
    """(time, id, arguments) of each EVENT."""
    out = []
    for t, m in events:
        if not isinstance(m, tuple) and is_event(m):
            payload = bytes(m.get_msgbuf())[10:-2].ljust(53, b"\0")
            out.append((t, struct.unpack_from("<I", payload)[0], payload[13:53].rstrip(b"\0")))
    return out


def _arrival_ns(t_ns: int, message: Any) -> int:
    """When it reached PX4: record times are exact to a 4 ms step, but an answer to TIMESYNC came after what it answers."""
    if message is not None and message.get_type() == "TIMESYNC" and message.tc1 != 0:
        return max(t_ns, int(message.ts1))
    return t_ns


class Conversation:
    """One recording: both directions, on PX4's clock (ns since boot); `recorded` and `emulated`: s from the first record."""

    def __init__(self, name: str) -> None:
        folder = shared_data("autopilots", "px4")
        sent = list(frames(folder / f"{name}.to_fc.tlog"))
        heard = list(frames(folder / f"{name}.from_fc.tlog"))
        sync = next((t, m) for t, _, m in heard if m is not None and m.get_type() == "TIMESYNC" and m.tc1 == 0)
        zero_us = round((sync[0] - sync[1].ts1 / 1000) / 1e6) * 10**6
        self.first_us = min(sent[0][0], heard[0][0])
        self.offset_s = (self.first_us - zero_us) / 1e6
        self.to_fc = [(_arrival_ns((t - zero_us) * 1000, m), frame, m) for t, frame, m in sent]
        self.recorded: list[Event] = [((t - self.first_us) / 1e6, m) for t, _, m in heard if m is not None]
        self.end_ns = (heard[-1][0] - zero_us) * 1000
        truth = folder / f"{name}.truth.tlog"
        self._truth = [((t - zero_us) * 1000, m) for t, _, m in frames(truth)] if truth.exists() else []
        self._path: _Path | None = None

    def run(
        self, params: dict[str, float], extra: list[tuple[int, str, bytes]] | None = None
    ) -> tuple[list[Event], Autopilot]:
        """Fly it. Returns what the emulation sent on the offboard link, and each change of mode in force as ("mode", name)."""
        autopilot = Autopilot(params, links=("offboard", "gcs"))
        inputs = sorted([(t, "offboard", f) for t, f, _ in self.to_fc] + (extra or []), key=lambda e: e[0])
        parser = dialect.MAVLink(None)
        out: list[Event] = []
        path = _Path(self.to_fc, self._truth)
        rng = np.random.default_rng(0)
        at, mode = 0, None
        for t in range(FIRST_NS, self.end_ns, STEP_NS):
            while at < len(inputs) and inputs[at][0] <= t:
                autopilot.receive(inputs[at][1], inputs[at][2], t)
                at += 1
            autopilot.step(t, *path.sense(t, rng))
            seconds = t / 1e9 - self.offset_s
            for link, frame in autopilot.take_output():
                if link == "offboard":
                    out += [(seconds, m) for m in parser.parse_buffer(frame) or []]
            if autopilot.commander.mode is not mode:
                mode = autopilot.commander.mode
                out.append((seconds, ("mode", mode.name)))
        return out, autopilot


class _Path:
    """The vehicle's true motion as splines; at rest where nothing was recorded."""

    def __init__(self, to_fc: list[tuple[int, bytes, Any]], truth: list[tuple[int, Any]]) -> None:
        rows = [(t, m) for t, _, m in to_fc if m is not None and m.get_type() == "ODOMETRY" and truth]
        self._at_rest = len(rows) < 10
        if self._at_rest:
            return
        t = [t for t, _ in rows]
        p = [(m.x, m.y, m.z) for _, m in rows]
        q = [m.q for _, m in rows]
        later = [(t2, m) for t2, m in truth if t2 > t[-1] + 150_000_000]
        if later:
            origin = next(m for _, m in truth)
            for t2, m in later:
                north = (m.lat - origin.lat) * 1e-7 * np.pi / 180 * 6371000.0
                east = (m.lon - origin.lon) * 1e-7 * np.pi / 180 * 6371000.0 * np.cos(np.radians(origin.lat * 1e-7))
                t.append(t2)
                p.append((north, east, -(m.alt - origin.alt) * 1e-3))
                q.append(m.attitude_quaternion)
        keep = [0] + [i for i in range(1, len(t)) if t[i] > t[i - 1]]
        times = np.array(t)[keep] / 1e9
        self._begin, self._end = float(times[0]), float(times[-1])
        rotation = Rotation.from_quat(np.array(q)[keep][:, [1, 2, 3, 0]])
        grid = np.arange(self._begin, self._end, 0.004)
        spline = CubicSpline(times, np.array(p)[keep])
        turns = RotationSpline(times, rotation)
        acceleration = spline(grid, 2)
        body = turns(grid)
        self._grid = grid
        self._height = -spline(grid)[:, 2]
        self._force = body.inv().apply(acceleration - GRAVITY)
        self._rates = turns(grid, 1)

    def sense(self, t_ns: int, rng: np.random.Generator) -> tuple[ImuSample, BaroSample | None, float | None]:
        force, rates, height = -GRAVITY, np.zeros(3), 0.0
        if not self._at_rest and self._begin < t_ns / 1e9 < self._end:
            i = min(max(bisect_right(self._grid, t_ns / 1e9) - 1, 0), len(self._grid) - 1)
            force, rates, height = self._force[i], self._rates[i], float(self._height[i])
        imu = ImuSample(
            accel_frd_mps2=force + 0.05 * rng.standard_normal(3), gyro_frd_radps=rates + 0.002 * rng.standard_normal(3)
        )
        if t_ns % 20_000_000 >= STEP_NS:
            return imu, None, None
        pressure = isa_pressure_hpa(488.0 + height) + 0.01 * float(rng.standard_normal())
        baro = BaroSample(pressure_hpa=pressure, pressure_altitude_m=488.0 + height, temperature_c=25.0)
        return imu, baro, max(height, 0.0) + 0.02


def changes(events: list[Event], name: str, *fields: str, after_s: float = 0.0) -> list[tuple[float, tuple[Any, ...]]]:
    """(time, values) of each message that differs in these fields from the one before it."""
    out: list[tuple[float, tuple[Any, ...]]] = []
    for t, m in events:
        if t < after_s or isinstance(m, tuple) or m.get_type() != name:
            continue
        value = tuple(getattr(m, f) for f in fields)
        if not out or out[-1][1] != value:
            out.append((t, value))
    return out


def all_of(events: list[Event], name: str) -> list[Event]:
    return [(t, m) for t, m in events if not isinstance(m, tuple) and m.get_type() == name]


def modes(events: list[Event]) -> list[tuple[float, str]]:
    """Changes of the mode in force (of the emulation only)."""
    return [(t, m[1]) for t, m in events if isinstance(m, tuple)]


Array = NDArray[np.float64]
