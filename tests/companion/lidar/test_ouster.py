"""Ouster packets to scans, held against the vendor's own SDK and against packets that are wrong in every way."""

from __future__ import annotations

import time

import numpy as np
import ouster.sdk.core as sdk
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from companion.config import LidarConfig
from companion.errors import FileFormatError
from companion.lidar.ouster import DROP_REASONS, OusterDecoder
from companion.messages import LidarScan
from tests.companion.lidar.packets import INIT_ID, PERIOD_NS, SERIAL, TURN_NS, frame_packets, sdk_frames, sensor

DELAY_NS = 5_000_000_000  # companion clock minus sensor clock
SOURCE = ("192.168.1.10", 7502)


def feed(
    decoder: OusterDecoder, packets: list[bytes], t_ns: int = 7_000_000_000, step_ns: int = 3_125_000
) -> list[LidarScan]:
    scans: list[LidarScan] = []
    for n, packet in enumerate(packets):
        scans += decoder.receive(packet, t_ns + n * step_ns, SOURCE)
    return scans


def decoder_of(info: sdk.SensorInfo) -> OusterDecoder:
    return OusterDecoder(info.to_json_string())


def dropped(decoder: OusterDecoder) -> dict[str, int]:
    return {reason: n for reason, n in decoder.dropped.items() if n}


@pytest.mark.parametrize(
    "profile",
    [
        "LEGACY",
        "RNG19_RFL8_SIG16_NIR16",
        "RNG19_RFL8_SIG16_NIR16_DUAL",
        "RNG15_RFL8_NIR8",
        "RNG15_RFL8_NIR8_DUAL",
        "FUSA_RNG15_RFL8_NIR8_DUAL",
    ],
)
@pytest.mark.parametrize(("rows", "columns"), [(5, 512), (32, 1024), (64, 512)])
def test_every_profile_decodes_as_the_vendor_decodes_it(profile: str, rows: int, columns: int) -> None:
    info = sensor(rows, columns, profile)
    packets = frame_packets(info, 7) + frame_packets(info, 8)
    decoder = decoder_of(info)
    scans = feed(decoder, packets)
    reference = sdk_frames(info, packets)
    assert len(scans) == len(reference) == 2
    for scan, frame in zip(scans, reference, strict=True):
        assert scan.frame_id == frame.frame_id
        np.testing.assert_array_equal(np.round(scan.range_m.astype(np.float64) * 1000), frame.field("RANGE"))
        signal = "SIGNAL" if frame.has_field("SIGNAL") else "REFLECTIVITY"
        np.testing.assert_array_equal(scan.signal, frame.field(signal))
        assert scan.column_valid.all()
    assert dropped(decoder) == {}


@pytest.mark.parametrize("shift", [0, 9])
def test_points_lie_where_the_vendor_puts_them(shift: int) -> None:
    info = sensor(16, 512, shift=shift)
    packets = frame_packets(info, 1)
    (scan,) = feed(decoder_of(info), packets)
    points = scan.geometry.directions * scan.range_m[..., None].astype(np.float64) + scan.geometry.offsets_m
    expected = sdk.XYZLut(info, use_extrinsics=False)(sdk_frames(info, packets)[0])
    np.testing.assert_allclose(points, expected, atol=2e-6)  # float32 of up to 50 m
    np.testing.assert_allclose(np.linalg.norm(scan.geometry.directions, axis=2), 1.0, atol=1e-12)


def test_beams_of_a_configured_sensor_are_level_to_45_down_and_turn_clockwise() -> None:
    geometry = OusterDecoder.from_config(LidarConfig()).geometry
    np.testing.assert_allclose(np.degrees(geometry.elevation_rad), [0, -11.25, -22.5, -33.75, -45], atol=1e-9)
    assert geometry.horizontal_row == 0
    np.testing.assert_allclose(geometry.directions[0, [0, 128, 256]], [[-1, 0, 0], [0, 1, 0], [1, 0, 0]], atol=1e-9)
    np.testing.assert_allclose(geometry.directions[4, :, 2], -np.sqrt(0.5), atol=1e-9)


def test_columns_carry_companion_time() -> None:
    info = sensor()
    packets = frame_packets(info, 0, t_ns=2_000_000_000)
    decoder = decoder_of(info)
    scans: list[LidarScan] = []
    for n, packet in enumerate(packets):
        newest_column_ns = 2_000_000_000 + (16 * n + 15) * PERIOD_NS
        scans += decoder.receive(packet, newest_column_ns + DELAY_NS, SOURCE)
    expected = 2_000_000_000 + DELAY_NS + np.arange(512) * PERIOD_NS
    np.testing.assert_allclose(scans[0].t_column_ns, expected, atol=20)
    assert scans[0].t_ns == scans[0].t_column_ns[-1]


def test_lost_packet_leaves_its_columns_invalid_and_the_rest_whole() -> None:
    info = sensor()
    packets = frame_packets(info, 3)
    decoder = decoder_of(info)
    assert feed(decoder, packets[:10] + packets[11:]) == []
    (scan,) = decoder.receive(frame_packets(info, 4)[0], 8_000_000_000, SOURCE)[:1]
    assert scan.frame_id == 3
    assert not scan.column_valid[160:176].any()
    assert scan.column_valid.sum() == 496
    assert not scan.range_m[:, 160:176].any()
    steps = np.diff(scan.t_column_ns)
    assert steps.min() > 0.9 * PERIOD_NS
    assert steps.max() < 1.1 * PERIOD_NS


def test_frame_without_its_last_packet_still_has_times_to_its_end() -> None:
    info = sensor()
    decoder = decoder_of(info)
    feed(decoder, frame_packets(info, 3)[:-1])
    (scan,) = decoder.receive(frame_packets(info, 4)[0], 8_000_000_000, SOURCE)
    assert scan.t_ns - scan.t_column_ns[0] == pytest.approx(511 * PERIOD_NS, abs=100)


def test_reordered_packets_within_a_turn_make_the_same_scan() -> None:
    info = sensor()
    packets = frame_packets(info, 3)
    (in_order,) = feed(decoder_of(info), packets)
    swapped = [packets[n] for n in np.random.default_rng(1).permutation(len(packets))]
    (scan,) = feed(decoder_of(info), swapped)
    np.testing.assert_array_equal(scan.range_m, in_order.range_m)


def test_late_packet_of_the_turn_before_is_dropped() -> None:
    info = sensor()
    first, second = frame_packets(info, 3), frame_packets(info, 4)
    decoder = decoder_of(info)
    scans = feed(decoder, [*first[:-1], second[0], first[-1], *second[1:]])
    assert [s.frame_id for s in scans] == [3, 4]
    assert dropped(decoder) == {"reordered": 1}


def test_repeated_packet_is_dropped() -> None:
    info = sensor()
    packets = frame_packets(info, 3)
    decoder = decoder_of(info)
    scans = feed(decoder, [p for p in packets for _ in range(2)])
    assert len(scans) == 1
    assert dropped(decoder) == {"repeated": 32}


def test_frame_counter_that_wraps_goes_on() -> None:
    info = sensor()
    decoder = decoder_of(info)
    scans = feed(decoder, frame_packets(info, 65535, t_ns=1) + frame_packets(info, 0, t_ns=1 + TURN_NS))
    assert [s.frame_id for s in scans] == [65535, 0]


@pytest.mark.parametrize(
    ("wrong", "reason"),
    [
        (lambda p: p[:-1], "size"),
        (lambda p: p + b"\0", "size"),
        (lambda p: b"", "size"),
        (lambda p: b"\x02" + p[1:], "header"),
        (lambda p: p[:40] + b"\xff\xff" + p[42:], "header"),
        (lambda p: p[:700] + bytes([p[700] ^ 4]) + p[701:], "checksum"),
        (lambda p: p[:-1] + bytes([p[-1] ^ 1]), "checksum"),
    ],
)
def test_malformed_packet_is_dropped_and_counted(wrong, reason: str) -> None:
    info = sensor()
    packets = frame_packets(info, 3)
    decoder = decoder_of(info)
    scans = feed(decoder, [*packets[:5], wrong(packets[5]), *packets[5:]])
    assert len(scans) == 1
    assert scans[0].column_valid.all()
    assert dropped(decoder) == {reason: 1}


def test_packets_of_another_sensor_are_foreign() -> None:
    info = sensor()
    decoder = decoder_of(info)
    assert feed(decoder, frame_packets(info, 3, serial=SERIAL + 1)) == []
    assert dropped(decoder) == {"foreign": 32}


def test_packets_of_another_start_or_address_are_foreign_while_the_sensor_speaks() -> None:
    info = sensor()
    decoder = decoder_of(info)
    feed(decoder, frame_packets(info, 3))
    t_ns = 7_100_000_000
    assert decoder.receive(frame_packets(info, 4, init_id=INIT_ID + 1)[0], t_ns, SOURCE) == []
    assert decoder.receive(frame_packets(info, 4)[0], t_ns, ("10.0.0.66", 7502)) == []
    assert dropped(decoder) == {"foreign": 2}


def test_restarted_sensor_is_taken_up_after_its_silence() -> None:
    info = sensor()
    decoder = decoder_of(info)
    feed(decoder, frame_packets(info, 5000, t_ns=900_000_000_000))
    scans = feed(decoder, frame_packets(info, 1, t_ns=2_000_000_000, init_id=INIT_ID + 1), t_ns=20_000_000_000)
    assert [s.frame_id for s in scans] == [1]
    assert decoder.restarts == 1
    assert abs(scans[0].t_ns - 20_100_000_000) < 10_000_000, "the new sensor clock was not taken up"


def test_stuck_sensor_yields_no_scans() -> None:
    info = sensor()
    decoder = decoder_of(info)
    packets = [p for n in range(3, 8) for p in frame_packets(info, n, seed=1)]
    assert len(feed(decoder, packets)) == 1
    assert dropped(decoder) == {"frozen": 4}
    assert len(feed(decoder, frame_packets(info, 8, seed=2), t_ns=7_600_000_000)) == 1


def test_scans_in_which_nothing_comes_back_are_not_called_stuck() -> None:
    info = sensor()
    decoder = decoder_of(info)
    nothing = np.zeros((5, 512), dtype=np.uint32)
    scans = feed(decoder, [p for n in range(3) for p in frame_packets(info, n, ranges_mm=nothing)])
    assert len(scans) == 3


def test_old_firmware_without_checksum_is_read() -> None:
    info = sensor()
    bare = [p[:-8] + bytes(8) for p in frame_packets(info, 3)]
    assert len(feed(decoder_of(info), bare)) == 1


@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_no_bytes_make_the_decoder_raise(data: st.DataObject) -> None:
    info = sensor()
    packets = frame_packets(info, 3)
    decoder = decoder_of(info)
    for _ in range(5):
        packet = bytearray(data.draw(st.sampled_from(packets)))
        for _ in range(data.draw(st.integers(0, 8))):
            packet[data.draw(st.integers(0, len(packet) - 1))] = data.draw(st.integers(0, 255))
        cut = data.draw(st.one_of(st.none(), st.integers(0, len(packet))))
        decoder.receive(bytes(packet[:cut]), data.draw(st.integers(-(2**62), 2**62)), SOURCE)
    assert set(decoder.dropped) == set(DROP_REASONS)


def test_metadata_that_is_none_is_told() -> None:
    with pytest.raises(FileFormatError, match="metadata"):
        OusterDecoder('{"what": "not a sensor"}')


def test_a_scan_of_five_rows_decodes_in_a_millisecond_and_a_half() -> None:
    info = sensor()
    decoder = decoder_of(info)
    turns = [frame_packets(info, n) for n in range(30)]
    spent_s = []
    for packets in turns:
        began = time.process_time()
        feed(decoder, packets)
        spent_s.append(time.process_time() - began)
    assert sorted(spent_s)[len(spent_s) // 2] < 1.5e-3
