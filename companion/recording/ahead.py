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
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection
from typing import NamedTuple

import numpy as np

from companion import topics
from companion.flight import Flight
from companion.messages import LevelledScan, LidarScan, OdometryEstimate, WallRanges
from companion.odometry import ScanResult
from companion.odometry.estimate import Snapshot
from companion.recording.run_types import Input

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


@contextlib.contextmanager
def registering(flight: Flight, inputs: Sequence[Input]) -> Iterator[Iterator[Told]]:
    """Gives an iterator over what the calls give: one for each accept, then Finished. flight: as before the first call;
    it is not changed, the other process works with a copy."""
    ours, theirs = multiprocessing.Pipe(duplex=False)
    with contextlib.suppress(OSError):
        fcntl.fcntl(theirs.fileno(), fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    process = multiprocessing.get_context("fork").Process(target=_work, args=(flight, inputs, theirs), daemon=True)
    process.start()
    theirs.close()
    try:
        yield _received(ours)
    finally:
        ours.close()
        process.terminate()
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
    scans: deque[LidarScan] = deque(maxlen=topics.SCAN.queue)
    jobs: deque[Callable[[], ScanResult | None]] = deque()
    unmatched = 0
    for kind, t_ns, data, source in inputs:
        if kind == "lidar":
            scans.extend(flight.on_lidar_packet(data, t_ns, source))
        elif kind == "mavlink":
            flight.on_mavlink(data, t_ns, source)
        elif kind == "poll":
            flight.session.poll(t_ns)
        elif kind == "begin":
            if scans:
                jobs.append(flight.begin_scan(scans.popleft(), t_ns))
            else:
                unmatched += 1
        elif kind == "accept":
            tell(_accept(flight, jobs.popleft()(), t_ns) if jobs else None)
    tell(Finished(unmatched, flight.decoder.dropped))


def _accept(flight: Flight, result: ScanResult | None, t_ns: int) -> Registered:
    belongs = flight.accept_scan(result, t_ns)
    found = None
    if result is not None:
        found = Found(
            result.estimate, result.levelled if belongs else None, result.wall_ranges,
            result.is_standing, result.is_yaw_weak, result.tilt_offset_rad,
        )  # fmt: skip
    return Registered(found, flight.odometry.snapshot, flight.odometry.t_attitude_ns)
