"""The emulated side, step by step: 4 ms of sensors, flight controller, motion and LiDAR at a time.

Simulated time counts from boot. Pacing (lockstep or real time) is the caller's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from simbridge import footprint as fp
from simbridge import kernels, nearness
from simbridge.config import SimConfig, StartCircle
from simbridge.faults import SensorFaults
from simbridge.lidar import Lidar
from simbridge.model import RAY_GROUPS
from simbridge.sensors import STEP_NS, Barometer, BaroSample, Imu, ImuSample, Rangefinder
from simbridge.streams import stream
from simbridge.vehicle import Vehicle
from simbridge.world import World, build_world

Array = NDArray[np.float64]

BOOT_NS = 1_000_000_000
CLEARANCE_PERIOD_NS = 40_000_000
CLEARANCE_SLACK_M = 0.5  # by which clearance from a pile may fall short at once: it is told from its corners
HARD_LANDING_MPS = 1.5  # PX4 lands at 0.7
FLANK_SLOPE = math.tan(math.radians(15.0))  # from here on what lies below is a flank, to be flown into
FLANK_MPS = 0.25  # sideways; one that lands there, and slides, is slower
LIFTOFF_M = 0.3
TOPPLED_COS = math.cos(math.radians(50.0))


class Controller(Protocol):
    """A flight controller, emulated or real."""

    def step(self, t_ns: int, imu: ImuSample, baro: BaroSample | None, rangefinder_m: float | None) -> Array:
        """Motor commands (4,), 0..1, for the next 4 ms."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """Where the vehicle really is. For scoring: it may reach nothing that flies. rate_body_radps: FLU."""

    t_ns: int
    position_world_m: Array
    q_world_body_wxyz: Array
    velocity_world_mps: Array
    rate_body_radps: Array


class Simulation:
    """One store, one vehicle, one seed: the same each time, to the last bit."""

    def __init__(
        self, cfg: SimConfig, autopilot: Controller, *, step_ns: int = STEP_NS, commands_per_step: int = 1
    ) -> None:
        """step_ns: what `step` moves time by, at most 5 ms. commands_per_step: how often in it the flight controller
        gets sensors and gives motor commands; 1 suits PX4, ArduCopter wants more than 720 a second."""
        kernels.warm_up()
        nearness.warm_up()
        self.world: World = build_world(cfg.store, cfg.vehicle)
        self.start: tuple[float, float, float] = start_pose(cfg)
        self.t_ns = BOOT_NS
        self.collision = False
        self.min_clearance_m = math.inf
        self._autopilot = autopilot
        self._step_ns, self._commands = step_ns, commands_per_step
        self._command_ns = command_ns = step_ns // commands_per_step
        self._vehicle = Vehicle(
            self.world.model, self.world.surface, cfg.vehicle, cfg.world.wind, self.start, cfg.seed, command_ns * 1e-9
        )
        self._ground_z = float(self._vehicle.position[2])
        self._imu = Imu(cfg.vehicle.imu, cfg.seed, command_ns)
        self._barometer = Barometer(cfg.vehicle.barometer, cfg.seed, command_ns)
        self._rangefinder = Rangefinder(cfg.vehicle.rangefinder, cfg.seed, command_ns)
        v = self._vehicle
        self._lidar = Lidar(self.world.model, v.data, v.body_id, cfg.lidar, cfg.seed, BOOT_NS, step_ns)
        self._faults = SensorFaults(cfg.faults, cfg.seed, BOOT_NS)
        self._before = np.zeros(7)  # pose at the step's beginning
        self._packets: list[bytes] = []
        self._clearance_m, self._clearance_place = -math.inf, v.position.copy()  # where it was last computed

    def step(self) -> None:
        """4 ms: what the sensors measured goes to the flight controller, its motor commands move the vehicle."""
        vehicle = self._vehicle
        self._before[:] = vehicle.pose
        before_mps: tuple[float, float, float] = tuple(vehicle.motion[:3].tolist())
        for _ in range(self._commands):
            self._command()
        self._turn_lidar()
        self._watch(before_mps)

    def _command(self) -> None:
        t_ns, vehicle, faults = self.t_ns, self._vehicle, self._faults
        imu = faults.imu(self._imu.sample(vehicle.inertial_frd, vehicle.thrust_ratio), t_ns)
        baro = faults.baro(self._barometer.sample(t_ns, float(vehicle.position[2])), t_ns)
        rangefinder_m = None
        if self._rangefinder.is_due(t_ns):
            rangefinder_m = self._rangefinder.sample(self._distance_down())
        rangefinder_m = faults.rangefinder(rangefinder_m, t_ns)
        vehicle.step(self._autopilot.step(t_ns, imu, baro, rangefinder_m))
        self.t_ns = t_ns + self._command_ns

    @property
    def liftoff_ns(self) -> int | None:
        """When the vehicle first left the ground: some faults count from there."""
        return self._faults.liftoff_ns

    def take_lidar_packets(self) -> list[bytes]:
        """Packets sent since the last call, in order."""
        packets, self._packets = self._packets, []
        return packets

    def lidar_metadata_json(self) -> str:
        """What the sensor's HTTP interface would say of it: ouster-sdk's SensorInfo."""
        return self._lidar.metadata_json

    def truth(self) -> Truth:
        v = self._vehicle
        return Truth(
            t_ns=self.t_ns,
            position_world_m=v.position.copy(),
            q_world_body_wxyz=v.q_world_body_wxyz.copy(),
            velocity_world_mps=v.motion[:3].copy(),
            rate_body_radps=v.motion[3:].copy(),
        )

    def _distance_down(self) -> float:
        down = np.empty(3)
        mujoco.mju_rotVecQuat(down, np.array([0.0, 0.0, -1.0]), self._vehicle.q_world_body_wxyz)
        v = self._vehicle
        return float(mujoco.mj_ray(self.world.model, v.data, v.position, down, RAY_GROUPS, 1, v.body_id, None, None))

    def _turn_lidar(self) -> None:
        """Columns of the step just flown, from the pose in its middle."""
        t_ns, vehicle = self.t_ns, self._vehicle
        self._lidar.range_bias_m = self._faults.lidar_bias_m(t_ns)
        packets = self._lidar.cast(t_ns - self._step_ns // 2, t_ns, self._before, vehicle.pose, vehicle.motion)
        self._packets += self._faults.lidar(packets, t_ns)

    def _watch(self, before_mps: tuple[float, float, float]) -> None:
        """Lift-off, collision and clearance. before_mps: the velocity in `world` before the step."""
        vehicle = self._vehicle
        if self._faults.liftoff_ns is None and float(vehicle.position[2]) > self._ground_z + LIFTOFF_M:
            self._faults.liftoff_ns = self.t_ns
        if self.t_ns % CLEARANCE_PERIOD_NS < self._step_ns:
            self._note_clearance()
        if self.collision or not vehicle.has_contact:
            return
        vx, vy, vz = before_mps
        is_into_flank = vehicle.ground_slope > FLANK_SLOPE and math.hypot(vx, vy) > FLANK_MPS
        is_landing = -vz <= HARD_LANDING_MPS and vehicle.up_cos >= TOPPLED_COS and not is_into_flank
        self.collision = vehicle.touches_store or not is_landing

    def _note_clearance(self) -> None:
        """Computed only where it can be the smallest yet: it changes no faster than the vehicle moves."""
        position = self._vehicle.position
        moved_m = math.dist(position, self._clearance_place)
        if self._clearance_m - moved_m - CLEARANCE_SLACK_M > self.min_clearance_m:
            return
        self._clearance_m = self.world.clearance(position) - fp.VEHICLE_RADIUS_M
        self._clearance_place = position.copy()
        self.min_clearance_m = min(self.min_clearance_m, self._clearance_m)


def start_pose(cfg: SimConfig) -> tuple[float, float, float]:
    """x, y, yaw (rad) in `world`; of a circle: drawn by the seed among the places where the vehicle can stand."""
    start = cfg.vehicle.start
    if not isinstance(start, StartCircle):
        return start[0], start[1], math.radians(start[2]) if len(start) == 3 else 0.0
    rng = stream(cfg.seed, "start")
    places = fp.start_places(cfg.store, start.circle.center, start.circle.radius_m, rng, 400)
    if len(places) == 0:
        raise ValueError(f"vehicle.start.circle: no place to stand found in it with seed {cfg.seed}")
    yaw = rng.uniform(-math.pi, math.pi) if start.yaw_deg is None else math.radians(start.yaw_deg)
    return float(places[0, 0]), float(places[0, 1]), yaw
