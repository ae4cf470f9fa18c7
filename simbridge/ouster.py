"""An Ouster sensor's metadata, beam directions and UDP packets, made by ouster-sdk.

Source: Ouster firmware manual 3.1, "Lidar range data to XYZ lidar coordinate frame" and "Lidar data packet format".
"""

# mypy: disable-error-code="name-defined,attr-defined"
# (core.sdk.core re-exports its names without saying so in a way that strict type checking accepts)

from __future__ import annotations

import math
from typing import Any

import numpy as np
from fastcrc import crc64
from numpy.typing import NDArray
from ouster.sdk import core

from simbridge.config import LidarSimConfig

Array = NDArray[np.float64]

COLUMNS_PER_PACKET = 16
SENSOR_ABOVE_BASE_M = 0.03618  # origin of the lidar frame above that of the sensor frame, as in an OS0's metadata
SERIAL = 992100000000
INIT_ID = 1
ALBEDO = 40
CRC_BYTES = 8  # CRC-64/XZ at a packet's end
UDP_PORT_LIDAR = 7502  # Ouster's own


def sensor_info(cfg: LidarSimConfig) -> Any:
    """ouster-sdk's SensorInfo of the emulated sensor. Beams leave the rotation axis itself (no beam offset)."""
    info = core.SensorInfo.from_default(core.LidarMode(cfg.columns, cfg.rate_hz))
    info.prod_line = f"OS-0-{max(cfg.rows, 32)}-BH"
    info.sn, info.init_id, info.fw_rev, info.image_rev = SERIAL, INIT_ID, "v3.1.0", "ousteros-image-prod-bootes-v3.1.0"
    info.status, info.build_date = "RUNNING", "2024-01-01T00:00:00Z"
    info.beam_altitude_angles = elevations_deg(cfg).tolist()
    info.beam_azimuth_angles = [0.0] * cfg.rows
    info.beam_to_lidar_transform = np.eye(4)
    info.lidar_origin_to_beam_origin_mm = 0.0
    info.lidar_to_sensor_transform = np.array(
        [[-1.0, 0, 0, 0], [0, -1.0, 0, 0], [0, 0, 1.0, SENSOR_ABOVE_BASE_M * 1000], [0, 0, 0, 1.0]]
    )
    info.format.pixels_per_column = cfg.rows
    info.format.pixel_shift_by_row = [0] * cfg.rows
    info.format.columns_per_packet = COLUMNS_PER_PACKET
    info.format.udp_profile_lidar = core.UDPProfileLidar.RNG19_RFL8_SIG16_NIR16
    info.config.udp_port_lidar, info.config.udp_port_imu = 7502, 7503  # without a port the SDK reads the profile as OFF
    return info


def elevations_deg(cfg: LidarSimConfig) -> Array:
    """(rows,), top row first."""
    return np.linspace(cfg.elevation_max_deg, cfg.elevation_min_deg, cfg.rows)


def directions_sensor(cfg: LidarSimConfig) -> Array:
    """(columns, rows, 3) unit vectors in the sensor frame.

    The encoder turns clockwise seen from above, and the lidar frame is the sensor frame turned by half a turn: column
    0 looks back along -x, a quarter turn later along +y.
    """
    encoder = 2.0 * math.pi * (1.0 - np.arange(cfg.columns) / cfg.columns)
    elevation = np.radians(elevations_deg(cfg))
    x = np.cos(encoder)[:, None] * np.cos(elevation)
    y = np.sin(encoder)[:, None] * np.cos(elevation)
    z = np.broadcast_to(np.sin(elevation), x.shape)
    return np.stack([-x, -y, z], axis=-1)


class PacketWriter:
    """Lidar packets of COLUMNS_PER_PACKET columns each, as they are measured.

    Fill stamps (packets of a turn, 16) uint64, in ns of the sensor's clock, range_mm (packets, 16, rows) uint32, below
    2^19, and signal (the same) uint16 and call `pack`. ouster-sdk packs whole frames only, and slowly: this has it pack
    one packet, whose changing parts are then overwritten in place (a test packs the same by the SDK).
    """

    def __init__(self, cfg: LidarSimConfig) -> None:
        layout = core.PacketFormat(sensor_info(cfg))
        self._frame_ids = int(layout.max_frame_id) + 1
        turn = np.tile(_template(cfg, layout), (cfg.columns // COLUMNS_PER_PACKET, 1))
        packets = turn.view(_packet_type(cfg.rows, layout))[:, 0]
        column = packets["column"]
        column["measurement_id"] = np.arange(cfg.columns).reshape(-1, COLUMNS_PER_PACKET)
        self.range_mm: NDArray[np.uint32] = column["pixel"]["range"]
        self.signal: NDArray[np.uint16] = column["pixel"]["signal"]
        self.stamps: NDArray[np.uint64] = column["stamp"]
        self._frame_id = packets["frame_id"]
        self._unchecked = [row[:-CRC_BYTES] for row in turn]

    def pack(self, frame_id: int, packet: int) -> bytes:
        """Packet number `packet` of a turn."""
        self._frame_id[packet] = frame_id % self._frame_ids
        data: bytes = self._unchecked[packet].tobytes()
        return data + crc64.xz(data).to_bytes(CRC_BYTES, "little")


def _template(cfg: LidarSimConfig, packet_format: Any) -> NDArray[np.uint8]:
    """One packet by ouster-sdk, of a frame just as wide, with nothing measured in it."""
    narrow = sensor_info(cfg)
    narrow.format.columns_per_frame = COLUMNS_PER_PACKET
    narrow.format.column_window = (0, COLUMNS_PER_PACKET - 1)
    frame = core.LidarFrame(narrow)
    frame.field("REFLECTIVITY")[:] = ALBEDO
    frame.status[:] = 1
    packet: Any = core.frame_to_packets(frame, packet_format, INIT_ID, SERIAL)[0]
    return np.array(packet.buf, dtype=np.uint8)


def _packet_type(rows: int, packet_format: Any) -> np.dtype[np.void]:
    """What `pack` writes of a packet of profile RNG19_RFL8_SIG16_NIR16, as a numpy record."""
    pixel = np.dtype({"names": ["range", "signal"], "formats": ["<u4", "<u2"], "offsets": [0, 6], "itemsize": 12})
    column = np.dtype(
        {
            "names": ["stamp", "measurement_id", "pixel"],
            "formats": ["<u8", "<u2", (pixel, (rows,))],
            "offsets": [0, 8, packet_format.col_header_size],
            "itemsize": packet_format.col_size,
        }
    )
    return np.dtype(
        {
            "names": ["frame_id", "column"],
            "formats": ["<u2", (column, (COLUMNS_PER_PACKET,))],
            "offsets": [2, packet_format.packet_header_size],
            "itemsize": packet_format.lidar_packet_size,
        }
    )
