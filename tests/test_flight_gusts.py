"""Take-off in a gust of 8 m/s: the vehicle leans into it while the pile's foot still passes for a wall."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from stockpilot.lockstep import Lockstep
from stockpilot.mission import load_mission
from stockpilot.run import prepare

ROOT = Path(__file__).resolve().parents[1]
pytestmark = pytest.mark.xdist_group("flight")


@pytest.mark.timeout(300)
def test_a_gust_at_take_off_does_not_make_odometry_jump_to_the_foot_of_the_pile() -> None:
    mission = load_mission(ROOT / "missions/cement_store.yaml", ["world.wind.gust_mps=3.0"], seed=0)
    prepared = prepare(mission)
    simulation = prepared.simulation
    run = Lockstep(
        simulation=simulation, wire=prepared.wire, flight=prepared.flight, max_simulated_s=100, keep_scans=False
    )
    start, yaw = simulation.truth().position_world_m, simulation.start[2]
    c, s = math.cos(yaw), math.sin(yaw)
    furthest_m, least_up = 0.0, 1.0
    while simulation.liftoff_ns is None or simulation.t_ns < simulation.liftoff_ns + 6_000_000_000:
        run.step()
        truth, estimate = simulation.truth(), prepared.flight.estimate
        if estimate is None or simulation.t_ns % 20_000_000:
            continue
        x, y, _ = truth.position_world_m - start
        off = estimate.position_map_m[:2] - np.array([c * x + s * y, c * y - s * x])
        furthest_m = max(furthest_m, float(np.hypot(*off)))
        _, qx, qy, _ = truth.q_world_body_wxyz
        least_up = min(least_up, float(1.0 - 2.0 * (qx * qx + qy * qy)))
    assert prepared.flight.estimate is not None
    assert prepared.flight.estimate.reset_counter == 0
    assert furthest_m < 0.35, "it was 0.7 m"
    assert math.degrees(math.acos(least_up)) < 9.0, "it was 15"
