"""The quadrotor: motor commands in, true motion out.

Motor order (PX4 quad X and ArduPilot FRAME_TYPE 1 alike): 0 front right CCW, 1 rear left CCW, 2 front left CW, 3 rear
right CW. A CCW rotor turns the nose right: +reaction about FRD z, so -reaction about body z (up).
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from simbridge.config import VehicleConfig, Wind
from simbridge.kernels import inertial, rotors
from simbridge.model import FOOT_Z_M, STEP_S, tilt_wxyz
from simbridge.sensors import GRAVITY_MPS2
from simbridge.streams import Normals, stream
from simbridge.surface import Surface

Array = NDArray[np.float64]

GROUND_NEAR_M = 2.0  # the ground plane follows the vehicle only this near to the highest surface
SETTLE_S = 1.0


class Vehicle:
    """State lives in MuJoCo's data; position, quaternion and velocity are views of it, changing with each step.

    inertial_frd: (6,) true mean specific force and turn rate of the last step. thrust_ratio: of its full thrust.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        surface: Surface,
        cfg: VehicleConfig,
        wind: Wind,
        start: tuple[float, float, float],
        seed: int,
        step_s: float = STEP_S,
    ) -> None:
        """Set the vehicle on the ground and let it settle.

        start: x, y, yaw (rad) in `world`. step_s: between motor commands; physics steps keep near the configured size.
        """
        self._step_s = step_s
        self._substeps = max(1, round(cfg.substeps * step_s / STEP_S))
        model.opt.timestep = step_s / self._substeps
        self.data = mujoco.MjData(model)
        self.body_id = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "vehicle"))
        self._model, self._surface, self._cfg = model, surface, cfg
        self._ground_geom = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "ground"))
        self.pose: Array = self.data.qpos  # position and quaternion
        self.position: Array = self.pose[0:3]
        self.q_world_body_wxyz: Array = self.pose[3:7]
        self.motion: Array = self.data.qvel  # velocity in world, turn rate in body
        self._near_below_z = float(surface.z.max()) + GROUND_NEAR_M
        self._wrench: Array = self.data.xfrc_applied[self.body_id]
        self._ground_pos, self._ground_quat = self.data.mocap_pos[0], self.data.mocap_quat[0]
        r, a = cfg.reaction_torque_m, cfg.arm_m
        self._sites = np.array([[a, -a, -r], [-a, a, -r], [a, a, r], [-a, -a, r]])
        through = 1.0 - math.exp(-model.opt.timestep / cfg.rotor_lag_s)
        self._params = np.array([through, cfg.max_thrust_n, cfg.thrust_curve, cfg.drag_nspm])
        self._full_thrust_n = 4.0 * cfg.max_thrust_n
        self._rotors = np.zeros(4)
        self._before = np.zeros(13)  # pose and motion before the step
        self._draught = Draught(wind, seed, step_s)
        self.inertial_frd = np.zeros(6)
        self.thrust_ratio = 0.0
        self._place(start)

    def step(self, controls: Array) -> None:
        """Fly one step on these motor commands, (4,) 0..1 in motor order; what is no number counts as 0."""
        commands = np.asarray(controls, dtype=np.float64)
        wind = self._draught.step()
        self._move_ground()
        pose, motion, before = self.pose, self.motion, self._before
        before[:7], before[7:] = pose, motion
        thrust = 0.0
        for _ in range(self._substeps):
            thrust = rotors(commands, self._rotors, self._sites, pose, motion, wind, self._params, self._wrench)
            mujoco.mj_step(self._model, self.data)
        self.thrust_ratio = thrust / self._full_thrust_n
        inertial(before, pose, motion, self._step_s, GRAVITY_MPS2, self.inertial_frd)

    @property
    def has_contact(self) -> bool:
        return bool(self.data.ncon)

    @property
    def touches_store(self) -> bool:
        """Touches a wall, the ceiling or an obstacle: anything but floor and piles."""
        return any(self._ground_geom not in pair for pair in self.data.contact.geom.tolist())

    @property
    def ground_slope(self) -> float:
        """Rise per metre of what lies below: floor or pile."""
        _, slope_x, slope_y = self._surface.plane(*self.position[:2].tolist())
        return math.hypot(slope_x, slope_y)

    @property
    def up_cos(self) -> float:
        """Cosine of the tilt."""
        _, x, y, _ = self.q_world_body_wxyz.tolist()
        return float(1.0 - 2.0 * (x * x + y * y))

    def _place(self, start: tuple[float, float, float]) -> None:
        x, y, yaw = start
        height, slope_x, slope_y = self._surface.plane(x, y)
        tilt = np.array(tilt_wxyz(slope_x, slope_y))
        heading = np.array([math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)])
        mujoco.mju_mulQuat(self.q_world_body_wxyz, tilt, heading)
        self.position[:] = x, y, height - FOOT_Z_M
        for _ in range(round(SETTLE_S / self._step_s)):
            self.step(np.zeros(4))
        self._rotors[:] = 0.0

    def _move_ground(self) -> None:
        """Lay the ground plane under the vehicle, tilted like the surface there."""
        x, y, z = self.position.tolist()
        if z > self._near_below_z:
            self._ground_pos[2] = -100.0
            return
        height, slope_x, slope_y = self._surface.plane(x, y)
        self._ground_pos[:] = x, y, height
        self._ground_quat[:] = tilt_wxyz(slope_x, slope_y)


class Draught:
    """Mean wind plus gusts: a first-order Gauss-Markov process in each axis."""

    def __init__(self, cfg: Wind, seed: int, step_s: float) -> None:
        self._mean = np.array(cfg.mean_mps)
        self._keep = math.exp(-step_s / cfg.gust_time_s)
        self._kick = math.sqrt(1.0 - self._keep**2) * cfg.gust_mps * np.array([1.0, 1.0, 0.5])
        self._gust = np.zeros(3)
        self._normals = Normals(stream(seed, "wind"), 3) if cfg.gust_mps > 0.0 else None

    def step(self) -> Array:
        """(3,) m/s in `world` for the next step."""
        if self._normals is None:
            return self._mean
        self._gust = self._keep * self._gust + self._kick * self._normals.draw()
        return self._mean + self._gust
