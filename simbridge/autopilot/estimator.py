"""The emulated EKF2: inertial prediction on a delayed horizon, barometer, rest, and what external vision gives it.

An error-state filter of 15 states, 152 ms behind; an observer carries its result to now. Constants and rules are those of
PX4 1.18 (ekf2/EKF/common.h, aid_sources/*, ekf_helper.cpp). What external vision may do is in `aiding`.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from simbridge.autopilot import kernels
from simbridge.autopilot.aiding import VisionAiding
from simbridge.autopilot.geo import Origin
from simbridge.autopilot.params import ParamStore
from simbridge.autopilot.vision import VisionSample
from simbridge.sensors import BaroSample, ImuSample

MS = 1_000_000
HORIZON_NS = (kernels.RING - 1) * 8 * MS
ATTITUDE_AFTER_NS = 1_200 * MS  # tilt alignment ends about then (recorded: 1.0 to 1.5 s after the first datagram)
REST_PERIOD_NS = 200 * MS
ZERO_VELOCITY_VAR = 0.2**2 / 4  # zero_velocity_update at rest
ZERO_GYRO_VAR = 0.01**2
BARO_BIAS_TAU_S = 10.0


class Estimator:
    """State estimate from IMU, barometer and external vision. `x`, `P`: delayed; `o`: now (layouts in `kernels`)."""

    def __init__(self, params: ParamStore) -> None:
        self._params = params
        self.x = np.zeros(16)
        self.P = np.zeros((15, 15))
        self.o = np.zeros(25)
        self.x[0] = self.o[0] = 1.0
        self._acc = np.zeros(8)
        self._ring_imu = np.zeros((kernels.RING, 7))
        self._ring_out = np.zeros((kernels.RING, 10))
        self._head = 0
        self._started_ns = -1
        self._tuning = np.array(
            [
                params.real(f"EKF2_{n}")
                for n in ("GYR_NOISE", "ACC_NOISE", "GYR_B_NOISE", "ACC_B_NOISE", "TAU_VEL", "TAU_POS")
            ]
        )
        self._baro: deque[tuple[int, float]] = deque(maxlen=32)
        self._baro_ground_m = math.nan
        self._baro_bias_m = 0.0
        self.baro_ratio = math.nan
        self._next_rest_ns = 0
        self.now_ns = 0
        self.origin: Origin | None = None
        self.vision = VisionAiding(self, params)
        self.at_rest = True

    def step(self, t_ns: int, imu: ImuSample, dt: float) -> bool:
        """Take one IMU sample. True on the steps that moved the horizon (every second one)."""
        self.now_ns = t_ns
        if self._started_ns < 0:
            self._start(t_ns, imu)
        moved: bool = kernels.imu_step(
            self.x,
            self.P,
            self.o,
            self._acc,
            self._ring_imu,
            self._ring_out,
            self._head,
            imu.accel_frd_mps2,
            imu.gyro_frd_radps,
            dt,
            self._tuning,
        )
        if moved:
            self._head = (self._head + 1) % kernels.RING
            self._fuse_baro()
            self.vision.step(t_ns, t_ns - HORIZON_NS)
            if self.at_rest and t_ns >= self._next_rest_ns:
                self._fuse_rest(imu)
            elif not self.vision.aided and t_ns >= self._next_rest_ns:
                self._fuse_fake_position()
        return moved

    def add_baro(self, t_ns: int, sample: BaroSample) -> None:
        """Buffer one barometer sample until the horizon reaches it."""
        self._baro.append((t_ns, sample.pressure_altitude_m))

    def add_vision(self, sample: VisionSample) -> None:
        """Buffer one vision sample until the horizon reaches it."""
        self.vision.add(sample, self.now_ns)

    def set_origin(self, lat_deg: float, lon_deg: float, alt_m: float) -> None:
        """SET_GPS_GLOBAL_ORIGIN, with what it does to the local position in this version of PX4 (see PX4.md, section 6)."""
        first = self.origin is None
        self.origin = Origin(lat_deg, lon_deg, alt_m)
        self.vision.origin_set(first)

    def _start(self, t_ns: int, imu: ImuSample) -> None:
        """Tilt from the direction of gravity, heading 0."""
        self._started_ns = t_ns
        f = imu.accel_frd_mps2
        roll = math.atan2(-f[1], -f[2])
        pitch = math.atan2(f[0], math.hypot(f[1], f[2]))
        cr, sr, cp, sp = math.cos(roll / 2), math.sin(roll / 2), math.cos(pitch / 2), math.sin(pitch / 2)
        q = np.array([cr * cp, sr * cp, cr * sp, -sr * sp])
        self.x[0:4] = self.o[0:4] = q
        self._ring_out[:, 0:4] = q
        real = self._params.real
        sigmas = [real("EKF2_ANGERR_INIT")] * 3 + [0.5] * 3 + [0.5] * 3
        sigmas += [real("EKF2_GBIAS_INIT")] * 3 + [real("EKF2_ABIAS_INIT")] * 3
        np.fill_diagonal(self.P, np.square(sigmas))
        self.P[2, 2] = 1e-2

    def _fuse_baro(self) -> None:
        """Height from pressure. With vision as the reference its offset is tracked, so that it takes over without a jump."""
        horizon = self.now_ns - HORIZON_NS
        while self._baro and self._baro[0][0] <= horizon:
            altitude = self._baro.popleft()[1]
            if math.isnan(self._baro_ground_m):
                self._baro_ground_m = altitude
            if self._params.integer("EKF2_BARO_CTRL") == 0 and self.vision.height.active:
                continue
            z = -(altitude - self._baro_ground_m) + self._baro_bias_m
            innovation = z - self.x[9]
            variance = self._params.real("EKF2_BARO_NOISE") ** 2
            if self.vision.height_is_reference:
                self._baro_bias_m -= innovation * min(0.02 / BARO_BIAS_TAU_S, 1.0)
            gate = self._params.real("EKF2_BARO_GATE")
            self.baro_ratio = innovation**2 / (gate**2 * (self.P[8, 8] + variance))
            if self.baro_ratio <= 1.0:
                kernels.fuse_state(self.x, self.P, 8, innovation, variance)
            elif not self.vision.height.active:  # nothing else says the height: take it
                bias = self._baro_bias_m
                self.shift(8, z)
                self._baro_bias_m = bias
                self.P[8, 8] = variance

    def _fuse_rest(self, imu: ImuSample) -> None:
        """On the ground and still: velocity and rates are zero. Not an aid: it does not keep a position valid."""
        self._next_rest_ns = self.now_ns + REST_PERIOD_NS
        for i in range(3):
            kernels.fuse_state(self.x, self.P, 3 + i, -self.x[4 + i], ZERO_VELOCITY_VAR)
            kernels.fuse_state(self.x, self.P, 9 + i, float(imu.gyro_frd_radps[i]) - self.x[10 + i], ZERO_GYRO_VAR)
        if not self.vision.aided:
            self._fuse_fake_position()

    def _fuse_fake_position(self) -> None:
        """Without any aid the position is held loosely where it is, which keeps the tilt from drifting off."""
        self._next_rest_ns = self.now_ns + REST_PERIOD_NS
        if self.vision.dead_reckoning:
            return
        noise = 0.5 if self.at_rest else self._params.real("EKF2_NOAID_NOISE")
        for i in range(2):
            kernels.fuse_state(self.x, self.P, 6 + i, 0.0, noise**2)

    def shift(self, index: int, value: float) -> None:
        """Reset error state `index` (3:9) to a value: the newest state jumps with it."""
        delta = np.zeros(6)
        delta[index - 3] = value - self.x[index + 1]
        self.x[index + 1] = value
        if index == 8:
            self._baro_bias_m += delta[5]
        kernels.shift_output(self.o, self._ring_out, delta)

    def turn(self, angle_rad: float) -> None:
        """Reset the heading by an angle: the newest attitude turns with it."""
        kernels.turn_ned(self.x[0:4], 0.0, 0.0, angle_rad)
        kernels.turn_output(self.o, self._ring_out, angle_rad)

    # what the rest of the autopilot reads

    @property
    def attitude_valid(self) -> bool:
        return self._started_ns >= 0 and self.now_ns - self._started_ns >= ATTITUDE_AFTER_NS

    @property
    def xy_valid(self) -> bool:
        return self.vision.xy_valid

    @property
    def z_valid(self) -> bool:
        return self._started_ns >= 0

    @property
    def global_valid(self) -> bool:
        """A position on the globe: origin known, heading aligned to north, position fused or dead reckoned."""
        return self.origin is not None and self.vision.yaw_aligned and self.vision.xy_valid

    @property
    def eph_m(self) -> float:
        return math.sqrt(max(self.P[6, 6] + self.P[7, 7], 0.0))

    @property
    def epv_m(self) -> float:
        return math.sqrt(max(self.P[8, 8], 0.0))

    @property
    def yaw_rad(self) -> float:
        return float(kernels.yaw_of(self.o))

    def flags(self) -> int:
        """ESTIMATOR_STATUS.flags, each bit as the recordings have it."""
        flags = 4 | 32 | 64 if self.attitude_valid else 4 | 32
        flags |= 1 if self.attitude_valid else 0
        flags |= (2 | 8 | 16) if self.xy_valid else 0
        flags |= 128 if self.at_rest else 0
        flags |= 256 if self.xy_valid and not self.vision.dead_reckoning else 0
        return flags
