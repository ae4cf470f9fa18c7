"""Scans out of other people's recordings: Ouster and Velodyne captures, ROS bags, MCAP, CARMEN logs.

Each scan carries its own time stamp, not that of the file. rosbags and velodyne-decoder come with the extra "import".
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from companion.errors import FileFormatError
from companion.lidar.ouster import OusterDecoder
from companion.lidar.pcap import PcapReader
from companion.messages import LidarScan
from companion.recording import channels
from companion.recording.manifest import require_unaltered_file
from companion.recording.mcap_read import Attachment, McapScan, Message, open_mcap
from stockpilot import carmen, ros_scans
from stockpilot.file_kinds import FileKind, file_kind
from stockpilot.file_scan import CUT, FileScan, ScanFile, scan_from_points

VELODYNE_PORT = 2368


def open_scans(path: Path, *, metadata: Path | None = None, topic: str | None = None) -> ScanFile:
    """Recognise a recording by its content and read its scans, oldest first.

    Args:
        metadata: an Ouster sensor's JSON; default: the one beside the capture. topic: of several, which.
    Raises: FileFormatError: not a recording, there are no scans in it, or it is of a run and was altered since.
    """
    kind, file = file_kind(path)
    require_unaltered_file(file)
    if kind is FileKind.PCAP:
        return _open_capture(file, metadata)
    if kind is FileKind.MCAP:
        return _open_mcap(file, topic)
    if kind in (FileKind.ROS1, FileKind.ROS2):
        return ros_scans.open_ros(kind, file, topic)
    if kind is FileKind.CARMEN:
        dropped: dict[str, int] = {}
        return ScanFile(kind=kind, sensor="CARMEN laser", scans=carmen.carmen_scans(file, dropped), dropped=dropped)
    raise FileFormatError(f"{file}: a {kind.value} holds no scans; expected a capture, a ROS bag, MCAP or a CARMEN log")


def scan_from_lidar(scan: LidarScan, decoder: OusterDecoder) -> FileScan:
    """An Ouster scan: the horizontal row makes the planar one. Its time is the sensor's own, of the last column."""
    geometry = scan.geometry
    points = geometry.directions * scan.range_m[..., None].astype(np.float64) + geometry.offsets_m
    seen = scan.range_m > 0
    row = geometry.horizontal_row
    t_ns = scan.t_ns - (decoder.clock.offset_ns or 0)
    return FileScan(t_ns=t_ns, points=points[row][seen[row]][:, :2].copy(), points_3d=points[seen])


# ---- captures --------------------------------------------------------------------------------------------------------


def metadata_beside(path: Path) -> Path | None:
    """The metadata JSON of a capture: the file of its name, or the one whose name the capture's begins with."""
    same = path.with_suffix(".json")
    if same.exists():
        return same
    near = [p for p in sorted(path.parent.glob("*.json")) if path.stem.startswith(p.stem)]
    return near[-1] if near else None


def decoder_of(metadata: Path) -> OusterDecoder:
    """For the sensor that a metadata JSON describes. Raises: FileFormatError: it cannot be read, or is none; it is named."""
    try:
        text = metadata.read_text(encoding="utf-8")
    except OSError as error:
        raise FileFormatError(f"{metadata}: the LiDAR's metadata cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{metadata}: the LiDAR's metadata is no text: {error}") from None
    try:
        return OusterDecoder(text)
    except FileFormatError as error:
        raise FileFormatError(f"{metadata}: {error}") from None


def _open_capture(path: Path, metadata: Path | None) -> ScanFile:
    found = metadata or metadata_beside(path)
    if found is not None:
        decoder = decoder_of(found)
        sensor = f"{decoder.info.prod_line}, {decoder.info.h} x {decoder.info.w}"
        return ScanFile(kind=FileKind.PCAP, sensor=sensor, scans=_ouster_scans(path, decoder), dropped=decoder.dropped)
    if any(p.destination[1] == VELODYNE_PORT or len(p.data) == 1206 for p in _first(PcapReader(path), 50)):
        return ScanFile(kind=FileKind.PCAP, sensor="Velodyne", scans=_velodyne_scans(path), dropped={})
    raise FileFormatError(
        f"{path}: neither Velodyne packets, nor a metadata JSON of an Ouster sensor beside it; give it with --metadata"
    )


def _first(packets: PcapReader, count: int) -> Iterator[Any]:
    for n, packet in enumerate(packets):
        if n >= count:
            return
        yield packet


def _ouster_scans(path: Path, decoder: OusterDecoder) -> Iterator[FileScan]:
    reader = PcapReader(path)
    for packet in reader:
        for scan in decoder.receive(packet.data, packet.t_ns, packet.source):
            yield scan_from_lidar(scan, decoder)
    if reader.is_cut:
        decoder.dropped[CUT] = 1


def _velodyne_scans(path: Path) -> Iterator[FileScan]:
    from companion.lidar.velodyne import read_velodyne

    for scan in read_velodyne(path):
        yield scan_from_points(scan.t_ns, scan.points_lidar)


# ---- MCAP ------------------------------------------------------------------------------------------------------------


def _open_mcap(path: Path, topic: str | None) -> ScanFile:
    metadata: str | None = None
    wanted: set[str] = set()
    own = channels.INPUT_PREFIX + "lidar"
    for item in open_mcap(path):
        if isinstance(item, Attachment) and item.name == "lidar.json":
            metadata = item.data.decode()
        elif isinstance(item, Message) and item.channel.topic not in wanted:
            wanted.add(item.channel.topic)
            if item.channel.topic == own and metadata is not None:
                break
    if topic in (None, own) and own in wanted:
        if metadata is None:
            raise FileFormatError(f"{path}: lacks the attachment lidar.json: its packets cannot be read")
        decoder = OusterDecoder(metadata)
        scans = _own_scans(path, decoder)
        return ScanFile(kind=FileKind.MCAP, sensor="Ouster packets of a flight", scans=scans, dropped=decoder.dropped)
    dropped: dict[str, int] = {}
    scans = _ros_scans(path, topic, dropped)
    return ScanFile(kind=FileKind.MCAP, sensor=topic or "LaserScan or PointCloud2", scans=scans, dropped=dropped)


def _own_scans(path: Path, decoder: OusterDecoder) -> Iterator[FileScan]:
    recording = open_mcap(path)
    for item in recording:
        if isinstance(item, Message) and item.channel.topic == channels.INPUT_PREFIX + "lidar":
            raw = channels.unpack_raw(item.data)
            for scan in decoder.receive(raw.data, item.t_ns, raw.source):
                yield scan_from_lidar(scan, decoder)
    _tell_damage(recording, decoder.dropped)


def _ros_scans(path: Path, topic: str | None, dropped: dict[str, int]) -> Iterator[FileScan]:
    recording = open_mcap(path)
    yield from ros_scans.mcap_scans(recording, path, topic, dropped)
    _tell_damage(recording, dropped)


def _tell_damage(recording: McapScan, dropped: dict[str, int]) -> None:
    """Of a recording that was read through."""
    for damage in recording.damage:
        dropped[f"bytes at {damage.offset}: {damage.what}"] = damage.bytes_lost
    if not recording.is_finished and not recording.damage:
        dropped["the end: it was not closed"] = 1
