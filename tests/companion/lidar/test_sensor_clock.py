"""The sensor's clock in the companion's, with jitter, drift, steps and stalls."""

from __future__ import annotations

import numpy as np

from companion.lidar.sensor_clock import STEP_PACKETS, SensorClock

PACKET_NS = 3_125_000
OFFSET_NS = 123_456_789_000


def test_jitter_only_ever_adds_so_the_smallest_delay_holds() -> None:
    clock = SensorClock()
    rng = np.random.default_rng(0)
    for n in range(3200):
        stamp = n * PACKET_NS
        clock.update(stamp, stamp + OFFSET_NS + 200_000 + int(rng.exponential(1_000_000)))
    assert clock.offset_ns is not None
    assert 200_000 <= clock.offset_ns - OFFSET_NS < 210_000
    assert clock.steps == 0


def test_drift_of_50_ppm_is_followed() -> None:
    clock = SensorClock()
    worst = 0
    for n in range(32_000):
        arrival = n * PACKET_NS
        stamp = round(arrival * (1 - 50e-6))
        clock.update(stamp, arrival + OFFSET_NS)
        assert clock.offset_ns is not None
        worst = max(worst, abs(stamp + clock.offset_ns - (arrival + OFFSET_NS)))
    assert worst <= 600_000


def test_stall_of_the_host_moves_nothing() -> None:
    clock = SensorClock()
    for n in range(100):
        clock.update(n * PACKET_NS, n * PACKET_NS + OFFSET_NS)
    woke = 160 * PACKET_NS
    for n in range(100, 160):  # a backlog is read at once
        clock.update(n * PACKET_NS, woke + OFFSET_NS + n * 1000)
    assert clock.offset_ns == OFFSET_NS
    assert clock.steps == 0


def test_step_of_the_sensor_clock_is_taken_up_after_a_few_packets() -> None:
    for step in (-3_000_000_000, 40_000_000, 60_000_000_000):
        clock = SensorClock()
        for n in range(100):
            clock.update(n * PACKET_NS, n * PACKET_NS + OFFSET_NS)
        for n in range(100, 100 + STEP_PACKETS + 1):
            clock.update(n * PACKET_NS + step, n * PACKET_NS + OFFSET_NS)
        assert clock.offset_ns == OFFSET_NS - step, step
        assert clock.steps == 1


def test_one_wild_stamp_moves_nothing() -> None:
    clock = SensorClock()
    for n in range(200):
        wild = n == 100
        clock.update(n * PACKET_NS + (10**15 if wild else 0), n * PACKET_NS + OFFSET_NS)
    assert clock.offset_ns == OFFSET_NS
    assert clock.steps == 0
