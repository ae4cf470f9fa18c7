"""How fast is the emulated world alone: physics, sensors and LiDAR, without flight controller or companion?

    python -m benchmarks.simbridge_speed [MISSION ...] [--seconds 10] [--rows 5]

Prints, for each mission, the mean time of a 4 ms step and how many times real time that is: by the wall clock, and by
the processor's time of this thread, which other programs on the machine do not stretch so much.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from simbridge.config import SimConfig
from simbridge.loop import Simulation
from simbridge.sensors import BaroSample, ImuSample

SHIPPED = [f"missions/{name}.yaml" for name in ("cement_store", "leaning_pile", "l_shaped", "columns", "silo")]
HEIGHT_M = 9.0


class HoldsThrust:
    """Keeps the vehicle in the air by a constant command: costs nothing."""

    command: NDArray[np.float64] = np.full(4, 0.5194)

    def step(
        self, t_ns: int, imu: ImuSample, baro: BaroSample | None, rangefinder_m: float | None
    ) -> NDArray[np.float64]:
        return self.command


def measure(mission: Path, seconds: float, rows: int) -> tuple[float, float]:
    """Mean time of a step, s: wall clock, processor."""
    raw = yaml.safe_load(mission.read_text(encoding="utf-8"))
    sections = {key: raw[key] for key in ("world", "vehicle")}
    simulation = Simulation(SimConfig.model_validate({**sections, "lidar": {"rows": rows}}), HoldsThrust())
    simulation._vehicle.position[2] = HEIGHT_M
    steps = round(seconds * 250)
    wall, processor = time.perf_counter(), time.thread_time()
    for _ in range(steps):
        simulation.step()
        simulation.take_lidar_packets()
    return (time.perf_counter() - wall) / steps, (time.thread_time() - processor) / steps


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("missions", nargs="*", type=Path, default=[Path(m) for m in SHIPPED])
    parser.add_argument("--seconds", type=float, default=10.0, help="simulated, for each mission")
    parser.add_argument("--rows", type=int, default=5)
    args = parser.parse_args()
    for mission in args.missions:
        wall, processor = measure(mission, args.seconds, args.rows)
        print(
            f"{mission.stem:14} {args.rows} x 512 at 10 Hz: {wall * 1e6:6.1f} us a step, {0.004 / wall:5.1f} x real time; "
            f"processor {processor * 1e6:6.1f} us, {0.004 / processor:5.1f} x"
        )


if __name__ == "__main__":
    main()
