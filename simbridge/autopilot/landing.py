"""Is the vehicle on the ground? PX4's multicopter land detector: contact, maybe landed, landed, each held for a time."""

from __future__ import annotations

import math

from simbridge.autopilot.controller import Controller, Takeoff
from simbridge.autopilot.kernels import Array
from simbridge.autopilot.params import ParamStore

CONTACT_NS = 350_000_000  # GROUND_CONTACT_TRIGGER_TIME_US
MAYBE_NS = 400_000_000  # then the setpoint goes idle; this and the next fit the recorded landings
LANDED_NS = 700_000_000
LIFT_THRUST = 0.16  # share of full thrust from which "on the ground" ends during the ramp (recorded 0.8 s into it)


class LandDetector:
    """Tells landed from flying by velocities, thrust and intent; never by where the ground is known to be."""

    def __init__(self, params: ParamStore) -> None:
        self._params = params
        self.is_landed = True
        self.has_contact = True
        self.maybe_landed = True
        self._contact_ns = -1
        self._maybe_ns = -1
        self._landed_ns = -1

    def update(
        self, t_ns: int, o: Array, controller: Controller, takeoff: Takeoff, is_armed: bool, down_mps: float
    ) -> bool:
        """One look, at 50 Hz. down_mps: the descent that the mode wants. Returns is_landed."""
        if not is_armed:
            if not self.is_landed and abs(o[6]) < 1.0:
                self.is_landed = self.has_contact = self.maybe_landed = True
            elif self.is_landed:
                self.has_contact = True
            return self.is_landed
        if self.is_landed:
            lifting = takeoff.state >= Takeoff.RAMP and controller.thrust > LIFT_THRUST
            if lifting:
                self.is_landed = self.has_contact = self.maybe_landed = False
                self._contact_ns = self._maybe_ns = self._landed_ns = -1
            return self.is_landed
        self.has_contact = self._held("_contact_ns", t_ns, self._contact(o, takeoff, down_mps), CONTACT_NS)
        low_thrust = controller.thrust <= self._params.real("MPC_THR_MIN") + 0.05
        still = math.hypot(o[10], o[11]) < math.radians(self._params.real("LNDMC_ROT_MAX"))
        self.maybe_landed = self._held("_maybe_ns", t_ns, self.has_contact and low_thrust and still, MAYBE_NS)
        self.is_landed = self._held("_landed_ns", t_ns, self.maybe_landed, LANDED_NS)
        return self.is_landed

    def _contact(self, o: Array, takeoff: Takeoff, down_mps: float) -> bool:
        """Told to go down and not going down."""
        if takeoff.state == Takeoff.RAMP or not down_mps >= 0.5 * self._params.real("MPC_LAND_CRWL"):
            return False
        return abs(float(o[6])) < min(self._params.real("LNDMC_Z_VEL_MAX"), 0.5 * down_mps)

    def _held(self, name: str, t_ns: int, condition: bool, duration_ns: int) -> bool:
        since: int = getattr(self, name)
        if not condition:
            setattr(self, name, -1)
            return False
        if since < 0:
            setattr(self, name, t_ns)
            return False
        return t_ns - since >= duration_ns
