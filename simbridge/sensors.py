"""What the flight controller's sensors report: inertial unit, barometer, downward rangefinder.

Axes are FRD (forward, right, down), as HIL_SENSOR wants them. Noise is seeded: each model is given its own Generator.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

GRAVITY_MPS2 = 9.81


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


def isa_pressure_hpa(altitude_m: float) -> float:
    """Pressure of the International Standard Atmosphere (ISO 2533), below 11 km."""
    return float(1013.25 * (1.0 - 2.25577e-5 * altitude_m) ** 5.25588)


def isa_altitude_m(pressure_hpa: float) -> float:
    """Inverse of `isa_pressure_hpa`."""
    return float((1.0 - (pressure_hpa / 1013.25) ** (1.0 / 5.25588)) / 2.25577e-5)
