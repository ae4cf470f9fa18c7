"""A vehicle in an empty hall, the emulated autopilot on its sensors, and a scripted companion on its offboard link.

The companion's ODOMETRY is made from truth plus noise: here the autopilot is tested, not the odometry. Its frames are packed and
parsed by pymavlink's own dialect, so that an error in the autopilot's codec cannot cancel.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import development as dialect

from simbridge.autopilot import Autopilot
from simbridge.config import VehicleConfig, WorldConfig
from simbridge.sensors import Barometer, Imu
from simbridge.vehicle import Vehicle
from simbridge.world import World, build_world

STEP_NS = 4_000_000
S = 1_000_000_000
PARAMS = {
    "SENS_EN_GPSSIM": 0, "SYS_HAS_GPS": 0, "EKF2_GPS_CTRL": 0, "EKF2_EV_CTRL": 15, "EKF2_HGT_REF": 3, "EKF2_EV_DELAY": 0,
    "EKF2_MAG_TYPE": 5, "COM_ARM_WO_GPS": 2, "COM_RC_IN_MODE": 4, "NAV_DLL_ACT": 0, "COM_OBL_RC_ACT": 4,
}  # fmt: skip
VEHICLE = VehicleConfig(start=(0.0, 0.0))


@functools.cache
def _world() -> World:
    world = WorldConfig(footprint=((-20.0, -20.0), (20.0, -20.0), (20.0, 20.0), (-20.0, 20.0)), height_m=20.0)
    return build_world(world, VEHICLE)


class Rig:
    """Steps vehicle and autopilot; keeps every frame that the autopilot sent on the offboard link, with its time in s."""

    def __init__(
        self, params: dict[str, float] | None = None, seed: int = 1, links: tuple[str, ...] = ("offboard",)
    ) -> None:
        world = _world()
        self.vehicle = Vehicle(world.model, world.surface, VEHICLE, world.config.wind, (0.0, 0.0, 0.0), seed)
        self._imu, self._baro = Imu(VEHICLE.imu, seed), Barometer(VEHICLE.barometer, seed)
        self.autopilot = Autopilot({**PARAMS, **(params or {})}, seed, links)
        self.t_ns = S
        self.mav = dialect.MAVLink(None, srcSystem=1, srcComponent=191)
        self._parser = dialect.MAVLink(None)
        self.frames: list[tuple[float, bytes]] = []
        self._rng = np.random.default_rng(seed)
        self.start_position = self.vehicle.position.copy()
        self.vision = True
        self.origin: tuple[int, int, int] | None = (473977432, 85455942, 0)
        self.vision_edit: Callable[[dict[str, Any]], None] = lambda fields: None
        self.position_noise_m, self.velocity_noise_mps, self.attitude_noise_rad = 0.01, 0.02, 0.003
        self.on_output: Callable[[str, bytes], None] = lambda link, frame: None
        self._setpoint: Callable[[], tuple[int, int, list[float]]] | None = None
        self.odometry_period_ns, self.odometry_delay_ns = 32_000_000, 0
        self._late: list[tuple[int, bytes]] = []
        self.log: list[tuple[float, NDArray[np.float64]]] = []

    @property
    def t_s(self) -> float:
        return self.t_ns / S

    def send(self, message: Any, link: str = "offboard") -> None:
        self.autopilot.receive(link, message.pack(self.mav), self.t_ns)

    def fly(self, seconds: float) -> None:
        """Carry on for a while."""
        end = self.t_ns + round(seconds * S)
        while self.t_ns < end:
            self.step()

    def until(self, condition: Callable[[], bool], timeout_s: float) -> float:
        """Carry on until the condition holds. Returns how long it took; raises AssertionError at the timeout."""
        begin = self.t_s
        while not condition():
            assert self.t_s - begin < timeout_s, f"not within {timeout_s} s"
            self.step()
        return self.t_s - begin

    def step(self) -> None:
        t, v = self.t_ns, self.vehicle
        if t % S == 0:
            self.send(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
        if self.origin is not None and t == S + STEP_NS:
            self.send(dialect.MAVLink_set_gps_global_origin_message(1, *self.origin))
        if self.vision and t % self.odometry_period_ns < STEP_NS and t > 1.5 * S:
            self._late.append((t + self.odometry_delay_ns, self._odometry()))
        while self._late and self._late[0][0] <= t:
            self.autopilot.receive("offboard", self._late.pop(0)[1], t)
        if self._setpoint is not None and t % 50_000_000 < STEP_NS:
            frame, mask, values = self._setpoint()
            self.send(dialect.MAVLink_set_position_target_local_ned_message(t // 10**6, 1, 1, frame, mask, *values))
        imu = self._imu.sample(v.inertial_frd, v.thrust_ratio)
        baro = self._baro.sample(t, float(v.position[2]))
        v.step(self.autopilot.step(t, imu, baro, None))
        self.log.append((t / S, np.concatenate([self.position_ned(), self.velocity_ned(), [self.yaw()]])))
        self.t_ns = t + STEP_NS
        for link, frame in self.autopilot.take_output():
            self.on_output(link, frame)
            if link == "offboard":
                self.frames.append((t / S, frame))

    # truth

    def position_ned(self) -> NDArray[np.float64]:
        return (self.vehicle.position - self.start_position) * (1.0, -1.0, -1.0)

    def velocity_ned(self) -> NDArray[np.float64]:
        return np.asarray(self.vehicle.motion[:3] * (1.0, -1.0, -1.0))

    def quaternion_ned(self) -> NDArray[np.float64]:
        return np.asarray(self.vehicle.q_world_body_wxyz * (1.0, 1.0, -1.0, -1.0))

    def yaw(self) -> float:
        w, x, y, z = self.quaternion_ned()
        return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))

    def _odometry(self) -> bytes:
        n, q = self._rng.standard_normal, self.quaternion_ned()
        small = np.concatenate([[1.0], 0.5 * self.attitude_noise_rad * n(3)])
        noisy = np.empty(4)
        mujoco.mju_mulQuat(noisy, q, small / np.linalg.norm(small))
        back = np.empty(3)
        mujoco.mju_rotVecQuat(back, self.velocity_ned(), q * (1.0, -1.0, -1.0, -1.0))
        p = self.position_ned() + self.position_noise_m * n(3)
        v = back + self.velocity_noise_mps * n(3)
        pose, twist = [0.0] * 21, [0.0] * 21
        for i in (0, 6, 11):
            pose[i], twist[i] = 0.01, 0.01
        for i in (15, 18, 20):
            pose[i] = 0.005
        q_sent = [float(v) for v in noisy / np.linalg.norm(noisy)]
        fields: dict[str, Any] = {
            "time_usec": self.t_ns // 1000, "frame_id": 1, "child_frame_id": 12, "q": q_sent,
            "x": p[0], "y": p[1], "z": p[2], "vx": v[0], "vy": v[1], "vz": v[2],
            "rollspeed": 0.0, "pitchspeed": 0.0, "yawspeed": 0.0, "pose_covariance": pose, "velocity_covariance": twist,
            "reset_counter": 0, "estimator_type": 3, "quality": 100,
        }  # fmt: skip
        self.vision_edit(fields)
        return bytes(dialect.MAVLink_odometry_message(**fields).pack(self.mav))

    # the companion's side

    def velocity(self, north: float, east: float, down: float, yaw: float = 0.0) -> None:
        """Stream a velocity and heading, LOCAL_NED, at 20 Hz."""
        self._setpoint = lambda: (1, 0x9C7, [0.0, 0.0, 0.0, north, east, down, 0.0, 0.0, 0.0, yaw, 0.0])

    def body_velocity(self, forward: float, right: float, down: float, yaw_rate: float) -> None:
        """Stream a velocity and turn rate, BODY_NED, at 20 Hz."""
        self._setpoint = lambda: (8, 0x5C7, [0.0, 0.0, 0.0, forward, right, down, 0.0, 0.0, 0.0, 0.0, yaw_rate])

    def goto(self, north: float, east: float, down: float, yaw: float = 0.0) -> None:
        """Stream a position and heading, LOCAL_NED, at 20 Hz."""
        self._setpoint = lambda: (1, 0x9F8, [north, east, down, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, yaw, 0.0])

    def stream(self, setpoint: Callable[[], tuple[int, int, list[float]]] | None) -> None:
        """Stream what the function gives, or stop."""
        self._setpoint = setpoint

    def command(self, number: int, *params: float) -> int:
        """Send a COMMAND_LONG; its result."""
        before = len(self.frames)
        values = [*params, *[0.0] * (7 - len(params))]
        self.send(dialect.MAVLink_command_long_message(1, 1, number, 0, *values))
        self.step()
        acks = [m for _, m in self.messages("COMMAND_ACK", before) if m.command == number]
        assert len(acks) == 1
        return int(acks[0].result)

    def mode(self, main: int, sub: int = 0) -> int:
        return self.command(176, 1.0, main, sub)

    def arm(self) -> int:
        return self.command(400, 1.0)

    def messages(self, name: str, first: int = 0) -> list[tuple[float, Any]]:
        """What the autopilot sent on the offboard link of one kind: (time in s, message). first: index into `frames`."""
        number = getattr(dialect, f"MAVLINK_MSG_ID_{name}").to_bytes(3, "little")
        return [(t, self._parser.decode(bytearray(f))) for t, f in self.frames[first:] if f[7:10] == number]

    def takeoff(self, height_m: float) -> None:
        """Vision on, fused and stable, then arm and climb by velocity setpoints to a height, and stop there."""
        self.velocity(0.0, 0.0, 0.0)
        self.fly(6.0)
        assert self.mode(6) == 0
        assert self.arm() == 0

        def climb() -> tuple[int, int, list[float]]:
            down = max(min(-(height_m + self.position_ned()[2]), 0.8), -0.8)
            return (1, 0x9C7, [0.0, 0.0, 0.0, 0.0, 0.0, down, 0.0, 0.0, 0.0, 0.0, 0.0])

        self.stream(climb)
        self.until(lambda: abs(self.position_ned()[2] + height_m) < 0.1, 25.0)
        self.velocity(0.0, 0.0, 0.0)
        self.fly(2.0)
