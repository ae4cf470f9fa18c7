"""How steadily the flight controller is fed: intervals of what it needs at a beat, and how late the beat comes."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from companion.messages import Event, Severity

MESSAGES = {331: "odometry", 84: "setpoint"}  # ODOMETRY, SET_POSITION_TARGET_LOCAL_NED of MAVLink common
LAG_LIMIT_NS, LAG_TOLD_NS = 100_000_000, 10_000_000_000


@dataclass(slots=True)
class Cadence:
    """Fed with every frame that leaves and with the lateness of every beat."""

    longest_lag_s: float = 0.0
    _sent_ns: dict[str, list[int]] = field(default_factory=lambda: {name: [] for name in MESSAGES.values()})
    _told_ns: int = -(1 << 62)

    def sent(self, frame: bytes, t_ns: int) -> None:
        """A MAVLink 2 frame left."""
        name = MESSAGES.get(int.from_bytes(frame[7:10], "little"))
        if name is not None:
            self._sent_ns[name].append(t_ns)

    def lag(self, t_ns: int, lag_ns: int) -> Event | None:
        """A beat came so late; an event when the computer is overloaded, at most once in a while."""
        self.longest_lag_s = max(self.longest_lag_s, lag_ns * 1e-9)
        if lag_ns <= LAG_LIMIT_NS or t_ns - self._told_ns <= LAG_TOLD_NS:
            return None
        self._told_ns = t_ns
        text = f"Overloaded: a beat came {lag_ns * 1e-6:.0f} ms late"
        return Event(t_ns=t_ns, severity=Severity.WARNING, name="overloaded", text=text)

    def report(self) -> dict[str, dict[str, float]]:
        """Intervals as measured: median, 99th percentile, longest, in s."""
        out: dict[str, dict[str, float]] = {}
        for name, times in self._sent_ns.items():
            interval = np.diff(np.array(times, dtype=np.int64)) * 1e-9
            if len(interval):
                median, high = np.percentile(interval, [50, 99])
                out[name] = {"median_s": float(median), "p99_s": float(high), "max_s": float(interval.max())}
        return out
