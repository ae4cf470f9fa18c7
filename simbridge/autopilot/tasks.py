"""What each mode wants of the controller: hold, take off, land, return, descend, or the companion's own setpoint.

Automatic modes move a reference point within their speed and acceleration (MPC_*), which the cascade then tracks.
"""

from __future__ import annotations

import math

import numpy as np

from simbridge.autopilot.controller import Controller
from simbridge.autopilot.estimator import Estimator
from simbridge.autopilot.kernels import Array
from simbridge.autopilot.modes import Mode
from simbridge.autopilot.params import ParamStore

NAN = math.nan
REACHED_M = 0.3
HANDS_OFF_ACC = 100.0  # m/s2 down: on ground contact the thrust goes to its minimum


class Tasks:
    """Writes the controller's setpoint for the mode in force."""

    def __init__(self, params: ParamStore, ekf: Estimator, controller: Controller) -> None:
        self._params, self._ekf, self._controller = params, ekf, controller
        self.offboard = np.full(11, np.nan)
        self.home = np.zeros(3)
        self._mode: Mode | None = None
        self._p = np.zeros(3)  # the moving reference
        self._v = np.zeros(3)
        self._goal = np.zeros(3)
        self._yaw = 0.0
        self._phase = 0
        self.done = False  # a take-off that has arrived
        self.takeoff_altitude_m = NAN

    def enter(self, mode: Mode) -> None:
        """Start a mode where the vehicle is, with the speed it has."""
        o = self._ekf.o
        self._mode, self._phase, self.done = mode, 0, False
        self._p[:] = o[7:10]
        self._v[:] = o[4:7]
        self._yaw = self._ekf.yaw_rad
        speed = math.hypot(o[4], o[5])
        stop = speed / (2.0 * self._params.real("MPC_ACC_HOR"))
        self._goal[:] = (o[7] + o[4] * stop, o[8] + o[5] * stop, o[9])
        if mode is Mode.TAKEOFF:
            height = self.takeoff_altitude_m
            self._goal[2] = o[9] - (height if math.isfinite(height) else self._params.real("MIS_TAKEOFF_ALT"))

    def update(self, mode: Mode, dt: float, distance_bottom_m: float | None) -> float:
        """Write the setpoint. Returns the wanted descent, m/s (negative: climb)."""
        sp = self._controller.setpoint
        if mode is Mode.OFFBOARD:
            self._offboard(sp)
        elif mode in (Mode.LAND, Mode.DESCEND):
            self._land(sp, dt, distance_bottom_m, level=mode is Mode.DESCEND)
        else:
            if mode is Mode.RTL:
                self._return(dt, distance_bottom_m, sp)
            if mode is not Mode.RTL or self._phase < 2:
                speed = self._params.real("MPC_XY_CRUISE")
                climb = self._params.real("MPC_TKO_SPEED" if mode is Mode.TAKEOFF else "MPC_Z_V_AUTO_UP")
                self._go(sp, dt, speed, climb)
                self.done = abs(float(self._ekf.o[9] - self._goal[2])) < REACHED_M
        if math.isfinite(sp[5]) and not math.isfinite(sp[2]):
            return float(sp[5])
        if math.isfinite(sp[2]):
            error = self._params.real("MPC_Z_P") * float(sp[2] - self._ekf.o[9])
            return error + (float(sp[5]) if math.isfinite(sp[5]) else 0.0)
        return NAN

    def hands_off(self) -> None:
        """On ground contact: level, least thrust."""
        sp = self._controller.setpoint
        sp[:6] = NAN
        sp[6:9] = (0.0, 0.0, HANDS_OFF_ACC)

    def _offboard(self, sp: Array) -> None:
        sp[:] = self.offboard
        wants_xy = not (math.isnan(sp[0]) and math.isnan(sp[3]))
        if wants_xy and not self._ekf.xy_valid:  # "Failsafe: blind land"
            sp[:] = NAN
            sp[5] = self._params.real("MPC_LAND_SPEED")
            sp[6] = sp[7] = 0.0

    def _slew(self, axis: int, wanted: float, dt: float, acceleration: float) -> None:
        step = min(max(wanted - float(self._v[axis]), -acceleration * dt), acceleration * dt)
        self._v[axis] += step

    def _go(self, sp: Array, dt: float, speed: float, climb: float) -> None:
        """Reference to the goal; a new goal does not jump it."""
        real = self._params.real
        gain = real("MPC_XY_TRAJ_P") * 2.0
        wish = gain * (self._goal[:2] - self._p[:2])
        length = math.hypot(wish[0], wish[1])
        if length > speed:
            wish *= speed / length
        up = min(max(gain * float(self._goal[2] - self._p[2]), -climb), real("MPC_Z_V_AUTO_DN"))
        self._slew(0, float(wish[0]), dt, real("MPC_ACC_HOR"))
        self._slew(1, float(wish[1]), dt, real("MPC_ACC_HOR"))
        self._slew(2, up, dt, real("MPC_ACC_DOWN_MAX"))
        self._p += self._v * dt
        error = self._ekf.o[7:10] - self._p  # the reference does not run away from a vehicle that cannot follow
        self._p += np.where(np.abs(error) > 2.0, error - np.sign(error) * 2.0, 0.0)
        sp[0:3], sp[3:6], sp[6:9] = self._p, self._v, NAN
        sp[9], sp[10] = self._yaw, NAN

    def _land(self, sp: Array, dt: float, distance_bottom_m: float | None, *, level: bool) -> None:
        """Straight down at MPC_LAND_SPEED, slower near ground that the rangefinder sees; `level`: without position."""
        real = self._params.real
        speed = real("MPC_LAND_SPEED")
        if distance_bottom_m is not None and distance_bottom_m < real("MPC_LAND_ALT3"):
            speed = real("MPC_LAND_CRWL")
        self._slew(2, speed, dt, real("MPC_JERK_AUTO") * 0.5)
        sp[:] = NAN
        sp[5] = self._v[2]
        sp[9] = self._yaw
        if level or not self._ekf.xy_valid:
            sp[6] = sp[7] = 0.0
            return
        for i in range(2):
            self._slew(i, 2.0 * real("MPC_XY_TRAJ_P") * float(self._goal[i] - self._p[i]), dt, real("MPC_ACC_HOR"))
            self._p[i] += self._v[i] * dt
            sp[i], sp[3 + i] = self._p[i], self._v[i]

    def _return(self, dt: float, distance_bottom_m: float | None, sp: Array) -> None:
        """Climb to the return height (within a cone near home), fly home, descend and land."""
        o, real = self._ekf.o, self._params.real
        away = math.hypot(o[7] - self.home[0], o[8] - self.home[1])
        if self._phase == 0:
            height = real("RTL_RETURN_ALT")
            cone = self._params.integer("RTL_CONE_ANG")
            if cone > 0 and away < height:
                height = max(min(height, away / math.tan(math.radians(cone)) * 2.0), min(real("RTL_DESCEND_ALT"), away))
            self._goal[2] = min(float(self._p[2]), float(self.home[2]) - height)
            self._phase = 1
        if self._phase == 1 and abs(o[9] - self._goal[2]) < REACHED_M:
            self._goal[:2] = self.home[:2]
            if away < real("NAV_MC_ALT_RAD"):
                self._phase = 2
        if self._phase == 2:
            self._land(sp, dt, distance_bottom_m, level=False)
