"""The checksum that both sides use against the vendor's own, and against the value that its definition names."""

from __future__ import annotations

import numpy as np
import ouster.sdk.core as sdk
from fastcrc import crc64

from tests.companion.lidar.packets import frame_packets, sensor


def test_checksum_of_the_check_string_is_the_standards() -> None:
    assert crc64.xz(b"123456789") == 0x995DC9BBDF1939FA  # CRC-64/XZ


def test_checksum_is_the_vendors_for_packets_of_any_length_and_content() -> None:
    rng = np.random.default_rng(7)
    for rows in (1, 5, 16, 32):
        info = sensor(rows=rows)
        packet_format = sdk.PacketFormat.from_info(info)
        packet = np.frombuffer(frame_packets(info, 3)[0], np.uint8)
        noise = rng.integers(0, 256, len(packet)).astype(np.uint8)
        for data in (packet, noise):
            assert crc64.xz(data[:-8].tobytes()) == packet_format.calculate_crc(data)
