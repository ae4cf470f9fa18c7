"""Scans registered by a process ahead give what they give here: the same frames, messages, map and counts."""

from __future__ import annotations

import itertools
import os
import signal
import time
from collections.abc import Callable

import pytest

from companion.recording import ahead, scan_ring
from companion.recording.replay import Replay
from tests.companion.recording.corner import recorded


def both_ways(kind: str, is_kept: Callable[[int], bool]) -> tuple[Replay, Replay]:
    """The recorded flight, of its calls of a kind only those kept, by number: scans registered here, and by a process ahead."""
    replays = []
    for is_ahead in (False, True):
        flight, inputs = recorded()
        count = itertools.count()
        inputs = [item for item in inputs if item.kind != kind or is_kept(next(count))]
        replay = Replay(flight)
        if is_ahead:
            with ahead.registering(flight, inputs) as replay.scans:
                replay.run(inputs)
        else:
            replay.run(inputs)
        replays.append(replay)
    here, other = replays
    assert len(here.frames) > 100
    return here, other


LOST = {
    "nothing": ("", 1),
    "every ninth packet": ("lidar", 9),
    "all packets": ("lidar", 1),
    "every third begin": ("begin", 3),
}


@pytest.mark.parametrize("lost", LOST)
def test_ahead_is_the_same_as_here(lost: str) -> None:
    kind, every = LOST[lost]
    here, other = both_ways(kind, lambda n: n % every != 0)
    assert other.frames == here.frames
    assert other.messages == here.messages
    assert other.unmatched == here.unmatched
    assert (here.unmatched > 0) == (lost != "nothing")
    assert other.flight.decoder.dropped == here.flight.decoder.dropped
    assert other.flight.mapper.size == here.flight.mapper.size
    assert (here.flight.mapper.size > 1000) == (lost != "all packets")


def test_a_ring_of_two_places_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scans without an accept are taken on the other side while the replay waits for room: neither waits for good."""
    monkeypatch.setattr(scan_ring, "MOST_PLACES", 2)
    here, other = both_ways("accept", lambda n: n % 5 == 0)
    assert isinstance(other.scans, ahead.ScansAhead)
    assert other.scans.feeder.ring.places == 2
    assert other.frames == here.frames
    assert other.flight.mapper.size == here.flight.mapper.size


def test_a_process_that_ends_early_is_told_and_not_taken_for_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    flight, inputs = recorded()
    monkeypatch.setattr(ahead, "register", lambda *_: os._exit(3))
    replay = Replay(flight)
    with ahead.registering(flight, inputs) as replay.scans, pytest.raises(RuntimeError, match="ended early"):
        replay.run(inputs)


def test_a_process_that_does_not_mind_sigterm_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is a copy of a program that may have a handler of its own; it was waited for without an end."""
    flight, inputs = recorded()
    monkeypatch.setattr(ahead, "register", lambda *_: [time.sleep(1.0) for _ in range(60)])
    before = signal.signal(signal.SIGTERM, lambda *_: None)
    try:
        began = time.monotonic()
        with ahead.registering(flight, inputs):
            time.sleep(0.2)
        assert time.monotonic() - began < 30.0
    finally:
        signal.signal(signal.SIGTERM, before)


def test_attitude_that_differs_between_the_two_is_an_error() -> None:
    flight, inputs = recorded()
    first = next(n for n, item in enumerate(inputs) if item.kind == "mavlink")
    replay = Replay(flight)
    with ahead.registering(flight, inputs) as replay.scans, pytest.raises(RuntimeError, match="depend on more"):
        replay.run(item for n, item in enumerate(inputs) if item.kind != "mavlink" or n == first)
