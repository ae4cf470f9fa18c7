"""Reads the recorded conversations: 8 bytes big-endian microseconds, then one whole frame."""

from __future__ import annotations

from pathlib import Path


def read_tlog(path: Path) -> list[tuple[int, bytes]]:
    """(microseconds, frame), in order."""
    data = path.read_bytes()
    records = []
    at = 0
    while at < len(data):
        t_us = int.from_bytes(data[at : at + 8], "big")
        at += 8
        length, flags = data[at + 1], data[at + 2]
        size = 8 + length if data[at] == 0xFE else 12 + length + (13 if flags & 1 else 0)
        records.append((t_us, data[at : at + size]))
        at += size
    return records
