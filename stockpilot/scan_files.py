"""Scans out of other people's recordings: Ouster and Velodyne captures, ROS bags, MCAP, CARMEN logs.

Each scan carries its own time stamp, not that of the file. rosbags and velodyne-decoder come with the extra "import".
"""

from __future__ import annotations

import gzip
import math
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.errors import FileFormatError
from companion.lidar.ouster import OusterDecoder
from companion.lidar.pcap import PcapReader
from companion.messages import Array, LidarScan
from companion.recording import channels
from companion.recording.manifest import require_unaltered_file
from companion.recording.mcap_read import Attachment, McapScan, Message, open_mcap
from stockpilot.file_kinds import FileKind, file_kind

HORIZONTAL_BAND_RAD = math.radians(1.5)  # of a 3D scan, what is nearer to the horizon than this makes the planar scan
LASER_TYPES = ("sensor_msgs/msg/LaserScan", "sensor_msgs/msg/PointCloud2")
VELODYNE_PORT = 2368
CUT = "what follows: the file is cut or broken"
_SICK_BEAMS, _SICK_STEP_RAD = 180, math.radians(1.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class FileScan:
    """One scan in its sensor's frame (x forward, y left, z up).

    points: (N, 2) float64, the horizontal layer. points_3d: (M, 3), all of it (z 0 for a 2D scanner).
    """

    t_ns: int
    points: Array
    points_3d: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanFile:
    """A recording's scans and where they come from (for people)."""

    kind: FileKind
    sensor: str
    scans: Iterator[FileScan]
    dropped: dict[str, int]


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
        return _open_ros(kind, file, topic)
    if kind is FileKind.CARMEN:
        dropped: dict[str, int] = {}
        return ScanFile(kind=kind, sensor="CARMEN laser", scans=_carmen_scans(file, dropped), dropped=dropped)
    raise FileFormatError(f"{file}: a {kind.value} holds no scans; expected a capture, a ROS bag, MCAP or a CARMEN log")


# ---- points ----------------------------------------------------------------------------------------------------------


def scan_from_ranges(t_ns: int, ranges: Array, angles: Array, range_min: float, range_max: float) -> FileScan:
    """A 2D scan; beams without a return (out of bounds, inf, NaN) are left out."""
    with np.errstate(invalid="ignore"):
        seen = np.isfinite(ranges) & (ranges >= range_min) & (ranges < range_max) & (ranges > 0)
    r, a = ranges[seen], angles[seen]
    points = np.stack([r * np.cos(a), r * np.sin(a)], axis=1)
    return FileScan(t_ns=t_ns, points=points, points_3d=np.column_stack([points, np.zeros(len(points))]))


def scan_from_points(t_ns: int, points_3d: Array) -> FileScan:
    """A 3D scan: its points near the horizon make the planar one."""
    points_3d = points_3d[np.isfinite(points_3d).all(axis=1)]
    flat = np.hypot(points_3d[:, 0], points_3d[:, 1])
    near = (flat > 0.3) & (np.abs(points_3d[:, 2]) <= flat * math.tan(HORIZONTAL_BAND_RAD))
    return FileScan(t_ns=t_ns, points=points_3d[near, :2].copy(), points_3d=points_3d)


def scan_from_lidar(scan: LidarScan, decoder: OusterDecoder) -> FileScan:
    """An Ouster scan: the horizontal row makes the planar one. Its time is the sensor's own, of the last column."""
    geometry = scan.geometry
    points = geometry.directions * scan.range_m[..., None].astype(np.float64) + geometry.offsets_m
    seen = scan.range_m > 0
    row = geometry.horizontal_row
    t_ns = scan.t_ns - (decoder.clock.offset_ns or 0)
    return FileScan(t_ns=t_ns, points=points[row][seen[row]][:, :2].copy(), points_3d=points[seen])


def beam_step(count: int, step_rad: float) -> float:
    """The angle between two beams. 180 beams said to span just half a turn are a SICK LMS's, 1 degree apart: the
    converters that made such files divided by 179 (Freiburg's Intel and ACES logs)."""
    if count == _SICK_BEAMS and abs(step_rad - math.pi / (_SICK_BEAMS - 1)) < 1e-5:
        return _SICK_STEP_RAD
    return step_rad


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
    scans = _ros_mcap(open_mcap(path), path, topic, dropped)
    return ScanFile(kind=FileKind.MCAP, sensor=topic or "LaserScan or PointCloud2", scans=scans, dropped=dropped)


def _own_scans(path: Path, decoder: OusterDecoder) -> Iterator[FileScan]:
    recording = open_mcap(path)
    for item in recording:
        if isinstance(item, Message) and item.channel.topic == channels.INPUT_PREFIX + "lidar":
            raw = channels.unpack_raw(item.data)
            for scan in decoder.receive(raw.data, item.t_ns, raw.source):
                yield scan_from_lidar(scan, decoder)
    _tell_damage(recording, decoder.dropped)


def _tell_damage(recording: McapScan, dropped: dict[str, int]) -> None:
    """Of a recording that was read through."""
    for damage in recording.damage:
        dropped[f"bytes at {damage.offset}: {damage.what}"] = damage.bytes_lost
    if not recording.is_finished and not recording.damage:
        dropped["the end: it was not closed"] = 1


def _ros_mcap(scan: McapScan, path: Path, topic: str | None, dropped: dict[str, int]) -> Iterator[FileScan]:
    rosbags_typesys = _import("rosbags.typesys")
    store = rosbags_typesys.get_typestore(rosbags_typesys.Stores.EMPTY)
    known: set[str] = set()
    chosen = topic
    for item in scan:
        if not isinstance(item, Message) or (chosen is not None and item.channel.topic != chosen):
            continue
        schema = scan.schemas.get(item.channel.schema_id)
        kind = "" if schema is None else _ros_name(schema.name)
        if schema is None or kind not in LASER_TYPES:
            continue
        chosen = item.channel.topic
        if kind not in known:
            known.add(kind)
            store.register(rosbags_typesys.get_types_from_msg(schema.data.decode(), kind))
        read: Callable[[bytes, str], Any] = (
            store.deserialize_ros1 if item.channel.encoding == "ros1" else store.deserialize_cdr
        )
        yield scan_from_ros(kind, read(item.data, kind))
    if chosen is None or not known:
        raise FileFormatError(
            f"{path}: no LaserScan or PointCloud2{' on ' + topic if topic else ''} in it; see stockpilot info"
        )
    _tell_damage(scan, dropped)


def _ros_name(name: str) -> str:
    parts = name.split("/")
    return name if len(parts) != 2 else f"{parts[0]}/msg/{parts[1]}"


# ---- ROS bags --------------------------------------------------------------------------------------------------------


@contextmanager
def open_bag(path: Path) -> Iterator[Any]:
    """A ROS 1 or 2 bag by rosbags' AnyReader. Raises: FileFormatError: it cannot be opened, or breaks off on the way.

    A bag that is cut or broken makes rosbags fail in many ways, not all of them its own errors: all mean the file.
    """
    highlevel = _import("rosbags.highlevel")
    typesys = _import("rosbags.typesys")
    try:
        with highlevel.AnyReader([path], default_typestore=typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)) as bag:
            yield bag
    except (FileFormatError, OSError):
        raise
    except Exception as error:
        said = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise FileFormatError(
            f"{path}: the bag cannot be read: {said}; if it was cut, `rosbag reindex` or `ros2 bag reindex` may mend it"
        ) from None


def _open_ros(kind: FileKind, path: Path, topic: str | None) -> ScanFile:
    with open_bag(path) as bag:
        found = {c.topic: c.msgtype for c in bag.connections if c.msgtype in LASER_TYPES}
    if topic is None and found:
        topic = sorted(found)[0]
    if topic is None or topic not in found:
        have = ", ".join(sorted(found)) or "none"
        raise FileFormatError(f"{path}: no LaserScan or PointCloud2 on {topic or 'any topic'}; there is: {have}")
    return ScanFile(kind=kind, sensor=f"{topic} ({found[topic]})", scans=_bag_scans(path, topic), dropped={})


def _bag_scans(path: Path, topic: str) -> Iterator[FileScan]:
    with open_bag(path) as bag:
        wanted = [c for c in bag.connections if c.topic == topic]
        for connection, _, raw in bag.messages(connections=wanted):
            yield scan_from_ros(connection.msgtype, bag.deserialize(raw, connection.msgtype))


def scan_from_ros(kind: str, message: Any) -> FileScan:
    """Of a deserialized LaserScan or PointCloud2, with the stamp of its header."""
    stamp = message.header.stamp
    t_ns = int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
    if kind.endswith("LaserScan"):
        ranges = np.asarray(message.ranges, dtype=np.float64)
        step = beam_step(len(ranges), float(message.angle_increment))
        angles = float(message.angle_min) + step * np.arange(len(ranges), dtype=np.float64)
        return scan_from_ranges(t_ns, ranges, angles, float(message.range_min), float(message.range_max))
    return scan_from_points(t_ns, _cloud_points(message))


_ROS_NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # sensor_msgs/PointField


def _cloud_points(cloud: Any) -> Array:
    """(N, 3) x, y, z of a PointCloud2, whatever else its points carry."""
    order = ">" if cloud.is_bigendian else "<"
    places = {f.name: (int(f.offset), order + _ROS_NUMBERS[int(f.datatype)]) for f in cloud.fields}
    if not all(axis in places for axis in "xyz"):
        raise FileFormatError(f"PointCloud2: expected fields x, y, z, got {', '.join(sorted(places))}")
    names = ["x", "y", "z"]
    point = np.dtype(
        {
            "names": names,
            "formats": [places[n][1] for n in names],
            "offsets": [places[n][0] for n in names],
            "itemsize": int(cloud.point_step),
        }
    )
    rows: list[NDArray[Any]] = []
    data = np.asarray(cloud.data, dtype=np.uint8).tobytes()
    for row in range(int(cloud.height)):
        rows.append(np.frombuffer(data, dtype=point, count=int(cloud.width), offset=row * int(cloud.row_step)))
    points = np.concatenate(rows) if rows else np.zeros(0, dtype=point)
    return np.stack([points[n].astype(np.float64) for n in names], axis=1)


# ---- CARMEN ----------------------------------------------------------------------------------------------------------


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


def _carmen_scans(path: Path, dropped: dict[str, int]) -> Iterator[FileScan]:
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


def _import(name: str) -> Any:
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise FileFormatError(
            f'this kind of recording needs the extra "import": pip install stockpilot[import] ({error})'
        ) from None
