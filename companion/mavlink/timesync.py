"""TIMESYNC both ways, and from it the autopilot's clock in ours."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

PERIOD_NS = 100_000_000  # 10 Hz
MAX_ROUND_TRIP_NS = 10_000_000  # PX4's lib/timesync takes no slower exchange
MAX_JUMP_NS = 100_000_000  # the same: MAX_DEVIATION_SAMPLE
JUMPS_TO_RESET = 10
GOOD_EXCHANGES = 5
_WINDOW = 32


@dataclass(frozen=True, slots=True)
class _Exchange:
    round_trip_ns: int
    offset_ns: int


class Timesync:
    """Offset between the clocks: t_companion = t_autopilot + offset. Also counts the answers that the autopilot got,
    since it does not tell when it has had enough of them."""

    def __init__(self) -> None:
        self.t_next_ns = 0
        self.max_round_trip_ns = MAX_ROUND_TRIP_NS
        self.restart()

    def restart(self) -> None:
        """Forget all: the autopilot's clock began anew."""
        self.answered = 0
        self.good = 0
        self.slow = 0
        self.unasked = 0
        self._jumps = 0
        self._asked: deque[int] = deque(maxlen=_WINDOW)
        self._exchanges: deque[_Exchange] = deque(maxlen=_WINDOW)
        self._quickest: _Exchange | None = None  # of them
        self._coarse_ns: int | None = None

    def ask(self, t_ns: int) -> tuple[int, int]:
        """(tc1, ts1) of our own question."""
        self._asked.append(t_ns)
        self.t_next_ns = t_ns + PERIOD_NS
        return 0, t_ns

    def on_message(self, tc1: int, ts1: int, t_ns: int) -> tuple[int, int] | None:
        """Take in a TIMESYNC. Returns the (tc1, ts1) to answer with, when it was a question."""
        if tc1 == 0:
            self.answered += 1
            return t_ns, ts1
        if ts1 not in self._asked:  # not our question: another's on the same link, or forged
            self.unasked += 1
            return None
        self._asked.remove(ts1)
        round_trip = t_ns - ts1
        if not 0 <= round_trip < self.max_round_trip_ns:
            self.slow += 1
            return None
        self._add(_Exchange(round_trip, ts1 + round_trip // 2 - tc1))
        return None

    def _add(self, exchange: _Exchange) -> None:
        offset = self.offset_ns
        if self._exchanges and offset is not None and abs(exchange.offset_ns - offset) > MAX_JUMP_NS:
            self._jumps += 1
            if self._jumps < JUMPS_TO_RESET:
                return
            self.restart()  # as PX4 does: a clock stepped, and the count begins anew
        self._jumps = 0
        self.good += 1
        self._exchanges.append(exchange)
        self._quickest = min(self._exchanges, key=lambda e: e.round_trip_ns)

    def note_arrival(self, t_autopilot_ns: int, t_ns: int) -> None:
        """A stamped message came: until exchanges are there, the quickest arrival so far gives a rough offset."""
        rough = t_ns - t_autopilot_ns
        if self._coarse_ns is None or rough < self._coarse_ns:
            self._coarse_ns = rough

    @property
    def offset_ns(self) -> int | None:
        """From the exchange with the shortest round trip of the last 32; before any, the rough one; None: unknown."""
        return self._coarse_ns if self._quickest is None else self._quickest.offset_ns

    def to_companion(self, t_autopilot_ns: int, t_arrival_ns: int) -> int:
        """A time of the autopilot's clock in ours; never later than its arrival."""
        self.note_arrival(t_autopilot_ns, t_arrival_ns)
        offset = self.offset_ns
        return t_arrival_ns if offset is None else min(t_autopilot_ns + offset, t_arrival_ns)

    def missing(self, answers_needed: int) -> str | None:
        """Why the clocks are not yet taken for synchronised; None when they are."""
        if self.good < GOOD_EXCHANGES:
            slow = (
                f", {self.slow} slower than {self.max_round_trip_ns // 1_000_000} ms were not used" if self.slow else ""
            )
            return f"time sync: {self.good} of {GOOD_EXCHANGES} of our questions answered in time{slow}"
        if self.answered < answers_needed:
            return (
                f"time sync: the autopilot has {self.answered} of the {answers_needed} exchanges it wants before it "
                f"uses our time stamps; at 10 Hz that takes {answers_needed // 10} s"
            )
        return None
