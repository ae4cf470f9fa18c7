"""Capture files: byte orders, resolutions, fragments, cuts."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.errors import FileFormatError
from companion.lidar.pcap import PcapReader
from tests.shared_data import shared_data


def ip(body: bytes, *, identity: int = 1, fragment: int = 0) -> bytes:
    header = struct.pack(
        ">BBHHHBBH4s4s", 0x45, 0, 20 + len(body), identity, fragment, 64, 17, 0, b"\x0a\0\0\1", b"\x0a\0\0\2"
    )
    return bytes(12) + b"\x08\x00" + header + body


def udp(data: bytes) -> bytes:
    return struct.pack(">HHHH", 7000, 7502, 8 + len(data), 0) + data


def fragments(data: bytes, size: int, identity: int = 1) -> list[bytes]:
    body = udp(data)
    offsets = range(0, len(body), size)
    return [
        ip(body[at : at + size], identity=identity, fragment=at // 8 | (0x2000 if at + size < len(body) else 0))
        for at in offsets
    ]


def classic(frames: list[bytes], order: str = "<", ns: bool = False, link: int = 1, step_us: int = 10**6) -> bytes:
    magic = 0xA1B23C4D if ns else 0xA1B2C3D4
    out = struct.pack(order + "IHHiIII", magic, 2, 4, 0, 0, 65535, link)
    for n, frame in enumerate(frames):
        seconds, fraction = divmod(n * step_us, 10**6)
        out += struct.pack(order + "IIII", 100 + seconds, 5 + fraction, len(frame), len(frame)) + frame
    return out


def block(order: str, kind: int, body: bytes) -> bytes:
    body += bytes(-len(body) % 4)
    length = len(body) + 12
    return struct.pack(order + "II", kind, length) + body + struct.pack(order + "I", length)


def next_generation(frames: list[bytes], order: str = "<", resolution: int | None = 9) -> bytes:
    option = b"" if resolution is None else struct.pack(order + "HHB3xHH", 9, 1, resolution, 0, 0)
    out = block(order, 0x0A0D0D0A, struct.pack(order + "IHHq", 0x1A2B3C4D, 1, 0, -1))
    out += block(order, 1, struct.pack(order + "HHI", 1, 0, 65535) + option)
    for n, frame in enumerate(frames):
        ticks = (100 + n) * (10**9 if resolution == 9 else 10**6) + 5
        head = struct.pack(order + "IIIII", 0, ticks >> 32, ticks & 0xFFFFFFFF, len(frame), len(frame))
        out += block(order, 6, head + frame)
    return out


def read(tmp_path: Path, data: bytes) -> tuple[PcapReader, list]:
    path = tmp_path / "capture"
    path.write_bytes(data)
    reader = PcapReader(path)
    return reader, list(reader)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("ns", [False, True])
def test_classic_captures_of_both_byte_orders_and_resolutions_are_read(tmp_path: Path, order: str, ns: bool) -> None:
    _, packets = read(tmp_path, classic([ip(udp(b"one")), ip(udp(b"two"))], order, ns))
    assert [p.data for p in packets] == [b"one", b"two"]
    assert [p.t_ns for p in packets] == [100_000_000_000 + (5 if ns else 5000), 101_000_000_000 + (5 if ns else 5000)]
    assert packets[0].source == ("10.0.0.1", 7000)
    assert packets[0].destination == ("10.0.0.2", 7502)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("resolution", "t_ns"), [(9, 100_000_000_005), (None, 100_000_005_000)])
def test_next_generation_captures_are_read(tmp_path: Path, order: str, resolution: int | None, t_ns: int) -> None:
    reader, packets = read(tmp_path, next_generation([ip(udp(b"one"))], order, resolution))
    assert [(p.data, p.t_ns) for p in packets] == [(b"one", t_ns)]
    assert not reader.is_cut


@given(st.permutations(range(6)), st.sampled_from([8, 504, 1480]))
def test_fragments_are_joined_in_whatever_order_they_come(order: list[int], size: int) -> None:
    data = bytes(range(256)) * (size * 6 // 256)
    parts = fragments(data[: size * 5 + 3], size)
    order = [n for n in order if n < len(parts)] + list(range(6, len(parts)))
    reader = PcapReader(Path("unused"))
    packets = [p for p in (reader._udp(0, 1, parts[n]) for n in order) if p is not None]
    assert [p.data for p in packets] == [data[: size * 5 + 3]]


def test_fragments_of_two_datagrams_are_kept_apart(tmp_path: Path) -> None:
    a, b = fragments(b"a" * 3000, 1480, identity=1), fragments(b"b" * 3000, 1480, identity=2)
    _, packets = read(tmp_path, classic([f for pair in zip(a, b, strict=True) for f in pair]))
    assert [p.data for p in packets] == [b"a" * 3000, b"b" * 3000]


def test_lost_fragment_is_counted(tmp_path: Path) -> None:
    parts = fragments(b"a" * 3000, 1480)
    reader, packets = read(tmp_path, classic([parts[0], parts[2], ip(udp(b"whole"), identity=9)]))
    assert [p.data for p in packets] == [b"whole"]
    assert reader.incomplete == 1


def test_vlan_tags_and_other_protocols_are_told_apart(tmp_path: Path) -> None:
    plain = ip(udp(b"x"))
    tagged = plain[:12] + b"\x81\x00\x00\x05" + plain[12:]
    arp = bytes(12) + b"\x08\x06" + bytes(28)
    reader, packets = read(tmp_path, classic([tagged, arp]))
    assert [p.data for p in packets] == [b"x"]
    assert reader.skipped == 1


@pytest.mark.parametrize("make", [classic, next_generation])
def test_capture_cut_anywhere_gives_what_came_before(tmp_path: Path, make) -> None:
    whole = make([ip(udp(b"one")), ip(udp(b"two"))])
    for cut in range(24, len(whole)):
        try:
            _, packets = read(tmp_path, whole[:cut])
        except FileFormatError:
            continue
        assert [p.data for p in packets] in ([], [b"one"], [b"one", b"two"])


def test_what_is_no_capture_is_told(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match="pcap"):
        read(tmp_path, b"nothing of the kind")


def test_recorded_capture_holds_what_it_should() -> None:
    packets = list(PcapReader(shared_data("ouster", "OS-1-128_v2.3.0_1024x10_lb_n3.pcap")))
    assert sum(len(p.data) == 8448 for p in packets) == 192
    assert packets[0].t_ns == 1_650_410_295_350_216_000
