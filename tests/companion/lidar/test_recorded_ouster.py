"""Captures of real sensors decode and project as with the vendor's own software."""

from __future__ import annotations

import numpy as np
import ouster.sdk.core as sdk
import pytest

from companion.lidar.ouster import OusterDecoder
from companion.lidar.pcap import PcapReader
from companion.messages import LidarScan
from tests.companion.lidar.packets import sdk_frames
from tests.shared_data import shared_data

CAPTURES = [
    ("OS-0-32-U1_v2.2.0_1024x10.pcap", "OS-0-32-U1_v2.2.0_1024x10.json", 1),
    ("OS-0-128-U1_v2.3.0_1024x10.pcap", "OS-0-128-U1_v2.3.0_1024x10.json", 1),
    ("OS-1-128_v2.3.0_1024x10_lb_n3.pcap", "OS-1-128_v2.3.0_1024x10.json", 3),
    ("crc_test.pcap", "crc_test.json", 1),
]


def decode(capture: str, metadata: str) -> tuple[OusterDecoder, list[LidarScan], list[bytes]]:
    decoder = OusterDecoder(shared_data("ouster", metadata).read_text())
    scans: list[LidarScan] = []
    packets: list[bytes] = []
    for packet in PcapReader(shared_data("ouster", capture)):
        scans += decoder.receive(packet.data, packet.t_ns, packet.source)
        if len(packet.data) == 8448:
            packets.append(packet.data)
    return decoder, scans, packets


@pytest.mark.parametrize(("capture", "metadata", "count"), CAPTURES)
def test_recorded_scans_are_bit_exact_and_lie_where_the_vendor_puts_them(
    capture: str, metadata: str, count: int
) -> None:
    decoder, scans, packets = decode(capture, metadata)
    reference = sdk_frames(decoder.info, packets)
    assert len(scans) == count
    lut = sdk.XYZLut(decoder.info, use_extrinsics=False)
    for scan, frame in zip(scans, reference, strict=False):
        millimetres = np.round(scan.range_m.astype(np.float64) * 1000).astype(np.uint32)
        np.testing.assert_array_equal(millimetres, frame.field("RANGE"))
        seen = millimetres > 0
        assert seen.mean() > 0.3
        points = scan.geometry.directions * (millimetres[..., None] * 1e-3) + scan.geometry.offsets_m
        np.testing.assert_allclose(points[seen], lut(frame)[seen], atol=1e-9)
        np.testing.assert_array_equal(np.diff(scan.t_column_ns), np.diff(frame.timestamp.astype(np.int64)))


def test_inertial_packets_are_told_apart_by_size() -> None:
    decoder, _, _ = decode(*CAPTURES[0][:2])
    assert {k: n for k, n in decoder.dropped.items() if n} == {"size": 10}


def test_flipped_bit_in_a_recorded_packet_is_found_by_its_checksum() -> None:
    decoder, _, packets = decode("crc_test.pcap", "crc_test.json")
    assert decoder.dropped["checksum"] == 0
    again = OusterDecoder(shared_data("ouster", "crc_test.json").read_text())
    for n, packet in enumerate(packets):
        broken = bytearray(packet)
        broken[32 + 97 * n] ^= 1 << (n % 8)
        again.receive(bytes(broken), n * 3_000_000)
    assert again.dropped["checksum"] + again.dropped["header"] == len(packets)
    assert again.scans == 0
