"""What the flight core itself decides; its stages have tests of their own."""

from __future__ import annotations

import pytest

from companion.config import CompanionConfig
from companion.flight import Flight
from companion.mavlink.computer import ComputerStatus
from companion.messages import Event
from companion.topics import EVENT, Topic

MS = 1_000_000


def status(free_gib: float) -> ComputerStatus:
    total = 100 * 1024
    return ComputerStatus(
        t_ns=MS, uptime_s=1.0, cpu_core_ratios=(), ram_used_mib=1, ram_total_mib=2,
        disk_used_mib=total - round(free_gib * 1024), disk_total_mib=total, temperature_c=None,
    )  # fmt: skip


@pytest.mark.parametrize(("free_gib", "is_refused"), [(1.9, True), (2.1, False)])
def test_a_disk_that_is_nearly_full_stands_against_arming(free_gib: float, is_refused: bool) -> None:
    """FAULTS 21: free space at arming. Issue 4: what the doctor calls red means no arming."""
    told: list[str] = []

    def tap(topic: Topic, t_ns: int, message: object) -> None:
        if topic is EVENT and isinstance(message, Event):
            told.append(message.text)

    flight = Flight(CompanionConfig(), tap=tap)
    flight.on_computer(status(free_gib))
    for n in range(1, 20):
        flight.poll(n * 50 * MS)
    (why,) = [text for text in told if text.startswith("not ready")]
    assert ("computer.disk" in why) is is_refused


def test_without_a_recording_the_disk_may_be_full() -> None:
    flight = Flight(CompanionConfig.model_validate({"recording": {"enabled": False}}))
    flight.on_computer(status(0.0))
    assert flight._computer_not_ready == ()
