"""The whole chain against an autopilot that no longer gets our setpoints and says nothing about it."""

from __future__ import annotations

import numpy as np
import pytest

from stockpilot.lockstep import Lockstep
from stockpilot.run import prepare
from tests.flights import small_mission

pytestmark = pytest.mark.xdist_group("flight")


@pytest.mark.timeout(300)
def test_an_autopilot_stuck_on_an_old_setpoint_is_told_to_land_within_seconds() -> None:
    """It still streams what it last heard, so its own time-out never acts: as ArduCopter, which holds in GUIDED."""
    fault = {"target": "setpoint", "kind": "stuck", "at_s": 25, "since": "liftoff"}
    prepared = prepare(small_mission(faults=[fault]))
    run = Lockstep(
        simulation=prepared.simulation,
        wire=prepared.wire,
        flight=prepared.flight,
        max_simulated_s=200,
        keep_scans=False,
    )
    outcome = run.run()
    assert outcome.state == "not_followed", outcome.reason
    assert "does not follow its setpoints: asked to move" in outcome.reason
    assert not prepared.simulation.collision
    assert prepared.simulation.liftoff_ns is not None
    begin_ns = run.t_ns - prepared.simulation.t_ns + prepared.simulation.liftoff_ns + 25_000_000_000
    (told,) = [event for event in prepared.flight.events if event.name == "not_followed"]
    assert 1.5 < (told.t_ns - begin_ns) / 1e9 < 8.0
    assert np.linalg.norm(prepared.simulation.truth().velocity_world_mps) < 0.2
