"""ArduCopter leaves the ground in GUIDED only by NAV_TAKEOFF, and a velocity setpoint would break that off. So the
first upward setpoint becomes the command, and setpoints wait until the autopilot says that it flies."""

from __future__ import annotations

from dataclasses import dataclass

from companion.mavlink import wire
from companion.mavlink.commands import Commands, Outcome
from companion.mavlink.vehicle import Vehicle
from companion.messages import FlightMode, LandedState, Setpoint

HEIGHT_M = 1.5
RETRY_NS = 2_000_000_000
_CLIMB_MPS = 0.05


@dataclass(slots=True)
class Takeoff:
    commands: Commands
    is_running: bool = False
    _t_refused_ns: int | None = None

    def restart(self) -> None:
        self.is_running = False
        self._t_refused_ns = None

    def holds_back(self, vehicle: Vehicle, setpoint: Setpoint) -> bool:
        """True while setpoints must wait. Sends NAV_TAKEOFF when the first one points upward."""
        if not vehicle.is_armed or vehicle.mode is not FlightMode.OFFBOARD:
            self.is_running = False
            return False
        if vehicle.landed_state is LandedState.IN_AIR:
            self.is_running = False
        elif not self.is_running and vehicle.landed_state is LandedState.ON_GROUND and self._may_try(setpoint):
            self.is_running = True
            params = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, HEIGHT_M)
            self.commands.request(wire.CMD_NAV_TAKEOFF, params, setpoint.t_ns, label="takeoff", then=self._on_outcome)
        return self.is_running

    def _may_try(self, setpoint: Setpoint) -> bool:
        rests = self._t_refused_ns is not None and setpoint.t_ns - self._t_refused_ns < RETRY_NS
        return float(setpoint.velocity_map_mps[2]) > _CLIMB_MPS and not rests

    def _on_outcome(self, outcome: Outcome, t_ns: int) -> None:
        if not outcome.accepted:
            self.is_running = False
            self._t_refused_ns = t_ns
