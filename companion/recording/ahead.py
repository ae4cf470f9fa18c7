"""The scans of a recording, registered by a process of its own, ahead of the replay that takes them in.

What a scan gives depends on packets, attitude and rangefinder, never on what was made of the scans before it: so the same
calls in the same order give it to the last bit, wherever they are made. The replay decodes the packets, since it would
wait meanwhile, and lays the scans where the other process finds them (scan_ring.py).
"""

from __future__ import annotations

import contextlib
import fcntl
import multiprocessing
import os
import pickle
import select
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import NamedTuple

import numpy as np

from companion.flight import Flight
from companion.messages import LevelledScan, OdometryEstimate, WallRanges
from companion.odometry import ScanResult
from companion.odometry.estimate import Snapshot
from companion.odometry.turned import TurnedBy
from companion.recording.run_types import Input
from companion.recording.scan_ring import Arrival, ScanRing
from companion.recording.scans import Accepted, ScansHere

PIPE_BYTES = 1 << 20  # what Linux allows anybody: by how much the one may be ahead of the other
WAIT_MS = 1  # until it is looked anew whether there is room for a scan
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
    lidar_turned_by: TurnedBy

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
            lidar_turned_by=self.lidar_turned_by,
        )


class Registered(NamedTuple):
    """Of one accepted scan. found: None: nothing to use in it. snapshot: the odometry's state after it. t_attitude_ns:
    the newest attitude then; 0: none."""

    found: Found | None
    snapshot: Snapshot | None
    t_attitude_ns: int


class Finished(NamedTuple):
    """After the last call. unmatched: begins without a scan."""

    unmatched: int


Told = Registered | Finished | None  # None: an accept without a scan


def is_worthwhile() -> bool:
    """Whether there is a second processor, and processes that start as a copy of this one."""
    return hasattr(os, "fork") and len(os.sched_getaffinity(0)) > 1


@dataclass(slots=True)
class ScansAhead:
    """A ScanSource: `results` brings what the other process registered. The odometry of `flight` then has no map."""

    flight: Flight
    feeder: Feeder
    results: Connection
    unmatched: int = 0
    _poll: select.poll = field(init=False, default_factory=select.poll)

    def __post_init__(self) -> None:
        self._poll.register(self.results.fileno(), select.POLLIN)

    def lidar(self, item: Input) -> None:
        """The feeder has it."""

    def begin(self, t_ns: int) -> None:
        """The other process does."""

    def accept(self) -> Accepted | None:
        told = self._next()
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
        finished = self._next()
        assert isinstance(finished, Finished)
        self.unmatched = finished.unmatched

    def _next(self) -> Told:
        """What the other process tells next; scans are decoded for it while there is nothing yet."""
        self.feeder.keep_ahead()
        while not self._poll.poll(0):
            if not self.feeder.feed():
                self._poll.poll(None if self.feeder.is_done else WAIT_MS)
        try:
            told: Told = pickle.loads(self.results.recv_bytes())
        except EOFError:
            raise RuntimeError("the process that registers scans ahead ended early: its error is told above") from None
        return told


@dataclass(slots=True)
class Feeder:
    """Decodes the packets of a recording and lays the scans into the ring, as far as there is room."""

    flight: Flight
    inputs: Sequence[Input]
    ring: ScanRing
    is_done: bool = False
    _scans: Iterator[Arrival] = field(init=False)

    def __post_init__(self) -> None:
        self._scans = self._decoded()

    def keep_ahead(self) -> None:
        """At most two scans: one is taken meanwhile."""
        for _ in range(2):
            if 2 * self.ring.waiting < self.ring.places:
                self.feed()

    def feed(self) -> bool:
        """One scan more, or the end. False: no room, or all is told."""
        if self.is_done or self.ring.waiting >= self.ring.places:
            return False
        scan = next(self._scans, None)
        self.is_done = scan is None
        with contextlib.suppress(BrokenPipeError):  # it ended early: told where its results are taken
            self.ring.put(scan)
        return True

    def _decoded(self) -> Iterator[Arrival]:
        for index, item in enumerate(self.inputs):
            if item.kind == "lidar":
                for scan in self.flight.on_lidar_packet(item.data, item.t_ns, item.source):
                    yield Arrival(index, scan)


@contextlib.contextmanager
def registering(flight: Flight, inputs: Sequence[Input]) -> Iterator[ScansAhead]:
    """flight: as before the first call; the other process works with a copy of it."""
    ours, theirs = multiprocessing.Pipe(duplex=False)
    with contextlib.suppress(OSError):
        fcntl.fcntl(theirs.fileno(), fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    ring = ScanRing(flight.decoder.geometry)
    process = multiprocessing.get_context("fork").Process(
        target=_work, args=(flight, inputs, ring, theirs), daemon=True
    )
    process.start()
    theirs.close()
    ring.put_only_here()
    try:
        yield ScansAhead(flight, Feeder(flight, inputs, ring), ours)
    finally:
        ours.close()
        process.kill()  # it leaves nothing behind, and may have the handler of SIGTERM of the program that it is a copy of
        process.join()
        ring.close()


def _work(flight: Flight, inputs: Sequence[Input], ring: ScanRing, theirs: Connection) -> None:
    ring.take_only_here()
    register(flight, inputs, ring.taken(), lambda told: theirs.send_bytes(pickle.dumps(told, pickle.HIGHEST_PROTOCOL)))


def register(
    flight: Flight, inputs: Sequence[Input], arrivals: Iterator[Arrival], tell: Callable[[Told], None]
) -> None:
    """The calls that scans depend on: all but what the beats of estimates and setpoints do. arrivals: the scans, and at
    which of the inputs each was complete."""
    scans = ScansHere(flight)
    arrival = next(arrivals, None)
    for index, item in enumerate(inputs):
        if item.kind == "lidar":
            while arrival is not None and arrival.call == index:
                scans.arrived(arrival.scan)
                arrival = next(arrivals, None)
        elif item.kind == "mavlink":
            flight.on_mavlink(item.data, item.t_ns, item.source)
        elif item.kind == "poll":
            flight.session.poll(item.t_ns)
        elif item.kind == "begin":
            scans.begin(item.t_ns)
        elif item.kind == "accept":
            accepted = scans.accept()
            tell(None if accepted is None else _accept(flight, accepted.result))
    tell(Finished(scans.unmatched))


def _accept(flight: Flight, result: ScanResult | None) -> Registered:
    flight.odometry.publish()
    found = None
    if result is not None:
        belongs = flight.belongs_in_map(result.estimate)
        found = Found(
            result.estimate, result.levelled if belongs else None, result.wall_ranges,
            result.is_standing, result.is_yaw_weak, result.tilt_offset_rad, result.lidar_turned_by,
        )  # fmt: skip
    return Registered(found, flight.odometry.snapshot, flight.odometry.t_attitude_ns)
