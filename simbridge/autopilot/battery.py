"""The simulated battery of PX4 (SIM_BAT_*): drains in proportion to time while armed, down to a floor."""

from __future__ import annotations

from simbridge.autopilot.params import ParamStore


class Battery:
    """remaining: 0 to 1. `connected` is False with SIM_BAT_DRAIN 0: no battery simulator."""

    def __init__(self, params: ParamStore) -> None:
        self._params = params
        self.remaining = 1.0

    @property
    def connected(self) -> bool:
        return self._params.real("SIM_BAT_DRAIN") > 0.0

    @property
    def voltage_v(self) -> float:
        """Between BAT1_V_EMPTY and BAT1_V_CHARGED a cell, by what remains."""
        empty, full = self._params.real("BAT1_V_EMPTY"), self._params.real("BAT1_V_CHARGED")
        return self._params.integer("BAT1_N_CELLS") * (empty + (full - empty) * self.remaining)

    @property
    def warning(self) -> int:
        """0 none, 1 low, 2 critical, 3 emergency."""
        real = self._params.real
        if not self.connected:
            return 0
        thresholds = (real("BAT_LOW_THR"), real("BAT_CRIT_THR"), real("BAT_EMERGEN_THR"))
        return sum(self.remaining < threshold for threshold in thresholds)

    def step(self, dt_s: float, is_armed: bool) -> None:
        """Full again whenever disarmed, as PX4's simulator has it."""
        if not self.connected or not is_armed:
            self.remaining = 1.0
            return
        floor = self._params.real("SIM_BAT_MIN_PCT") / 100.0
        self.remaining = max(self.remaining - dt_s / self._params.real("SIM_BAT_DRAIN"), min(floor, self.remaining))
