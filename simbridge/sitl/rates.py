"""Rates below the step's: a beat without drift, and a measurement held between its own."""

from __future__ import annotations

from dataclasses import dataclass

HOLD_NS = 200_000_000


@dataclass(slots=True)
class Beat:
    """True once in each period, from the first call on, whatever the steps between."""

    period_ns: int
    _next_ns: int | None = None

    def due(self, t_ns: int) -> bool:
        if self._next_ns is None:
            self._next_ns = t_ns
        if t_ns < self._next_ns:
            return False
        self._next_ns = max(self._next_ns, t_ns - self.period_ns) + self.period_ns
        return True


@dataclass(slots=True)
class HeldRange:
    """The newest distance, until HOLD_NS have passed without another: then None, nothing comes back any more."""

    distance_m: float | None = None
    _t_ns: int = 0

    def update(self, t_ns: int, measured_m: float | None) -> float | None:
        if measured_m is not None:
            self.distance_m, self._t_ns = measured_m, t_ns
        elif t_ns - self._t_ns > HOLD_NS:
            self.distance_m = None
        return self.distance_m
