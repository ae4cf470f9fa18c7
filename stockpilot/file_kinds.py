"""What kind of recording a file is, by its content and never by its name."""

from __future__ import annotations

import gzip
import lzma
import zlib
from enum import Enum
from pathlib import Path

from companion.errors import FileFormatError
from companion.lidar.pcap import is_capture
from companion.recording.mcap_write import MAGIC
from companion.recording.packed import MAGIC as PACKED_MAGIC
from companion.recording.run_files import recording_path

HEAD_BYTES = 65536
CARMEN_WORDS = (b"FLASER", b"RLASER", b"ROBOTLASER1", b"RAWLASER1", b"ODOM", b"PARAM", b"SYNC", b"TRUEPOS")


class FileKind(Enum):
    MCAP = "MCAP"
    PACKED = "packed recording"
    PCAP = "packet capture"
    TLOG = "MAVLink tlog"
    ROS1 = "ROS 1 bag"
    ROS2 = "ROS 2 bag"
    CARMEN = "CARMEN log"


def file_kind(path: Path) -> tuple[FileKind, Path]:
    """(kind, the file to read): of a file, a run's folder or a ROS 2 bag's folder.

    Raises: FileFormatError: there is no such file, or it is none of these.
    """
    if path.is_dir():
        if (path / "metadata.yaml").exists():
            return FileKind.ROS2, path
        path = recording_path(path)
    try:
        with path.open("rb") as file:
            raw = file.read(HEAD_BYTES)
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be read: {error.strerror}") from None
    head = _unpacked(raw)
    if head.startswith(MAGIC):
        return FileKind.MCAP, path
    if head.startswith(PACKED_MAGIC):
        return FileKind.PACKED, path
    if is_capture(head):
        return FileKind.PCAP, path
    if head.startswith(b"#ROSBAG V2.0"):
        return FileKind.ROS1, path
    if head.startswith(b"SQLite format 3\0") and (path.parent / "metadata.yaml").exists():
        return FileKind.ROS2, path.parent
    if len(head) > 10 and head[8] in (0xFD, 0xFE) and head[0] == 0:
        return FileKind.TLOG, path
    if any(line.startswith(CARMEN_WORDS) for line in head.splitlines()):
        return FileKind.CARMEN, path
    known = ", ".join(k.value for k in FileKind)
    raise FileFormatError(
        f"{path}: not a recording that is known here ({known}); it begins with {raw[:8].hex() or 'nothing'}"
    )


def _unpacked(raw: bytes) -> bytes:
    """The beginning of what is packed with gzip or xz; raw itself if it is not."""
    try:
        if raw.startswith(b"\x1f\x8b"):
            return zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(raw, HEAD_BYTES)
        if raw.startswith(b"\xfd7zXZ\0"):
            return lzma.LZMADecompressor().decompress(raw, HEAD_BYTES)
    except (zlib.error, lzma.LZMAError, gzip.BadGzipFile):
        return raw
    return raw
