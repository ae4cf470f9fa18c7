"""Scans on their way to another process: places in shared memory, and a pipe that says what lies in them.

For one process that puts and one that takes, a copy of the first (fork): neither waits for the other while there is room.
"""

from __future__ import annotations

import contextlib
import mmap
import multiprocessing
import struct
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from companion.messages import LidarGeometry, LidarScan

MOST_PLACES = 64
MOST_BYTES = 64 << 20
_HEAD_BYTES = 64  # how many were taken; a cache line of its own
_NOTE = struct.Struct("<qqq")  # call, t_ns, frame id
_END = -1


class Arrival(NamedTuple):
    """A scan, and which of the recorded calls completed it."""

    call: int
    scan: LidarScan


class ScanRing:
    """`put` in the one process, `taken` in the other; each says first which end it has. waiting: put, and not yet taken."""

    def __init__(self, geometry: LidarGeometry) -> None:
        rows, columns = geometry.directions.shape[:2]
        place = np.dtype(
            [
                ("t_column_ns", np.int64, (columns,)),
                ("range_m", np.float32, (rows, columns)),
                ("signal", np.float32, (rows, columns)),
                ("column_valid", np.bool_, (columns,)),
            ],
            align=True,
        )
        self.places = max(2, min(MOST_PLACES, MOST_BYTES // place.itemsize))
        self._geometry = geometry
        memory = mmap.mmap(-1, _HEAD_BYTES + self.places * place.itemsize)
        self._taken = np.frombuffer(memory, np.int64, 1)
        self._places = np.frombuffer(memory, place, self.places, _HEAD_BYTES)
        self._put = 0
        self._notes, self._noted = multiprocessing.Pipe(duplex=False)

    @property
    def waiting(self) -> int:
        return self._put - int(self._taken[0])

    def put_only_here(self) -> None:
        self._notes.close()

    def take_only_here(self) -> None:
        self._noted.close()

    def close(self) -> None:
        self._noted.close()

    def put(self, arrival: Arrival | None) -> None:
        """None: there are no more. Only while fewer wait than there are places. Raises: BrokenPipeError: nobody takes."""
        if arrival is None:
            self._noted.send_bytes(_NOTE.pack(_END, 0, 0))
            return
        call, scan = arrival
        place = self._places[self._put % self.places]
        place["t_column_ns"], place["range_m"] = scan.t_column_ns, scan.range_m
        place["signal"], place["column_valid"] = scan.signal, scan.column_valid
        self._put += 1
        self._noted.send_bytes(_NOTE.pack(call, scan.t_ns, scan.frame_id))

    def taken(self) -> Iterator[Arrival]:
        """Each scan that was put, in order, until there are no more or the other process has ended."""
        with contextlib.suppress(EOFError):
            while True:
                call, t_ns, frame_id = _NOTE.unpack(self._notes.recv_bytes())
                if call == _END:
                    return
                place = self._places[int(self._taken[0]) % self.places].copy()
                self._taken[0] += 1
                yield Arrival(
                    call,
                    LidarScan(
                        t_ns=t_ns,
                        frame_id=frame_id,
                        t_column_ns=place["t_column_ns"],
                        range_m=place["range_m"],
                        signal=place["signal"],
                        column_valid=place["column_valid"],
                        geometry=self._geometry,
                    ),
                )
