"""Packets of an Ouster sensor for tests, made by the vendor's SDK: an encoder that the decoder's author did not write."""

from __future__ import annotations

import numpy as np
import ouster.sdk.core as sdk
from numpy.typing import NDArray

INIT_ID, SERIAL = 77, 122000001234
PERIOD_NS = 195_312  # between columns, 512 at 10 Hz
TURN_NS = 100_000_000


def sensor(
    rows: int = 5, columns: int = 512, profile: str = "RNG19_RFL8_SIG16_NIR16", shift: int = 0
) -> sdk.SensorInfo:
    """A sensor with those rows; shift: staggering of every other row, columns."""
    info = sdk.SensorInfo.from_default(sdk.LidarMode(columns, 10))
    info.prod_line, info.fw_rev, info.image_rev = "OS-0-32", "v3.1.0", "ousteros-image-prod-bootes-v3.1.0"
    info.sn, info.init_id = SERIAL, INIT_ID
    info.config.udp_port_lidar = 7502
    info.beam_altitude_angles = np.linspace(0.0, -45.0, rows).tolist()
    info.beam_azimuth_angles = [3.0 * (n % 2) for n in range(rows)]
    info.format.pixels_per_column = rows
    info.format.pixel_shift_by_row = [shift * (n % 2) for n in range(rows)]
    info.format.udp_profile_lidar = getattr(sdk.UDPProfileLidar, profile)
    return info


def frame_packets(
    info: sdk.SensorInfo,
    frame_id: int,
    *,
    ranges_mm: NDArray[np.uint32] | None = None,
    t_ns: int | None = None,
    init_id: int = INIT_ID,
    serial: int = SERIAL,
    seed: int | None = None,
) -> list[bytes]:
    """One turn's packets. ranges_mm: (rows, columns); default: random by seed (default: by frame_id)."""
    rng = np.random.default_rng(frame_id if seed is None else seed)
    frame = sdk.LidarFrame(info)
    frame.frame_id = frame_id
    drawn = rng.integers(500, 50_000, (info.h, info.w)) // 8 * 8
    frame.field("RANGE")[:] = drawn if ranges_mm is None else ranges_mm
    for name in ("SIGNAL", "REFLECTIVITY"):
        if frame.has_field(name):
            frame.field(name)[:] = rng.integers(1, 255, (info.h, info.w))
    start = 1_000_000_000 + frame_id * TURN_NS if t_ns is None else t_ns
    frame.timestamp[:] = start + np.arange(info.w) * (PERIOD_NS * 512 // info.w)
    frame.status[:] = 1
    frame.measurement_id[:] = np.arange(info.w)
    return [bytes(p.buf) for p in sdk.frame_to_packets(frame, sdk.PacketFormat.from_info(info), init_id, serial)]


def sdk_frames(info: sdk.SensorInfo, packets: list[bytes]) -> list[sdk.LidarFrame]:
    """What the vendor's own batcher makes of packets: every frame that is complete, and the last one."""
    batcher, packet_format = sdk.FrameBatcher(info), sdk.PacketFormat.from_info(info)
    frames, frame = [], sdk.LidarFrame(info)
    for data in packets:
        packet = sdk.LidarPacket(packet_format)
        packet.buf[:] = np.frombuffer(data, dtype=np.uint8)
        if batcher.batch(packet, frame):
            frames.append(frame)
            frame = sdk.LidarFrame(info)
    if np.any(frame.status):
        frames.append(frame)
    return frames
