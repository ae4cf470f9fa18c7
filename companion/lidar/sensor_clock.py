"""The sensor's clock in the companion's: what a stamp of the LiDAR is in companion time."""

from __future__ import annotations

from itertools import pairwise

WINDOW_NS = 5_000_000_000  # two windows are looked at: an oscillator that is off by 50 ppm moves 0.5 ms in 10 s
STEP_NS = 100_000_000  # a change this large is no jitter of a local network: the sensor's clock has stepped
STEP_PACKETS = (
    8  # in a row, before a step is believed: a burst after a stall of the host is longer late than one packet
)
EARLY_NS = 5_000_000  # a packet cannot be this much faster than the fastest of before, unless the clock stepped


class SensorClock:
    """Smallest (arrival - stamp) of the last 5 to 10 s: delay only ever adds, so the smallest is nearest to the truth.

    A step of the sensor's clock (restart, PTP lock) is believed after STEP_PACKETS packets in a row; then all is
    forgotten and `steps` counts one. Until then the old offset holds, so a single forged or broken stamp moves nothing.
    """

    def __init__(self) -> None:
        self.steps = 0
        self._offset_ns: int | None = None
        self._window_start_ns = 0
        self._current_ns = 0
        self._previous_ns: int | None = None
        self._strange: list[int] = []

    @property
    def offset_ns(self) -> int | None:
        """Companion time minus sensor time, ns; None before the first packet."""
        return self._offset_ns

    def update(self, stamp_ns: int, arrival_ns: int) -> None:
        """Take one packet: its newest stamp (sensor's clock) and when it came (companion's)."""
        delay = arrival_ns - stamp_ns
        if self._offset_ns is None:
            self._restart(delay, arrival_ns)
            return
        excess = delay - self._offset_ns
        if excess < -EARLY_NS or excess > STEP_NS:
            self._strange.append(delay)
            if len(self._strange) >= STEP_PACKETS:
                self._judge_step(arrival_ns)
            return
        if self._strange:
            self._strange.clear()
        if arrival_ns - self._window_start_ns >= WINDOW_NS:
            self._previous_ns, self._current_ns = self._current_ns, delay
            self._window_start_ns = arrival_ns
        if delay < self._current_ns:
            self._current_ns = delay
        previous, current = self._previous_ns, self._current_ns
        self._offset_ns = current if previous is None or current < previous else previous

    def _judge_step(self, arrival_ns: int) -> None:
        """Believe the step if the strange packets agree; a backlog that drains (each less late) is no step."""
        late = self._strange
        if max(late) - min(late) < STEP_NS // 2 and not _drains(late):
            self.steps += 1
            self._restart(min(late), arrival_ns)
        late.clear()

    def _restart(self, delay_ns: int, arrival_ns: int) -> None:
        self._offset_ns = self._current_ns = delay_ns
        self._previous_ns = None
        self._window_start_ns = arrival_ns
        self._strange.clear()


def _drains(delays_ns: list[int]) -> bool:
    """Whether packets that waited are read faster than they were sent: every one less late than the one before."""
    return all(b < a for a, b in pairwise(delays_ns)) and delays_ns[0] - delays_ns[-1] > EARLY_NS
