"""Pace: simulated time against the wall, by a clock that the test turns."""

from __future__ import annotations

import pytest

from simbridge import server
from simbridge.server import BEHIND_LIMIT_S, LATE_TICK_S, Pace

STEP_NS = 4_000_000


class Clock:
    """Stands in for `time`: sleeping takes exactly as long as asked."""

    def __init__(self) -> None:
        self.now_s = 1000.0
        self.slept_s = 0.0

    def monotonic(self) -> float:
        return self.now_s

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds
        self.slept_s += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(server, "time", clock)
    return clock


def fly(pace: Pace, clock: Clock, first: int, steps: int, work_s: float) -> None:
    for i in range(first, first + steps):
        clock.now_s += work_s
        pace.wait(i * STEP_NS)


def test_a_machine_that_is_fast_enough_holds_its_pace_and_is_never_late(clock: Clock) -> None:
    pace = Pace(1.0)
    clock.now_s += 30.0  # the boot of an autopilot counts for nothing
    fly(pace, clock, 0, 1001, work_s=0.003)
    paced = pace.since()
    assert paced.sim_time_s == pytest.approx(4.0)
    assert paced.real_time_factor == pytest.approx(1.0)
    assert paced.late_ticks == 0
    assert clock.slept_s == pytest.approx(1.0)


def test_a_machine_that_is_too_slow_shows_in_the_factor_and_the_late_ticks(clock: Clock) -> None:
    pace = Pace(1.0)
    fly(pace, clock, 0, 1001, work_s=0.008)
    paced = pace.since()
    assert paced.real_time_factor == pytest.approx(0.5)
    assert 900 < paced.late_ticks <= 1000
    assert pace.late_s > 3.0


def test_one_pause_is_caught_up_and_its_late_ticks_counted(clock: Clock) -> None:
    pause_s = 0.1
    assert LATE_TICK_S < pause_s < BEHIND_LIMIT_S
    pace = Pace(1.0)
    fly(pace, clock, 0, 500, work_s=0.001)
    clock.now_s += pause_s
    fly(pace, clock, 500, 500, work_s=0.001)
    paced = pace.since()
    assert paced.real_time_factor == pytest.approx(1.0)
    assert paced.late_ticks == pytest.approx((pause_s - LATE_TICK_S) / 0.003, abs=2)
    assert pace.late_s == 0.0


def test_a_stretch_knows_only_of_itself(clock: Clock) -> None:
    """What was late before lift-off is no lateness of the flight."""
    pace = Pace(1.0)
    fly(pace, clock, 0, 500, work_s=0.008)
    liftoff = pace.newest
    fly(pace, clock, 500, 1000, work_s=0.001)
    in_flight = pace.since(liftoff)
    assert pace.since().real_time_factor == pytest.approx(0.73, abs=0.05)
    assert in_flight.sim_time_s == pytest.approx(4.0)
    assert in_flight.late_ticks < pace.since().late_ticks


def test_at_twice_real_time_the_factor_is_two(clock: Clock) -> None:
    pace = Pace(2.0)
    fly(pace, clock, 0, 1001, work_s=0.001)
    assert pace.since().real_time_factor == pytest.approx(2.0)


def test_before_the_first_step_nothing_is_claimed() -> None:
    assert Pace(1.0).since().real_time_factor is None
