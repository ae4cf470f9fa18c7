"""Prints how the emulated autopilot flies beside real PX4 (shared/VEHICLE.md), and what a step costs.

python -m tests.simbridge.autopilot.measure
"""

from __future__ import annotations

import math
import time

import numpy as np

from tests.simbridge.autopilot.rig import Rig


def _rows(rig: Rig, begin: float, end: float | None = None) -> np.ndarray:
    return np.array([row for t, row in rig.log if begin <= t <= (end or rig.t_s)])


def flight(seed: int) -> dict[str, float]:
    """The flight of VEHICLE.md: climb 4 m, hold, forward, stop, turn, land."""
    out: dict[str, float] = {}
    rig = Rig(seed=seed)
    rig.takeoff(4.0)
    rig.fly(5.0)
    begin = rig.t_s
    rig.fly(10.0)
    hold = _rows(rig, begin)
    out["hold, horizontal RMS, cm"] = 100 * float(np.hypot(*hold[:, :2].std(axis=0)))
    out["hold, drift in 10 s, cm"] = 100 * float(np.hypot(*(hold[-1, :2] - hold[0, :2])))
    out["climb overshoot, cm"] = 100 * float(-_rows(rig, 0.0)[:, 2].min() - 4.0)
    begin = rig.t_s
    rig.body_velocity(0.43, 0.0, 0.0, 0.0)
    rig.fly(10.0)
    forward = _rows(rig, begin)
    out["forward overshoot, %"] = 100 * float(forward[:, 3].max() / 0.43 - 1)
    out["forward 90 % rise, s"] = 0.004 * float(np.argmax(forward[:, 3] > 0.9 * 0.43))
    begin, at = rig.t_s, rig.position_ned()[0]
    rig.body_velocity(0.0, 0.0, 0.0, 0.0)
    rig.fly(4.0)
    out["stop distance, m"] = float(_rows(rig, begin)[:, 0].max() - at)
    begin, yaw = rig.t_s, rig.yaw()
    rig.body_velocity(0.0, 0.0, 0.0, math.radians(20.0))
    rig.fly(4.5)
    rig.body_velocity(0.0, 0.0, 0.0, 0.0)
    rig.fly(4.0)
    turn = np.degrees(_rows(rig, begin)[:, 6] - yaw)
    out["turn of 90 deg, peak"], out["turn of 90 deg, settled"] = float(turn.max()), float(turn[-1])
    begin = rig.t_s
    rig.mode(4, 6)
    rig.stream(None)
    rig.until(lambda: not rig.autopilot.commander.is_armed, 20.0)
    out["landing from 4 m to disarmed, s"] = rig.t_s - begin
    out["peak descent, m/s"] = float(_rows(rig, begin)[:, 5].max())
    return out


def step_cost(links: tuple[str, ...], lowered: bool) -> float:
    """Mean CPU microseconds of one 4 ms step in flight, what arrives and leaves included."""
    rig = Rig(links=links)
    rig.step()
    if lowered:
        for number, interval_us in (
            (30, -1),
            (31, 20000),
            (32, 100000),
            (33, 500000),
            (105, -1),
            (331, -1),
            (83, -1),
            (85, -1),
        ):
            rig.command(511, number, interval_us)
    rig.takeoff(2.0)
    autopilot, spent = rig.autopilot, [0.0]
    step, receive = autopilot.step, autopilot.receive

    def timed_step(*args: object) -> object:
        begin = time.process_time()
        try:
            return step(*args)  # type: ignore[arg-type]
        finally:
            spent[0] += time.process_time() - begin

    def timed_receive(*args: object) -> None:
        begin = time.process_time()
        receive(*args)  # type: ignore[arg-type]
        spent[0] += time.process_time() - begin

    autopilot.step, autopilot.receive = timed_step, timed_receive  # type: ignore[method-assign, assignment]
    rig.fly(20.0)
    return spent[0] / 5000 * 1e6


PX4 = {
    "hold, horizontal RMS, cm": "1.1", "hold, drift in 10 s, cm": "3.2", "climb overshoot, cm": "none",
    "forward overshoot, %": "6.0", "forward 90 % rise, s": "1.1", "stop distance, m": "0.27",
    "turn of 90 deg, peak": "93.2 to 93.5",
    "turn of 90 deg, settled": "90.6 to 91.0", "landing from 4 m to disarmed, s": "9.3", "peak descent, m/s": "0.75",
}  # fmt: skip

if __name__ == "__main__":
    flights = [flight(seed) for seed in (1, 2, 3)]
    for name in flights[0]:
        values = "  ".join(f"{f[name]:7.2f}" for f in flights)
        print(f"{name:34s} {values}   real PX4: {PX4[name]}")
    print(f"step, one link at lowered rates     {step_cost(('offboard',), True):6.1f} us")
    print(f"step, one link at default rates     {step_cost(('offboard',), False):6.1f} us")
    print(f"step, both links at default rates   {step_cost(('offboard', 'gcs'), False):6.1f} us")
