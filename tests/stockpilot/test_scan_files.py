"""Other people's recordings are recognised by content and read with their own times."""

from __future__ import annotations

import gzip
import inspect
import io
import math
import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from companion.errors import FileFormatError
from stockpilot.file_kinds import FileKind, file_kind
from stockpilot.file_scan import FileScan
from stockpilot.scan_files import open_scans
from tests.companion.lidar.packets import frame_packets, sensor
from tests.companion.lidar.test_pcap import classic, ip
from tests.shared_data import shared_data

STORE = get_typestore(Stores.ROS2_HUMBLE)
STORE1 = get_typestore(Stores.ROS1_NOETIC)
RANGES = [1.0, 2.0, float("inf"), float("nan"), 0.0, 4.0]
STAMP_NS = 1_700_000_123_000_000_456


def laser_scan(store, n: int):
    kinds = store.types
    stamp = kinds["builtin_interfaces/msg/Time"](sec=1_700_000_123 + n, nanosec=456)
    header_type = kinds["std_msgs/msg/Header"]
    header = (
        header_type(seq=n, stamp=stamp, frame_id="laser")
        if store is STORE1
        else header_type(stamp=stamp, frame_id="laser")
    )
    return kinds["sensor_msgs/msg/LaserScan"](
        header=header, angle_min=-0.5, angle_max=0.5, angle_increment=0.25, time_increment=0.0, scan_time=0.1,
        range_min=0.1, range_max=10.0, ranges=np.array(RANGES, dtype=np.float32), intensities=np.zeros(0, dtype=np.float32),
    )  # fmt: skip


def point_cloud(store, points: np.ndarray):
    kinds = store.types
    field = kinds["sensor_msgs/msg/PointField"]
    record = np.zeros(len(points), dtype=[("i", "u1"), ("y", "<f8"), ("x", "<f4"), ("z", "<f4")])
    for axis, k in (("x", 0), ("y", 1), ("z", 2)):
        record[axis] = points[:, k]
    stamp = kinds["builtin_interfaces/msg/Time"](sec=1_700_000_123, nanosec=456)
    return kinds["sensor_msgs/msg/PointCloud2"](
        header=kinds["std_msgs/msg/Header"](stamp=stamp, frame_id="lidar"), height=1, width=len(points),
        fields=[
            field(name="i", offset=0, datatype=2, count=1),
            field(name="y", offset=1, datatype=8, count=1),
            field(name="x", offset=9, datatype=7, count=1),
            field(name="z", offset=13, datatype=7, count=1),
        ],
        is_bigendian=False, point_step=17, row_step=17 * len(points),
        data=np.frombuffer(record.tobytes(), dtype=np.uint8), is_dense=True,
    )  # fmt: skip


def scans_of(path: Path, **more: object) -> list[FileScan]:
    return list(open_scans(path, **more).scans)  # type: ignore[arg-type]


def check_laser_scans(scans: list[FileScan]) -> None:
    assert [s.t_ns for s in scans] == [STAMP_NS + n * 10**9 for n in range(3)]
    expected = [(r * math.cos(a), r * math.sin(a)) for r, a in ((1.0, -0.5), (2.0, -0.25), (4.0, 0.75))]
    np.testing.assert_allclose(scans[0].points, expected, rtol=1e-6)


def test_ros1_bag_with_laser_scans(tmp_path: Path) -> None:
    path = tmp_path / "anything"
    with Writer1(path) as bag:
        connection = bag.add_connection("/scan", "sensor_msgs/msg/LaserScan", typestore=STORE1)
        for n in range(3):
            data = STORE1.serialize_ros1(laser_scan(STORE1, n), "sensor_msgs/msg/LaserScan")
            bag.write(connection, 5 + n, data)
    assert file_kind(path)[0] is FileKind.ROS1
    check_laser_scans(scans_of(path))


def test_ros2_bag_with_laser_scans(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    needs_version = "version" in inspect.signature(Writer2.__init__).parameters
    with Writer2(path, version=9) if needs_version else Writer2(path) as bag:
        connection = bag.add_connection("/scan", "sensor_msgs/msg/LaserScan", typestore=STORE)
        for n in range(3):
            bag.write(connection, 5 + n, STORE.serialize_cdr(laser_scan(STORE, n), "sensor_msgs/msg/LaserScan"))
    assert file_kind(path)[0] is FileKind.ROS2
    check_laser_scans(scans_of(path))
    (inside,) = path.glob("*.db3")
    check_laser_scans(scans_of(inside))


def write_mcap(path: Path, kind: str, topic: str, messages: list[bytes]) -> None:
    out = io.BytesIO()
    writer = Writer(out)
    writer.start(profile="ros2")
    definition, _ = STORE.generate_msgdef(kind, ros_version=2)
    channel = writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", definition.encode()))
    for n, data in enumerate(messages):
        writer.add_message(channel, n, data, n)
    writer.finish()
    path.write_bytes(out.getvalue())


def test_mcap_with_laser_scans(tmp_path: Path) -> None:
    kind = "sensor_msgs/msg/LaserScan"
    path = tmp_path / "scans"
    write_mcap(path, kind, "/scan", [bytes(STORE.serialize_cdr(laser_scan(STORE, n), kind)) for n in range(3)])
    assert file_kind(path)[0] is FileKind.MCAP
    check_laser_scans(scans_of(path))
    with pytest.raises(FileFormatError, match="LaserScan"):
        scans_of(path, topic="/other")


def test_mcap_with_point_clouds(tmp_path: Path) -> None:
    points = np.array([[3.0, 1.0, 0.01], [3.0, 0.0, 2.0], [-4.0, 2.0, -0.05], [np.nan, 0, 0], [0.1, 0.1, 0.0]])
    kind, path = "sensor_msgs/msg/PointCloud2", tmp_path / "clouds"
    write_mcap(path, kind, "/points", [bytes(STORE.serialize_cdr(point_cloud(STORE, points), kind))])
    (scan,) = scans_of(path)
    assert scan.t_ns == STAMP_NS
    assert len(scan.points_3d) == 4
    np.testing.assert_allclose(scan.points, [[3.0, 1.0], [-4.0, 2.0]], rtol=1e-6)


def test_ros_messages_that_cannot_be_read_are_counted_and_the_others_kept(tmp_path: Path) -> None:
    kind = "sensor_msgs/msg/PointCloud2"
    whole = bytes(STORE.serialize_cdr(point_cloud(STORE, np.array([[3.0, 1.0, 0.01], [3.0, 0.0, 2.0]])), kind))
    cut = whole[:-20]
    path = tmp_path / "clouds"
    write_mcap(path, kind, "/points", [cut, whole, b"\x00\x01\x00\x00", whole, b""])
    read = open_scans(path)
    assert len(list(read.scans)) == 2
    assert read.dropped == {"messages that cannot be read": 3}
    write_mcap(path, kind, "/points", [cut, b""])
    with pytest.raises(FileFormatError, match=r"clouds: none of the messages on /points can be read"):
        scans_of(path)
    needs_version = "version" in inspect.signature(Writer2.__init__).parameters
    bag_path = tmp_path / "bag"
    with Writer2(bag_path, version=9) if needs_version else Writer2(bag_path) as bag:
        connection = bag.add_connection("/points", kind, typestore=STORE)
        for n, data in enumerate([whole, cut, whole]):
            bag.write(connection, 5 + n, data)
    read = open_scans(bag_path)
    assert len(list(read.scans)) == 2
    assert read.dropped == {"messages that cannot be read": 1}


@pytest.mark.parametrize("packed", [False, True])
def test_carmen_log(tmp_path: Path, packed: bool) -> None:
    lines = [
        "# message formats defined: PARAM SYNC ODOM FLASER",
        "PARAM robot_frontlaser_offset 0.0 nohost 0",
        "ODOM 0 0 0 0 0 0 0.000246 pippo 0.000246",
        "FLASER 4 1.0 2.0 3.0 81.83 0 0 0 0 0 0 1700000123.000000456 pippo 7.5",
        "FLASER 4 1.0 2.0 3",
        "ROBOTLASER1 0 -1.0 2.0 1.0 50.0 0.01 0 3 1.0 60.0 2.0 0 0 0 0 0 0 0 0 0 0 0 0 0 1700000124.5 host 8.5",
    ]
    data = "\n".join(lines).encode()
    path = tmp_path / "log"
    path.write_bytes(gzip.compress(data) if packed else data)
    assert file_kind(path)[0] is FileKind.CARMEN
    first, second = scans_of(path)
    assert [first.t_ns, second.t_ns] == [1_700_000_123_000_000_456, 1_700_000_124_500_000_000]
    assert len(first.points) == 3
    np.testing.assert_allclose(first.points[0], [0.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(second.points, [[math.cos(-1), math.sin(-1)], [2 * math.cos(1), 2 * math.sin(1)]])


def udp_frame(data: bytes, port: int) -> bytes:
    return ip(struct.pack(">HHHH", port, port, 8 + len(data), 0) + data)


def test_ouster_capture_carries_the_sensors_own_time(tmp_path: Path) -> None:
    info = sensor()
    packets = frame_packets(info, 1, t_ns=5_000_000_000) + frame_packets(info, 2, t_ns=5_100_000_000)
    (tmp_path / "capture.pcap").write_bytes(classic([udp_frame(p, 7502) for p in packets]))
    with pytest.raises(FileFormatError, match="--metadata"):
        open_scans(tmp_path / "capture.pcap")
    (tmp_path / "capture.json").write_text(info.to_json_string())
    scans = scans_of(tmp_path / "capture.pcap")
    assert [s.t_ns for s in scans] == [5_000_000_000 + 511 * 195_312, 5_100_000_000 + 511 * 195_312]
    assert len(scans[0].points) == 512
    assert len(scans[0].points_3d) == 512 * 5


def velodyne_packet(first_azimuth: int, t_us: int, distance_m: float) -> bytes:
    """A VLP-16 data packet (Velodyne VLP-16 manual, section 9.3): 12 blocks of 32 returns, all at one distance."""
    blocks = b""
    for n in range(12):
        azimuth = (first_azimuth + n * 40) % 36000
        blocks += struct.pack("<HH", 0xEEFF, azimuth) + struct.pack("<HB", round(distance_m / 0.002), 100) * 32
    return blocks + struct.pack("<IBB", t_us, 0x37, 0x22)


def test_velodyne_capture(tmp_path: Path) -> None:
    packets = [velodyne_packet(n * 480 % 36000, 1_000_000 + n * 1327, 10.0) for n in range(240)]
    path = tmp_path / "velodyne.pcap"
    path.write_bytes(classic([udp_frame(p, 2368) for p in packets], step_us=1327))
    opened = open_scans(path)
    assert opened.sensor == "Velodyne"
    scans = list(opened.scans)
    assert len(scans) >= 3
    whole = scans[1]
    np.testing.assert_allclose(np.linalg.norm(whole.points_3d, axis=1), 10.0, atol=0.01)
    assert len(whole.points_3d) > 20_000
    flat = np.hypot(*whole.points.T)
    assert len(flat) > 2000
    assert flat.min() > 9.99
    step_s = (scans[2].t_ns - scans[1].t_ns) * 1e-9
    assert step_s == pytest.approx(0.0995, abs=0.003)


def test_recorded_logs_of_other_robots() -> None:
    carmen = scans_of(shared_data("scans2d", "aces-corrected.log.gz"))
    assert len(carmen) == 440
    assert carmen[0].t_ns == 21_019_900_000
    bag = open_scans(shared_data("scans2d", "intel.orig.bag"))
    first = next(bag.scans)
    assert first.t_ns == 976_052_857_337_530_017
    assert len(first.points) > 150


def test_recorded_captures_of_real_sensors() -> None:
    scans = scans_of(shared_data("ouster", "OS-1-128_v2.3.0_1024x10_lb_n3.pcap"))
    assert [s.t_ns for s in scans] == sorted(s.t_ns for s in scans)
    assert len(scans) == 3
    assert 991_600_000_000 < scans[0].t_ns < 991_700_000_000, "not the sensor's own clock"


@pytest.mark.parametrize("content", [b"", b"just text\nof no kind\n", bytes(100), b"\x1f\x8b broken gzip"])
def test_what_is_no_recording_is_told(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "file"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match="not a recording"):
        open_scans(path)


def test_missing_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"no such|cannot be read"):
        open_scans(tmp_path / "absent")


def test_bag_without_scans_is_told(tmp_path: Path) -> None:
    path = tmp_path / "bag"
    with Writer1(path) as bag:
        bag.add_connection("/chatter", "std_msgs/msg/String", typestore=STORE1)
    with pytest.raises(FileFormatError, match="LaserScan"):
        open_scans(path)


@pytest.mark.parametrize("share", [0.02, 0.3, 0.6, 0.95])
def test_cut_bag_is_told_and_never_a_traceback(tmp_path: Path, share: float) -> None:
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    with Writer1(whole) as bag:
        connection = bag.add_connection("/scan", "sensor_msgs/msg/LaserScan", typestore=STORE1)
        for n in range(50):
            bag.write(connection, n, STORE1.serialize_ros1(laser_scan(STORE1, n), "sensor_msgs/msg/LaserScan"))
    data = whole.read_bytes()
    cut.write_bytes(data[: int(len(data) * share)])
    with pytest.raises(FileFormatError, match="cut"):
        scans_of(cut)


def test_packed_log_that_is_cut_gives_what_came_before_and_is_told(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    lines = [f"FLASER 4 {' '.join(map(str, rng.uniform(1, 9, 4)))} 0 0 0 0 0 0 {n}.5 host {n}.5" for n in range(500)]
    path = tmp_path / "log"
    path.write_bytes(gzip.compress("\n".join(lines).encode())[:-9000])
    opened = open_scans(path)
    scans = list(opened.scans)
    assert 100 < len(scans) < 500
    assert [s.t_ns for s in scans] == [n * 10**9 + 500_000_000 for n in range(len(scans))]
    assert "cut" in next(iter(opened.dropped))
