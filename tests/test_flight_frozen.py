"""The whole chain with a companion that stands still in flight and wakes to what lies in its sockets: old things."""

from __future__ import annotations

import numpy as np
import pytest

from companion.navigator import NavigatorState
from simbridge.loop import Simulation
from stockpilot.lockstep import Lockstep
from stockpilot.run import prepare
from tests.flights import small_mission
from tests.freeze import freeze

pytestmark = [pytest.mark.xdist_group("flight"), pytest.mark.timeout(300)]
FROZEN_AFTER_LIFTOFF_S = 30.0


def flying() -> tuple[Simulation, Lockstep]:
    prepared = prepare(small_mission())
    run = Lockstep(
        simulation=prepared.simulation,
        wire=prepared.wire,
        flight=prepared.flight,
        max_simulated_s=300,
        keep_scans=False,
    )
    simulation = run.simulation
    while (off := simulation.liftoff_ns) is None or simulation.t_ns < off + FROZEN_AFTER_LIFTOFF_S * 1e9:
        run.step()
    return simulation, run


def after(simulation: Simulation, seconds: float) -> float:
    return simulation.t_ns + seconds * 1e9


def test_a_companion_frozen_for_less_than_the_autopilots_patience_holds_and_flies_on() -> None:
    simulation, run = flying()
    at, wakes_ns = simulation.truth().position_world_m.copy(), after(simulation, 0.7)
    freeze(run, lambda: simulation.t_ns >= wakes_ns, limit_s=5.0)
    held_at = at
    while simulation.t_ns < wakes_ns + 5e9:
        run.step()
        assert run.flight.navigation is not None
        if run.flight.navigation.state is NavigatorState.HOLDING:
            held_at = simulation.truth().position_world_m.copy()
    assert not simulation.collision
    assert 0.2 < np.linalg.norm(held_at - at) < 2.0  # the old setpoint for 0.7 s, then to a stand
    assert run.flight.navigation is not None
    assert run.flight.navigation.state is NavigatorState.FOLLOW  # and on


def test_a_companion_that_wakes_after_the_autopilot_began_to_land_leaves_it_the_vehicle() -> None:
    """The autopilot's own time-out acted; what the companion finds first in its sockets is older and says OFFBOARD."""
    simulation, run = flying()
    at, wakes_ns = simulation.truth().position_world_m.copy(), after(simulation, 3.0)
    freeze(run, lambda: simulation.t_ns >= wakes_ns, limit_s=5.0)
    outcome = run.run()
    assert (outcome.state, simulation.collision) == ("taken_over", False), outcome.reason
    assert "failsafe" in outcome.reason
    # A real PX4, frozen as long in the same way, came down 0.8 m away: it flies on for 1 s, and vision is back before it is blind.
    assert np.linalg.norm((simulation.truth().position_world_m - at)[:2]) < 2.0
    assert np.linalg.norm(simulation.truth().velocity_world_mps) < 0.2
