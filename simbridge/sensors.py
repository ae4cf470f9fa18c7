"""What the flight controller's sensors report: inertial unit, barometer, downward rangefinder.

Axes are FRD (forward, right, down), as HIL_SENSOR wants them. Noise is seeded: each model has its own stream.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simbridge.config import BarometerConfig, ImuConfig, RangefinderConfig
from simbridge.rotation import matrix_from_rpy
from simbridge.streams import Normals, stream

Array = NDArray[np.float64]

GRAVITY_MPS2 = 9.81
STEP_NS = 4_000_000
STEPS_PER_S = 250

# White noise density of each axis: accelerometer (x, y, z) in g/sqrt(Hz), gyro in deg/s/sqrt(Hz).
# ICM-42688-P: TDK DS-000347 tables 1 and 2. BMI088: Bosch BST-BMI088-DS001 tables 2 and 3.
NOISE_DENSITY = {
    "icm-42688-p": ((65e-6, 65e-6, 70e-6), 2.8e-3),
    "bmi088": ((160e-6, 160e-6, 190e-6), 14e-3),
    "ideal": ((0.0, 0.0, 0.0), 0.0),
}

# Vibration. Its RMS lies at the rotors' speed and at the passing of their two blades, half of its power each: a sum of
# oscillations, whose integral stays small. What is random in it is a tenth: at 10 m/s2 and hover as much as EKF2's
# EKF2_ACC_NOISE of 0.35 m/s2 reckons with.
ROTORS = 4
FULL_SPEED_HZ = 140.0  # at full thrust; 84 Hz, 5000 rpm, at hover: 13 inch rotors under 3 kg
HARMONICS = (1.0, 2.0)
SPEED_SPREAD = 0.02  # 1 sigma between rotors: centre of gravity, blades
RANDOM_RATIO = 0.1


@dataclass(frozen=True, slots=True, kw_only=True)
class ImuSample:
    """Mean over one step. accel_frd_mps2: (3,) specific force, (0, 0, -9.81) at rest. gyro_frd_radps: (3,)."""

    accel_frd_mps2: Array
    gyro_frd_radps: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class BaroSample:
    """pressure_hpa: absolute (HIL_SENSOR.abs_pressure). pressure_altitude_m: the same by the ISA, above sea level."""

    pressure_hpa: float
    pressure_altitude_m: float
    temperature_c: float


class Imu:
    """Bias, misalignment, white noise and vibration on the true mean of a step."""

    def __init__(self, cfg: ImuConfig, seed: int, step_ns: int = STEP_NS) -> None:
        accel_density, gyro_density = NOISE_DENSITY[cfg.part]
        bandwidth = math.sqrt(0.5e9 / step_ns)  # white noise averaged over a step
        sigma = np.array([*(d * GRAVITY_MPS2 for d in accel_density), *(math.radians(gyro_density),) * 3]) * bandwidth
        shake = np.array((cfg.vibration_mps2,) * 3 + (math.radians(cfg.vibration_dps),) * 3)
        self._rotors = RotorVibration(shake, seed, step_ns) if shake.any() else None
        bias = stream(seed, "imu bias").standard_normal(6)
        ideal = cfg.part == "ideal"
        offset = bias * np.array(
            [0.0 if ideal else cfg.accel_bias_mps2] * 3 + [0.0 if ideal else math.radians(cfg.gyro_bias_dps)] * 3
        )
        turn = matrix_from_rpy(np.radians(cfg.misalignment_rpy_deg)).T
        self._turn = np.kron(np.eye(2), turn) if any(cfg.misalignment_rpy_deg) else None
        self._errors = Normals(
            stream(seed, "imu"),
            12,
            np.concatenate([sigma, RANDOM_RATIO * shake]),
            np.concatenate([offset, np.zeros(6)]),
        )

    def sample(self, truth: Array, thrust_ratio: float) -> ImuSample:
        """truth: (6,) specific force and turn rate of the airframe, FRD. thrust_ratio: 0..1, for vibration."""
        errors = self._errors.draw()
        felt = truth if self._turn is None else self._turn @ truth
        felt = felt + errors[:6]
        if self._rotors is not None:
            felt += thrust_ratio * errors[6:] + self._rotors.step(thrust_ratio)
        return ImuSample(accel_frd_mps2=felt[:3], gyro_frd_radps=felt[3:])


class RotorVibration:
    """What unbalanced rotors add to each axis: oscillations at multiples of their speeds, averaged over a step as an
    inertial unit does that samples at kHz and integrates (PX4's vehicle_imu)."""

    def __init__(self, rms: Array, seed: int, step_ns: int) -> None:
        """rms: (6,) of each axis at full thrust, before averaging."""
        rng = stream(seed, "vibration")
        speeds = 1.0 + SPEED_SPREAD * rng.standard_normal(ROTORS)
        self._turn_rad = 2.0 * math.pi * FULL_SPEED_HZ * step_ns * 1e-9 * np.outer(HARMONICS, speeds).ravel()
        self._amplitude = rms[:, None] * math.sqrt(2.0 / len(self._turn_rad))
        self._offset_rad = rng.uniform(-math.pi, math.pi, (6, len(self._turn_rad)))
        self._phase_rad = np.zeros(len(self._turn_rad))

    def step(self, thrust_ratio: float) -> Array:
        """(6,) mean over the next step. thrust_ratio: 0..1; speed goes with its root, force with the speed's square."""
        half_rad = 0.5 * math.sqrt(max(thrust_ratio, 0.0)) * self._turn_rad
        kept = np.sinc(half_rad / math.pi)
        swing = np.sin(self._phase_rad + half_rad + self._offset_rad) @ kept
        self._phase_rad = (self._phase_rad + 2.0 * half_rad) % (2.0 * math.pi)
        mean: Array = thrust_ratio * self._amplitude[:, 0] * swing
        return mean


class Barometer:
    """ISA pressure at a site, with white noise and a slow wander."""

    def __init__(self, cfg: BarometerConfig, seed: int, step_ns: int = STEP_NS) -> None:
        self._cfg, self._step_ns = cfg, step_ns
        self._period_ns = 1_000_000_000 // cfg.rate_hz
        self._normals = Normals(stream(seed, "barometer"), 2)
        self._keep = math.exp(-1.0 / (cfg.rate_hz * cfg.drift_time_s))
        self._drift_hpa = 0.0

    def sample(self, t_ns: int, z_m: float) -> BaroSample | None:
        """None in steps without a measurement."""
        if t_ns % self._period_ns >= self._step_ns:
            return None
        cfg, (white, slow) = self._cfg, self._normals.draw()
        self._drift_hpa = self._keep * self._drift_hpa + math.sqrt(1.0 - self._keep**2) * cfg.drift_hpa * float(slow)
        pressure = isa_pressure_hpa(cfg.site_altitude_m + z_m) + self._drift_hpa + cfg.noise_hpa * float(white)
        return BaroSample(
            pressure_hpa=pressure, pressure_altitude_m=isa_altitude_m(pressure), temperature_c=cfg.temperature_c
        )


class Rangefinder:
    """Distance along the body's -z axis, its mount already taken off, so from the body's origin."""

    def __init__(self, cfg: RangefinderConfig, seed: int, step_ns: int = STEP_NS) -> None:
        self._cfg, self._step_ns = cfg, step_ns
        self._period_ns = 1_000_000_000 // cfg.rate_hz
        self._normals = Normals(stream(seed, "rangefinder"), 1)

    def is_due(self, t_ns: int) -> bool:
        return self._cfg.enabled and t_ns % self._period_ns < self._step_ns

    def sample(self, true_m: float) -> float | None:
        """true_m: negative where the ray meets nothing. None: nothing came back, or out of range."""
        measured = true_m + self._cfg.noise_m * float(self._normals.draw()[0])
        if true_m < 0.0 or not self._cfg.min_range_m <= measured <= self._cfg.max_range_m:
            return None
        return measured


def isa_pressure_hpa(altitude_m: float) -> float:
    """Pressure of the International Standard Atmosphere (ISO 2533), below 11 km."""
    return float(1013.25 * (1.0 - 2.25577e-5 * altitude_m) ** 5.25588)


def isa_altitude_m(pressure_hpa: float) -> float:
    """Inverse of `isa_pressure_hpa`."""
    return float((1.0 - (pressure_hpa / 1013.25) ** (1.0 / 5.25588)) / 2.25577e-5)
