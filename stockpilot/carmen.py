"""Scans out of CARMEN logs: lines of text, packed or not."""

from __future__ import annotations

import gzip
import math
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from companion.errors import FileFormatError
from stockpilot.file_scan import CUT, FileScan, scan_from_ranges


def _text_lines(path: Path, dropped: dict[str, int]) -> Iterator[str]:
    """Up to where a packed file is cut or broken, which dropped is told."""
    with path.open("rb") as raw:
        packed = raw.read(2) == b"\x1f\x8b"
    with gzip.open(path, "rt", errors="replace") if packed else path.open(errors="replace") as file:
        try:
            yield from file
        except (EOFError, zlib.error, gzip.BadGzipFile):
            dropped[CUT] = 1


def carmen_lines(path: Path, dropped: dict[str, int]) -> Iterator[tuple[str, int, int]]:
    """(message name, time, length) of each line that carries a time."""
    for line in _text_lines(path, dropped):
        words = line.split()
        if len(words) > 3 and not line.startswith(("#", "PARAM")):
            try:
                yield words[0], _ns(words[-3]), len(line)
            except ValueError:
                continue


def carmen_scans(path: Path, dropped: dict[str, int]) -> Iterator[FileScan]:
    """FLASER and ROBOTLASER1 lines (CARMEN's log format); time: when the laser was read, not when it was logged."""
    found = False
    for line in _text_lines(path, dropped):
        if line.startswith(("FLASER ", "ROBOTLASER1 ")):
            scan = _carmen_scan(line.split())
            if scan is not None:
                found = True
                yield scan
    if not found:
        raise FileFormatError(f"{path}: no FLASER or ROBOTLASER1 line that can be read")


def _carmen_scan(words: list[str]) -> FileScan | None:
    """None: the line is cut or not numbers."""
    try:
        if words[0] == "FLASER":
            count, first, start, range_max = int(words[1]), 2, -math.pi / 2, 81.0
            step = math.radians(180.0 / count if count > 181 else 1.0)
        else:
            start, step, range_max = float(words[2]), float(words[4]), float(words[5])
            count, first = int(words[8]), 9
        ranges = np.array([float(w) for w in words[first : first + count]])
        if count < 1 or len(ranges) != count or len(words) < first + count + 3:
            return None
        t_ns = _ns(words[-3])
    except (ValueError, IndexError):
        return None
    return scan_from_ranges(t_ns, ranges, start + step * np.arange(count, dtype=np.float64), 0.02, range_max)


def _ns(decimal_seconds: str) -> int:
    """Exact: a double cannot hold ns since 1970."""
    whole, _, fraction = decimal_seconds.partition(".")
    if not (whole.lstrip("-") or "0").isdigit() or not (fraction or "0").isdigit():
        raise ValueError(f"not a time: {decimal_seconds!r}")
    ns = int(whole.lstrip("-") or 0) * 1_000_000_000 + int((fraction + "0" * 9)[:9])
    return -ns if whole.startswith("-") else ns
