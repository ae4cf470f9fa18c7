"""The scans of a recording, registered by a process of its own, ahead of the replay that takes them in.

What a scan gives depends on packets, attitude and rangefinder, never on what was made of the scans before it: so the same
calls in the same order give it to the last bit, wherever they are made.
"""

from __future__ import annotations

import contextlib
import fcntl
import multiprocessing
import os
import pickle
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import NamedTuple

import numpy as np

from companion.flight import Flight
from companion.messages import LevelledScan, OdometryEstimate, WallRanges
from companion.odometry import ScanResult
from companion.odometry.estimate import Snapshot
from companion.recording.run_types import Input
from companion.recording.scans import Accepted, ScansHere

PIPE_BYTES = 1 << 20  # what Linux allows anybody: by how much the one may be ahead of the other
_NONE = np.zeros(0, np.int64)
_NOT_MAPPED = LevelledScan(
    t_ns=0, points_level=np.zeros((0, 3)), range_m=np.zeros(0), row=_NONE, column=_NONE, origin_level_m=np.zeros(3)
)


class Found(NamedTuple):
    """A ScanResult but for what nobody takes from a replay: to send it costs as much as a tenth of registering it.
    levelled: None where it does not go into the map."""

    estimate: OdometryEstimate
    levelled: LevelledScan | None
    wall_ranges: WallRanges
    is_standing: bool
    is_yaw_weak: bool
    tilt_offset_rad: tuple[float, float]

    def result(self) -> ScanResult:
        """With no registration, no judgement, and no points where they do not go into the map."""
        return ScanResult(
            estimate=self.estimate,
            levelled=self.levelled or _NOT_MAPPED,
            wall_ranges=self.wall_ranges,
            keyframe=self.estimate.is_keyframe,
            registration=None,
            judgement=None,
            is_standing=self.is_standing,
            is_yaw_weak=self.is_yaw_weak,
            tilt_offset_rad=self.tilt_offset_rad,
        )


class Registered(NamedTuple):
    """Of one accepted scan. found: None: nothing to use in it. snapshot: the odometry's state after it. t_attitude_ns:
    the newest attitude then; 0: none."""

    found: Found | None
    snapshot: Snapshot | None
    t_attitude_ns: int


class Finished(NamedTuple):
    """After the last call. unmatched: begins without a scan. dropped: LiDAR packets, by why."""

    unmatched: int
    dropped: dict[str, int]


Told = Registered | Finished | None  # None: an accept without a scan


def is_worthwhile() -> bool:
    """Whether there is a second processor, and processes that start as a copy of this one."""
    return hasattr(os, "fork") and len(os.sched_getaffinity(0)) > 1


@dataclass(slots=True)
class ScansAhead:
    """A ScanSource: `told` brings what the other process registered. The odometry of `flight` then has no map."""

    flight: Flight
    told: Iterator[Told]
    unmatched: int = 0

    def lidar(self, item: Input) -> None:
        """The other process has it."""

    def begin(self, t_ns: int) -> None:
        """The other process does."""

    def accept(self) -> Accepted | None:
        told = next(self.told)
        if not isinstance(told, Registered):
            return None
        odometry = self.flight.odometry
        if told.t_attitude_ns != odometry.t_attitude_ns:
            raise RuntimeError(
                f"replay: the attitude at {odometry.t_attitude_ns} ns is another, {told.t_attitude_ns} ns, where scans are "
                "registered ahead: they depend on more than was thought"
            )
        odometry.adopt(told.snapshot)
        return Accepted(None if told.found is None else told.found.result())

    def finish(self) -> None:
        finished = next(self.told)
        assert isinstance(finished, Finished)
        self.unmatched = finished.unmatched
        self.flight.decoder.dropped.update(finished.dropped)


@contextlib.contextmanager
def registering(flight: Flight, inputs: Sequence[Input]) -> Iterator[ScansAhead]:
    """flight: as before the first call; the other process works with a copy of it."""
    ours, theirs = multiprocessing.Pipe(duplex=False)
    with contextlib.suppress(OSError):
        fcntl.fcntl(theirs.fileno(), fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    process = multiprocessing.get_context("fork").Process(target=_work, args=(flight, inputs, theirs), daemon=True)
    process.start()
    theirs.close()
    try:
        yield ScansAhead(flight, _received(ours))
    finally:
        ours.close()
        process.kill()  # it leaves nothing behind, and may have the handler of SIGTERM of the program that it is a copy of
        process.join()


def _received(ours: Connection) -> Iterator[Told]:
    with contextlib.suppress(EOFError):
        while True:
            yield pickle.loads(ours.recv_bytes())
    raise RuntimeError("the process that registers scans ahead ended early: its error is told above")


def _work(flight: Flight, inputs: Sequence[Input], theirs: Connection) -> None:
    register(flight, inputs, lambda told: theirs.send_bytes(pickle.dumps(told, pickle.HIGHEST_PROTOCOL)))


def register(flight: Flight, inputs: Sequence[Input], tell: Callable[[Told], None]) -> None:
    """The calls that scans depend on: all but what the beats of estimates and setpoints do."""
    scans = ScansHere(flight)
    for item in inputs:
        if item.kind == "lidar":
            scans.lidar(item)
        elif item.kind == "mavlink":
            flight.on_mavlink(item.data, item.t_ns, item.source)
        elif item.kind == "poll":
            flight.session.poll(item.t_ns)
        elif item.kind == "begin":
            scans.begin(item.t_ns)
        elif item.kind == "accept":
            accepted = scans.accept()
            tell(None if accepted is None else _accept(flight, accepted.result, item.t_ns))
    tell(Finished(scans.unmatched, flight.decoder.dropped))


def _accept(flight: Flight, result: ScanResult | None, t_ns: int) -> Registered:
    belongs = flight.accept_scan(result, t_ns)
    found = None
    if result is not None:
        found = Found(
            result.estimate, result.levelled if belongs else None, result.wall_ranges,
            result.is_standing, result.is_yaw_weak, result.tilt_offset_rad,
        )  # fmt: skip
    return Registered(found, flight.odometry.snapshot, flight.odometry.t_attitude_ns)
