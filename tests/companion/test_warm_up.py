"""Nothing is compiled in flight: a kernel that the warm-up leaves out would stop the setpoints for a second or more."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import Any

import pytest

PROGRAM = """
import importlib, json, pkgutil
import companion
from numba.core.dispatcher import Dispatcher
from companion.warm_up import warm_up
from stockpilot.lockstep import Lockstep
from stockpilot.run import prepare
from tests.flights import small_mission

def compiled():
    found = {}
    for info in pkgutil.walk_packages(companion.__path__, "companion."):
        for name, value in vars(importlib.import_module(info.name)).items():
            if isinstance(value, Dispatcher) and value.py_func.__module__ == info.name:
                found[f"{info.name}.{name}"] = len(value.signatures)
    return found

phases, flying = set(), {}

def look(runner):
    navigation = runner.flight.navigation
    phases.add(navigation.state.value if navigation is not None else "start")
    flying.update(compiled())

mission = small_mission(navigator={"max_flight_time_s": 60})
warm_up(mission.companion)
prepared = prepare(mission)
warm = compiled()
Lockstep(
    simulation=prepared.simulation, wire=prepared.wire, flight=prepared.flight, max_simulated_s=200.0
).run(look)
print(json.dumps({"warm": warm, "flying": flying, "phases": sorted(phases)}))
"""


@pytest.mark.timeout(300)
def test_no_kernel_is_compiled_once_it_flies() -> None:
    """In a process of its own: other tests of this one may have compiled what the warm-up forgot."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM], capture_output=True, text=True, env={**os.environ, "PYTHONPATH": "."}
    )
    assert done.returncode == 0, done.stderr
    seen: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    assert "follow" in seen["phases"]
    late = {name: n for name, n in seen["flying"].items() if n > seen["warm"].get(name, 0)}
    assert not late, f"compiled in flight: {late}"
    assert len(seen["warm"]) > 20
