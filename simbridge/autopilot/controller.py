"""The control cascade with its parameters and its take-off ramp; the loops themselves are in `control_kernels`.

Source: PX4 mc_pos_control, mc_att_control, mc_rate_control, Takeoff.cpp, control_allocator.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from simbridge.autopilot import control_kernels as k
from simbridge.autopilot.kernels import GRAVITY
from simbridge.autopilot.params import ParamStore

Array = NDArray[np.float64]

_GAIN_PARAMS = {
    k.XY_P: "MPC_XY_P",
    k.Z_P: "MPC_Z_P",
    k.XY_V_P: "MPC_XY_VEL_P_ACC",
    k.XY_V_I: "MPC_XY_VEL_I_ACC",
    k.XY_V_D: "MPC_XY_VEL_D_ACC",
    k.Z_V_P: "MPC_Z_VEL_P_ACC",
    k.Z_V_I: "MPC_Z_VEL_I_ACC",
    k.Z_V_D: "MPC_Z_VEL_D_ACC",
    k.XY_V_MAX: "MPC_XY_VEL_MAX",
    k.THR_MIN: "MPC_THR_MIN",
    k.THR_MAX: "MPC_THR_MAX",
    k.THR_XY_MARGIN: "MPC_THR_XY_MARG",
    k.ROLL_P: "MC_ROLL_P",
    k.PITCH_P: "MC_PITCH_P",
    k.YAW_P: "MC_YAW_P",
    k.YAW_WEIGHT: "MC_YAW_WEIGHT",
    k.RR_P: "MC_ROLLRATE_P",
    k.RR_I: "MC_ROLLRATE_I",
    k.RR_D: "MC_ROLLRATE_D",
    k.PR_P: "MC_PITCHRATE_P",
    k.PR_I: "MC_PITCHRATE_I",
    k.PR_D: "MC_PITCHRATE_D",
    k.YR_P: "MC_YAWRATE_P",
    k.YR_I: "MC_YAWRATE_I",
    k.RATE_INT_LIM: "MC_RR_INT_LIM",
    k.YAW_TORQUE_HZ: "MC_YAW_TQ_CUTOFF",
    k.THR_MDL_FAC: "THR_MDL_FAC",
    k.VELD_LP_HZ: "MPC_VELD_LP",
}
_DEG_PARAMS = {k.RATE_MAX: "MC_ROLLRATE_MAX", k.YAW_RATE_MAX: "MC_YAWRATE_MAX"}
HOVER_TAU_S = 2.5
ARMED_IDLE = 0.001  # what an armed, idle motor gets (recorded on the HIL link)


class Controller:
    """Setpoint in, four motor commands out. `setpoint`: layout in `control_kernels`; NaN where not wanted."""

    def __init__(self, params: ParamStore) -> None:
        self._params = params
        self._version = -1
        self._gains = np.zeros(k.GAINS)
        self.memory = np.zeros(k.MEMORY)
        self.setpoint = np.full(11, np.nan)
        self.motors = np.zeros(4)
        self.reset()

    def reset(self) -> None:
        """Forget integrals and filters; hover thrust back to MPC_THR_HOVER."""
        self._resting = False
        self.memory[:] = 0.0
        self.memory[k.Q_SP] = 1.0
        self._load()
        self.memory[k.HOVER] = self._params.real("MPC_THR_HOVER")
        self.memory[k.VEL_UP] = self._params.real("MPC_Z_VEL_MAX_UP")
        self.memory[k.VEL_DOWN] = self._params.real("MPC_Z_VEL_MAX_DN")
        self.memory[k.TILT_LIMIT] = math.radians(self._params.real("MPC_TILTMAX_AIR"))

    def _load(self) -> None:
        self._version = self._params.version
        for index, name in _GAIN_PARAMS.items():
            self._gains[index] = self._params.real(name)
        for index, name in _DEG_PARAMS.items():
            self._gains[index] = math.radians(self._params.real(name))

    def idle(self) -> None:
        """Armed on the ground: motors at idle, nothing integrates."""
        self._rest(ARMED_IDLE)

    def stop(self) -> None:
        """Disarmed."""
        self._rest(0.0)

    def _rest(self, motors: float) -> None:
        self.memory[k.FLYING] = 0.0
        if self._resting and self.motors[0] == motors:
            return
        self._resting = True
        self.memory[k.VEL_INT : k.VEL_INT + 3] = 0.0
        self.memory[k.RATE_INT : k.RATE_INT + 3] = 0.0
        self.memory[k.THRUST : k.THRUST + 3] = 0.0
        self.memory[k.COLLECTIVE] = 0.0
        self.motors[:] = motors

    def limits(self, up_mps: float, down_mps: float, tilt_deg: float, is_flying: bool) -> None:
        """Limits of the vertical velocity (up may be negative during the take-off ramp) and of the tilt."""
        self.memory[k.VEL_UP] = up_mps
        self.memory[k.VEL_DOWN] = down_mps
        self.memory[k.TILT_LIMIT] = math.radians(tilt_deg)
        self.memory[k.FLYING] = 1.0 if is_flying else 0.0

    def step(self, o: Array, dt: float, dt_position: float) -> None:
        """One step of the cascade on the newest estimate; dt_position 0: only attitude and rates."""
        if self._version != self._params.version:
            self._load()
        self._resting = False
        k.control_step(o, self.setpoint, self.memory, self._gains, self.motors, dt, dt_position)

    def learn_hover(self, acceleration_down_mps2: float, dt: float) -> None:
        """Hover thrust from the thrust commanded and the vertical acceleration it gave (PX4's hover estimator, simplified)."""
        thrust = self.memory[k.COLLECTIVE]
        lift = (GRAVITY - acceleration_down_mps2) / GRAVITY
        if lift < 0.5 or thrust < 0.1:
            return
        hover = min(max(thrust / lift, 0.1), 0.8)
        self.memory[k.HOVER] += min(dt / HOVER_TAU_S, 1.0) * (hover - self.memory[k.HOVER])

    @property
    def thrust(self) -> float:
        """Collective, 0 to 1."""
        return float(self.memory[k.COLLECTIVE])

    @property
    def hover(self) -> float:
        return float(self.memory[k.HOVER])

    @property
    def velocity_setpoint_down_mps(self) -> float:
        return float(self.memory[k.VEL_SP + 2])


class Takeoff:
    """Spool-up, then a ramp of the upward velocity limit from the one that gives no thrust at all (Takeoff.cpp)."""

    DISARMED, SPOOLUP, READY, RAMP, FLIGHT = range(5)

    def __init__(self, params: ParamStore) -> None:
        self._params = params
        self.state = self.DISARMED
        self._since_ns = 0
        self._progress = 0.0

    def update(self, t_ns: int, dt: float, is_armed: bool, is_landed: bool, wants_up_mps: float) -> float:
        """The limit of the upward velocity, m/s. wants_up_mps: climb that the setpoint asks for, <= 0 where it does not."""
        if not is_armed:
            self.state = self.DISARMED
        elif self.state == self.DISARMED:
            self.state, self._since_ns = (self.SPOOLUP if is_landed else self.FLIGHT), t_ns
        elif self.state == self.SPOOLUP:
            if t_ns - self._since_ns >= self._params.real("COM_SPOOLUP_TIME") * 1e9:
                self.state = self.READY
        elif self.state == self.READY:
            if wants_up_mps > 0.0:
                self.state, self._progress = self.RAMP, 0.0
        elif self.state == self.FLIGHT and is_landed:
            self.state = self.READY
        maximum = self._params.real("MPC_Z_VEL_MAX_UP")
        lowest = -GRAVITY / max(self._params.real("MPC_Z_VEL_P_ACC"), 0.01)
        if self.state == self.FLIGHT:
            return maximum
        if self.state != self.RAMP:
            return lowest
        wanted = min(max(wants_up_mps, 0.1), maximum)
        duration = self._params.real("MPC_TKO_RAMP_T")
        self._progress += dt / duration if duration > dt else 1.0
        if self._progress >= 1.0:
            self.state = self.FLIGHT
            return maximum
        return lowest + self._progress * (wanted - lowest)
