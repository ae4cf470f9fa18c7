"""An Ouster sensor's metadata, beam directions and UDP packets, made by ouster-sdk.

Source: Ouster firmware manual 3.1, "Lidar range data to XYZ lidar coordinate frame" and "Lidar data packet format".
"""

# mypy: disable-error-code="name-defined,attr-defined"
# (core.sdk.core re-exports its names without saying so in a way that strict type checking accepts)

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from ouster.sdk import core

from simbridge.config import LidarSimConfig

Array = NDArray[np.float64]

COLUMNS_PER_PACKET = 16
SENSOR_ABOVE_BASE_M = 0.03618  # origin of the lidar frame above that of the sensor frame, as in an OS0's metadata
SERIAL = 992100000000
INIT_ID = 1
ALBEDO = 40
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

    Fill range_mm (rows, 16) uint32 and signal (rows, 16) uint16 and call `pack`. ouster-sdk packs whole frames, so
    this gives it a frame of just one packet's width and then sets the columns' numbers within the turn.
    """

    def __init__(self, cfg: LidarSimConfig) -> None:
        info, narrow = sensor_info(cfg), sensor_info(cfg)
        narrow.format.columns_per_frame = COLUMNS_PER_PACKET
        narrow.format.column_window = (0, COLUMNS_PER_PACKET - 1)
        self._format = core.PacketFormat(info)
        self._frame = core.LidarFrame(narrow)
        self.range_mm: NDArray[np.uint32] = self._frame.field("RANGE")
        self.signal: NDArray[np.uint16] = self._frame.field("SIGNAL")
        self._reflectivity = self._frame.field("REFLECTIVITY")
        self._reflectivity[:] = ALBEDO
        self._frame.status[:] = 1
        self._timestamp = self._frame.timestamp
        self._max_frame_id = int(self._format.max_frame_id)

    def pack(self, frame_id: int, first_column: int, t_sensor_ns: NDArray[np.int64]) -> bytes:
        """The packet of columns first_column to first_column + 15 of a turn, measured at t_sensor_ns (16,)."""
        self._frame.frame_id = frame_id % (self._max_frame_id + 1)
        self._timestamp[:] = t_sensor_ns
        packet: Any = core.frame_to_packets(self._frame, self._format, INIT_ID, SERIAL)[0]
        for k in range(COLUMNS_PER_PACKET):
            self._format.set_col_measurement_id(packet, k, first_column + k)
        packet.buf[-8:] = np.frombuffer(packet.calculate_crc().to_bytes(8, "little"), dtype=np.uint8)
        return bytes(packet.buf)
