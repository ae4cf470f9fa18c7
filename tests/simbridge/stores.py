"""Small stores and a flight controller that only turns motors, for the tests of the emulated side."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from simbridge.config import SimConfig
from simbridge.loop import Simulation
from simbridge.sensors import BaroSample, ImuSample

HALL: dict[str, Any] = {"footprint": [[0, 0], [20, 0], [20, 12], [0, 12]], "height_m": 10}
CONE: dict[str, Any] = {"kind": "cone", "center": [13, 6], "height_m": 3, "repose_deg": 34}
HOVER = (math.sqrt(0.35**2 + 2.6 * 3.0 * 9.81 / (4 * 20.6)) - 0.35) / 1.3  # solves 4 Tmax (0.35 u + 0.65 u^2) = m g


class Motors:
    """Commands that a test sets; keeps what the sensors said."""

    def __init__(self, command: float | list[float] = 0.0) -> None:
        self.command: NDArray[np.float64] = np.full(4, command) if isinstance(command, float) else np.array(command)
        self.imu: list[ImuSample] = []
        self.baro: list[BaroSample | None] = []
        self.rangefinder: list[float | None] = []

    def step(
        self, t_ns: int, imu: ImuSample, baro: BaroSample | None, rangefinder_m: float | None
    ) -> NDArray[np.float64]:
        self.imu.append(imu)
        self.baro.append(baro)
        self.rangefinder.append(rangefinder_m)
        return self.command


def sim_config(**sections: Any) -> SimConfig:
    """A plain hall of 20 x 12 x 10 m with the vehicle at (4, 6), ideal sensors; sections are merged in."""
    vehicle: dict[str, Any] = {
        "start": [4, 6, 0],
        "imu": {"part": "ideal"},
        "barometer": {"noise_hpa": 0, "drift_hpa": 0},
        "rangefinder": {"noise_m": 0},
    }
    lidar: dict[str, Any] = {"noise_m": 0.0, "offset_sigma_m": 0.0, "grazing_deg": 89.9}
    return SimConfig.model_validate(
        {
            **sections,
            "world": {**HALL, **sections.get("world", {})},
            "vehicle": {**vehicle, **sections.get("vehicle", {})},
            "lidar": {**lidar, **sections.get("lidar", {})},
        }
    )


def lift(simulation: Simulation, z_m: float) -> None:
    """Put the vehicle at a height, as if it had flown there."""
    simulation._vehicle.position[2] = z_m


def run(simulation: Simulation, seconds: float) -> list[bytes]:
    """Fly on; the LiDAR packets of that time."""
    packets = []
    for _ in range(round(seconds * 250)):
        simulation.step()
        packets += simulation.take_lidar_packets()
    return packets
