"""What a recording of a flight holds, however it is stored."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple


class Input(NamedTuple):
    """One call into the flight core. kind: one of channels.INPUTS."""

    kind: str
    t_ns: int
    data: bytes
    source: tuple[str, int] | None = None


@dataclass(slots=True)
class RunRecording:
    """inputs in the order of the calls; topics as (time, bytes) for comparison; metadata and attachments by name."""

    inputs: list[Input] = field(default_factory=list)
    topics: dict[str, list[tuple[int, bytes]]] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    is_whole: bool = True
    damage: list[str] = field(default_factory=list)
