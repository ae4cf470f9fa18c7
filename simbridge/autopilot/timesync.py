"""The offset of a companion's clock, as PX4 learns it from TIMESYNC (lib/timesync)."""

from __future__ import annotations

CONVERGED = 500  # good exchanges; at 10 Hz that takes 50 s
MAX_ROUND_TRIP_NS = 10_000_000
MAX_DEVIATION_NS = 100_000_000
MAX_DEVIATIONS = 10
SLOWEST_GAIN = 0.003


class TimeSync:
    """One link's estimate of (our time - the companion's time)."""

    def __init__(self) -> None:
        self._reset()

    def _reset(self) -> None:
        self._offset_ns = 0.0
        self._count = 0
        self._deviating = 0

    @property
    def converged(self) -> bool:
        return self._count >= CONVERGED

    def answer(self, sent_ns: int, remote_ns: int, now_ns: int) -> None:
        """Take one answer: ts1 we sent, tc1 the companion's clock when it answered."""
        if now_ns - sent_ns > MAX_ROUND_TRIP_NS or now_ns < sent_ns:
            return
        offset = (sent_ns + now_ns) / 2 - remote_ns
        if self._count and abs(offset - self._offset_ns) > MAX_DEVIATION_NS:
            self._deviating += 1
            if self._deviating > MAX_DEVIATIONS:
                self._reset()
            return
        self._deviating = 0
        self._count += 1
        gain = max(1.0 / self._count, SLOWEST_GAIN)
        self._offset_ns += gain * (offset - self._offset_ns)

    def stamp(self, remote_ns: int, now_ns: int) -> int:
        """A companion's stamp in our clock; the time of arrival until the offset is known."""
        return remote_ns + round(self._offset_ns) if self.converged else now_ns
