"""The scans of a recording, waiting and registered in the order of the recorded calls; here, or ahead of them (ahead.py)."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

from companion import topics
from companion.flight import Flight
from companion.messages import LidarScan
from companion.odometry import ScanResult
from companion.recording.run_types import Input


class Accepted(NamedTuple):
    """result: None: nothing to use in the scan."""

    result: ScanResult | None


class ScanSource(Protocol):
    """What the recorded calls about scans go to. unmatched: begins without a scan, known once all is fed."""

    unmatched: int

    def lidar(self, item: Input) -> None:
        """A packet came."""

    def begin(self, t_ns: int) -> None:
        """The scan that has waited longest began to be registered."""

    def accept(self) -> Accepted | None:
        """The registered scan that is taken in now; None: there is none."""

    def finish(self) -> None:
        """All is fed."""


@dataclass(slots=True)
class ScansHere:
    """Decoded and registered by `flight` itself."""

    flight: Flight
    unmatched: int = 0
    _scans: deque[LidarScan] = field(init=False, default_factory=lambda: deque(maxlen=topics.SCAN.queue))
    _jobs: deque[Callable[[], ScanResult | None]] = field(init=False, default_factory=deque)

    def lidar(self, item: Input) -> None:
        for scan in self.flight.on_lidar_packet(item.data, item.t_ns, item.source):
            self.arrived(scan)

    def arrived(self, scan: LidarScan) -> None:
        """A scan that is decoded."""
        self._scans.append(scan)

    def begin(self, t_ns: int) -> None:
        if self._scans:
            self._jobs.append(self.flight.begin_scan(self._scans.popleft(), t_ns))
        else:
            self.unmatched += 1

    def accept(self) -> Accepted | None:
        return Accepted(self._jobs.popleft()()) if self._jobs else None

    def finish(self) -> None:
        """Nothing is left to do."""
