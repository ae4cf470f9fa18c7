"""`stockpilot ground` through MAVSDK while the companion flies its mission: the operator's hold and landing win."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from typing import Any, Self

import numpy as np
import pytest
from typer.testing import CliRunner

from companion.flight import Flight
from companion.navigator import NavigatorState
from simbridge.link_frames import message_id
from simbridge.server import Pace, UdpLink
from stockpilot.ground import ground_app
from stockpilot.lockstep import Lockstep
from stockpilot.run import emulated
from stockpilot.wires import OFFBOARD
from tests.flights import small_mission
from tests.stockpilot.background import Background
from tests.stockpilot.emulated import free_port

pytestmark = pytest.mark.xdist_group("flight")
SETPOINT = 84


class TwoLinks:
    """The companion's link in one process, the ground station's on UDP."""

    def __init__(self, autopilot: Any, ground: UdpLink) -> None:
        self._autopilot, self._ground = autopilot, ground
        self.setpoints = 0

    def take(self, t_ns: int) -> list[bytes]:
        for data in self._ground.receive():
            self._autopilot.receive("gcs", data, t_ns)
        out = []
        for link, frame in self._autopilot.take_output():
            if link == OFFBOARD:
                out.append(frame)
            else:
                self._ground.send(frame)
        return out

    def send(self, frames: list[bytes], t_ns: int) -> None:
        self.setpoints += sum(message_id(frame) == SETPOINT for frame in frames)
        for frame in frames:
            self._autopilot.receive(OFFBOARD, frame, t_ns)


class Flying(Background):
    """A context: inside it the small hall is being flown, in a thread and not faster than real time, from the moment
    the companion looks for a wall."""

    def __init__(self) -> None:
        super().__init__()
        mission = small_mission()
        assert mission.sim is not None
        port = free_port()
        self.ground_url = f"udpin://127.0.0.1:{port}"
        self._link = UdpLink(remote=("127.0.0.1", port))
        self.simulation, autopilot = emulated(mission.sim, (OFFBOARD, "gcs"))
        self.wire = TwoLinks(autopilot, self._link)
        self.flight = Flight(config=mission.companion, lidar_metadata_json=self.simulation.lidar_metadata_json())
        self._lockstep = Lockstep(simulation=self.simulation, wire=self.wire, flight=self.flight, keep_scans=False)
        self.fault: BaseException | None = None

    def __enter__(self) -> Self:
        while self.state is not NavigatorState.FIND_WALL:
            self._lockstep.step()
            assert self.simulation.t_ns < 120e9
        return super().__enter__()

    def _close(self) -> None:
        self._link.close()

    def _run(self) -> None:
        pace = Pace(1.0)
        try:
            while not self._stop.is_set():
                self._lockstep.step()
                pace.wait(self.simulation.t_ns)
        except BaseException as error:  # told to the test
            self.fault = error

    @property
    def state(self) -> NavigatorState | None:
        return self.flight.navigation.state if self.flight.navigation is not None else None

    def let_pass(self, seconds: float) -> None:
        """Of the vehicle's own time."""
        end = self.simulation.t_ns + seconds * 1e9
        self.wait_for(lambda: self.simulation.t_ns >= end)

    def wait_for(self, is_so: Callable[[], bool], limit_s: float = 90.0) -> None:
        end = time.monotonic() + limit_s
        while not is_so():
            assert self.fault is None, self.fault
            assert time.monotonic() < end, f"still {self.state}"
            time.sleep(0.05)

    def ground(self, name: str) -> tuple[int, dict[str, Any]]:
        result = CliRunner().invoke(ground_app, [name, "--connect", self.ground_url, "--json"])
        return result.exit_code, json.loads(result.stdout)


@pytest.fixture
def flying() -> Iterator[Flying]:
    with Flying() as vehicle:
        yield vehicle


@pytest.mark.timeout(600)
def test_a_hold_from_the_ground_takes_it_from_the_companion_and_a_landing_ends_it(flying: Flying) -> None:
    """Issue 4: ground status, logs, hold, land through MAVSDK, in flight. FAULTS 29: the companion stops streaming and
    never takes it back unasked."""
    code, status = flying.ground("status")
    assert (code, status["mode"], status["armed"], status["landed_state"]) == (0, "offboard", True, "in_air"), status
    assert status["position_valid"]
    assert status["vision_fused"]
    code, logs = flying.ground("logs")
    assert (code, logs["logs"]) == (0, [])
    assert flying.state in (NavigatorState.FIND_WALL, NavigatorState.FOLLOW), "looking does not disturb"

    code, held = flying.ground("hold")
    assert (code, held["ok"], held["mode"]) == (0, True, "hold"), held
    flying.wait_for(lambda: flying.state is NavigatorState.INTERRUPTED)
    flying.let_pass(3.0)
    setpoints, place = flying.wire.setpoints, flying.simulation.truth().position_world_m
    flying.let_pass(3.0)
    assert flying.wire.setpoints == setpoints, "the companion no longer streams"
    assert np.linalg.norm(flying.simulation.truth().position_world_m - place) < 0.3, (
        "it stands on the companion's vision"
    )
    assert flying.state is NavigatorState.INTERRUPTED

    code, landing = flying.ground("land")
    assert (code, landing["ok"]) == (0, True), landing
    flying.wait_for(lambda: flying.flight.is_finished)
    assert flying.flight.navigation is not None
    assert flying.flight.navigation.outcome == "taken_over"
    assert not flying.simulation.collision
    code, status = flying.ground("status")
    assert (status["armed"], status["landed_state"]) == (False, "on_ground")


@pytest.mark.timeout(600)
def test_an_abort_from_the_ground_lands_it_where_it_is(flying: Flying) -> None:
    """FAULTS 28: always wins, acknowledged: held first, then landed."""
    place = flying.simulation.truth().position_world_m[:2]
    code, result = flying.ground("abort")
    assert (code, result["ok"], result["held_first"]) == (0, True, True), result
    flying.wait_for(lambda: flying.flight.is_finished)
    assert np.linalg.norm(flying.simulation.truth().position_world_m[:2] - place) < 6.0
    assert not flying.simulation.collision
