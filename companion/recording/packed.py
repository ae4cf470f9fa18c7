"""The inputs of a flight packed small, for recordings that live in the repository: a third of the same as MCAP with xz.

Layout, all packed with xz: a magic line, a line of JSON (metadata, attachments, sources, counts), then columns: kind,
time step, source, length of each input; the bytes of all inputs but LiDAR packets; the LiDAR packets, byte by byte across
packets (the same byte of following packets is alike).
"""

from __future__ import annotations

import json
import lzma
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.errors import FileFormatError
from companion.recording.channels import INPUTS
from companion.recording.run_types import Input, RunRecording

MAGIC = b"stockpilot packed recording 1\n"
SUFFIX = ".packed.xz"
_LIDAR = INPUTS.index("lidar")
_FILTERS = [{"id": lzma.FILTER_LZMA2, "preset": 9 | lzma.PRESET_EXTREME}]


def pack(inputs: Sequence[Input], metadata: Mapping[str, Mapping[str, str]], attachments: Mapping[str, bytes]) -> bytes:
    """Attachments are text. Raises: ValueError: LiDAR packets of several sizes, or an input of an unknown kind."""
    sources = list(dict.fromkeys(i.source for i in inputs))
    lidar = [i.data for i in inputs if i.kind == "lidar"]
    sizes = {len(d) for d in lidar}
    if len(sizes) > 1:
        raise ValueError(f"LiDAR packets of one size expected, got {sorted(sizes)}")
    head = {
        "count": len(inputs),
        "lidar": [len(lidar), *sizes],
        "sources": sources,
        "metadata": metadata,
        "attachments": {name: data.decode() for name, data in attachments.items()},
    }
    times = np.array([i.t_ns for i in inputs], dtype=np.int64)
    parts = [
        MAGIC,
        json.dumps(head).encode() + b"\n",
        np.array([INPUTS.index(i.kind) for i in inputs], dtype=np.uint8).tobytes(),
        np.diff(times, prepend=np.int64(0)).astype("<i8").tobytes(),
        np.array([sources.index(i.source) for i in inputs], dtype="<u2").tobytes(),
        np.array([len(i.data) for i in inputs], dtype="<u4").tobytes(),
        b"".join(i.data for i in inputs if i.kind != "lidar"),
    ]
    if lidar:
        matrix = np.frombuffer(b"".join(lidar), dtype=np.uint8).reshape(len(lidar), -1)
        parts.append(np.ascontiguousarray(matrix.T).tobytes())
    return lzma.compress(b"".join(parts), format=lzma.FORMAT_XZ, filters=_FILTERS)


def unpack(data: bytes) -> RunRecording:
    """Raises: FileFormatError: not such a file, or cut."""
    try:
        plain = lzma.decompress(data)
        if not plain.startswith(MAGIC):
            raise ValueError(f"begins with {plain[:16]!r}")
        line_end = plain.index(b"\n", len(MAGIC))
        head: dict[str, Any] = json.loads(plain[len(MAGIC) : line_end])
        return _read(head, plain, line_end + 1)
    except (lzma.LZMAError, ValueError, KeyError, IndexError, TypeError) as error:
        raise FileFormatError(f"packed recording: cannot be read: {error}") from None


def _read(head: dict[str, Any], plain: bytes, at: int) -> RunRecording:
    count = int(head["count"])
    columns: list[NDArray[Any]] = []
    for kind in ("u1", "<i8", "<u2", "<u4"):
        columns.append(np.frombuffer(plain, dtype=kind, count=count, offset=at))
        at += columns[-1].nbytes
    kinds, steps, source_numbers, lengths = columns
    sources = [None if s is None else (str(s[0]), int(s[1])) for s in head["sources"]]
    packets = iter(_packets(head["lidar"], plain, at + int(lengths[kinds != _LIDAR].sum())))
    run = RunRecording(metadata=head["metadata"])
    run.attachments = {name: text.encode() for name, text in head["attachments"].items()}
    for kind, t_ns, source, length in zip(kinds, np.cumsum(steps), source_numbers, lengths, strict=True):
        if kind == _LIDAR:
            data = next(packets)
        else:
            data = plain[at : at + int(length)]
            at += int(length)
        run.inputs.append(Input(INPUTS[kind], int(t_ns), data, sources[source]))
    return run


def _packets(shape: list[int], plain: bytes, at: int) -> list[bytes]:
    if shape[0] == 0:
        return []
    packets, size = shape
    across = np.frombuffer(plain, dtype=np.uint8, count=packets * size, offset=at).reshape(size, packets)
    return [row.tobytes() for row in np.ascontiguousarray(across.T)]
