"""The ring that scans go to another process by: in order, each as it was put, never more than there is room for."""

from __future__ import annotations

import numpy as np
import pytest

from companion.messages import LidarGeometry, LidarScan
from companion.recording.scan_ring import MOST_BYTES, MOST_PLACES, Arrival, ScanRing


def geometry(rows: int, columns: int) -> LidarGeometry:
    directions = np.zeros((rows, columns, 3))
    directions[..., 0] = 1.0
    return LidarGeometry(
        directions=directions,
        offsets_m=np.zeros((rows, columns, 3)),
        elevation_rad=np.linspace(0.3, -0.3, rows),
        horizontal_row=rows // 2,
    )


def scan(geometry: LidarGeometry, number: int) -> LidarScan:
    rng = np.random.default_rng(number)
    rows, columns = geometry.directions.shape[:2]
    return LidarScan(
        t_ns=10**18 + number,
        frame_id=number % 65536,
        t_column_ns=10**18 + np.arange(columns, dtype=np.int64),
        range_m=rng.uniform(0.0, 50.0, (rows, columns)).astype(np.float32),
        signal=rng.uniform(0.0, 9e4, (rows, columns)).astype(np.float32),
        column_valid=rng.uniform(size=columns) > 0.1,
        geometry=geometry,
    )


def same(a: LidarScan, b: LidarScan) -> bool:
    arrays = ("t_column_ns", "range_m", "signal", "column_valid")
    return (a.t_ns, a.frame_id) == (b.t_ns, b.frame_id) and all(
        np.array_equal(getattr(a, name), getattr(b, name)) and getattr(b, name).dtype == getattr(a, name).dtype
        for name in arrays
    )


@pytest.mark.parametrize(("rows", "columns"), [(16, 512), (3, 7)])
def test_each_scan_arrives_as_it_was_put(rows: int, columns: int) -> None:
    shape = geometry(rows, columns)
    ring = ScanRing(shape)
    coming = ring.taken()
    put = [Arrival(3 * n, scan(shape, n)) for n in range(2 * ring.places + 3)]
    for n, arrival in enumerate(put):
        ring.put(arrival)
        if n % 2:  # one stays behind, then both are taken
            assert ring.waiting == 2
            for sent in put[n - 1 : n + 1]:
                got = next(coming)
                assert got.call == sent.call
                assert same(got.scan, sent.scan)
                assert all(a.flags.aligned and a.flags.c_contiguous for a in (got.scan.range_m, got.scan.t_column_ns))
    ring.put(None)
    assert [got.call for got in coming] == [put[-1].call]


def test_what_was_taken_stays_when_its_place_is_used_again() -> None:
    shape = geometry(2, 8)
    ring = ScanRing(shape)
    coming = ring.taken()
    first = scan(shape, 0)
    ring.put(Arrival(0, first))
    kept = next(coming).scan
    for n in range(1, ring.places + 1):
        ring.put(Arrival(n, scan(shape, n)))
        next(coming)
    assert same(first, kept)


def test_room_is_limited_by_places_and_by_bytes() -> None:
    assert ScanRing(geometry(16, 512)).places == MOST_PLACES
    large = ScanRing(geometry(128, 2048))
    assert 2 <= large.places <= MOST_BYTES // (128 * 2048 * 8)


def test_nobody_there_to_take_is_told() -> None:
    shape = geometry(2, 8)
    ring = ScanRing(shape)
    ring.put_only_here()
    with pytest.raises(BrokenPipeError):
        ring.put(Arrival(0, scan(shape, 0)))


def test_the_end_of_the_other_process_is_an_end() -> None:
    shape = geometry(2, 8)
    ring = ScanRing(shape)
    ring.put(Arrival(5, scan(shape, 1)))
    ring.take_only_here()
    assert [got.call for got in ring.taken()] == [5]
