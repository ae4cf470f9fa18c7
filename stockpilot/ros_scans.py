"""Scans out of ROS recordings: bags of ROS 1 and 2, and MCAP with LaserScan or PointCloud2. Wants the extra "import"."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.errors import FileFormatError
from companion.messages import Array
from companion.recording.mcap_read import McapScan, Message
from stockpilot.file_kinds import FileKind
from stockpilot.file_scan import FileScan, ScanFile, beam_step, scan_from_points, scan_from_ranges

UNREADABLE = "messages that cannot be read"
LASER_TYPES = ("sensor_msgs/msg/LaserScan", "sensor_msgs/msg/PointCloud2")


@dataclass(slots=True)
class Reading:
    """Scans of messages one by one: those that cannot be read are counted in dropped, until there was nothing else.

    A broken message makes rosbags fail in many ways, not all of them its own errors: all mean the message.
    """

    if_none: str
    dropped: dict[str, int]
    scans: int = 0
    why: Exception | None = None

    def scan(self, kind: str, read: Callable[[], Any]) -> list[FileScan]:
        """The scan of a message, or nothing. read: gives it deserialized."""
        try:
            found = scan_from_ros(kind, read())
        except Exception as error:
            self.why = self.why or error
            self.dropped[UNREADABLE] = self.dropped.get(UNREADABLE, 0) + 1
            return []
        self.scans += 1
        return [found]

    def finish(self) -> None:
        """Raises: FileFormatError: there were messages, and none could be read."""
        if self.why is not None and not self.scans:
            raise FileFormatError(f"{self.if_none}: {type(self.why).__name__}: {self.why}")


def mcap_scans(scan: McapScan, path: Path, topic: str | None, dropped: dict[str, int]) -> Iterator[FileScan]:
    """LaserScan or PointCloud2 messages of one topic, by default the first that has any. Raises: FileFormatError: there
    are none, or none can be read."""
    typesys = _import("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.EMPTY)
    known: set[str] = set()
    chosen, reading = topic, None
    for item in scan:
        if not isinstance(item, Message) or (chosen is not None and item.channel.topic != chosen):
            continue
        schema = scan.schemas.get(item.channel.schema_id)
        kind = "" if schema is None else _ros_name(schema.name)
        if schema is None or kind not in LASER_TYPES:
            continue
        chosen = item.channel.topic
        reading = reading or Reading(f"{path}: none of the messages on {chosen} can be read", dropped)

        def read(message: Message = item, kind: str = kind, definition: bytes = schema.data) -> Any:
            if kind not in known:
                store.register(typesys.get_types_from_msg(definition.decode(), kind))
                known.add(kind)
            is_ros1 = message.channel.encoding == "ros1"
            return store.deserialize_ros1(message.data, kind) if is_ros1 else store.deserialize_cdr(message.data, kind)

        yield from reading.scan(kind, read)
    if reading is None:
        raise FileFormatError(
            f"{path}: no LaserScan or PointCloud2{' on ' + topic if topic else ''} in it; see stockpilot info"
        )
    reading.finish()


def _ros_name(name: str) -> str:
    parts = name.split("/")
    return name if len(parts) != 2 else f"{parts[0]}/msg/{parts[1]}"


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


def open_ros(kind: FileKind, path: Path, topic: str | None) -> ScanFile:
    with open_bag(path) as bag:
        found = {c.topic: c.msgtype for c in bag.connections if c.msgtype in LASER_TYPES}
    if topic is None and found:
        topic = sorted(found)[0]
    if topic is None or topic not in found:
        have = ", ".join(sorted(found)) or "none"
        raise FileFormatError(f"{path}: no LaserScan or PointCloud2 on {topic or 'any topic'}; there is: {have}")
    dropped: dict[str, int] = {}
    scans = _bag_scans(path, topic, dropped)
    return ScanFile(kind=kind, sensor=f"{topic} ({found[topic]})", scans=scans, dropped=dropped)


def _bag_scans(path: Path, topic: str, dropped: dict[str, int]) -> Iterator[FileScan]:
    with open_bag(path) as bag:
        wanted = [c for c in bag.connections if c.topic == topic]
        reading = Reading(f"{path}: none of the messages on {topic} can be read", dropped)
        for connection, _, raw in bag.messages(connections=wanted):
            kind = connection.msgtype
            yield from reading.scan(kind, partial(bag.deserialize, raw, kind))
        reading.finish()


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


def _import(name: str) -> Any:
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise FileFormatError(
            f'this kind of recording needs the extra "import": pip install stockpilot[import] ({error})'
        ) from None
