"""UDP payloads of a capture file: classic pcap and pcapng, fragments joined. No dependency: the formats are small.

Sources: draft-ietf-opsawg-pcap, draft-ietf-opsawg-pcapng, RFC 791 (IPv4 and its fragments), RFC 768.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from companion.errors import FileFormatError

PCAP_MAGICS = {
    b"\xd4\xc3\xb2\xa1": ("<", 1000),
    b"\xa1\xb2\xc3\xd4": (">", 1000),
    b"\x4d\x3c\xb2\xa1": ("<", 1),
    b"\xa1\xb2\x3c\x4d": (">", 1),
}  # byte order, and ns in a unit of the fraction
PCAPNG_MAGIC = b"\x0a\x0d\x0d\x0a"
_SECTION, _INTERFACE, _SIMPLE, _ENHANCED = 0x0A0D0D0A, 1, 3, 6
_ETHERNET, _RAW_IP, _NULL, _LINUX_COOKED, _LINUX_COOKED_2 = 1, 101, 0, 113, 276
_VLAN_TYPES = (0x8100, 0x88A8)
_MAX_RECORD = 1 << 20
_MAX_PARTIAL = 64  # datagrams whose fragments are awaited at once


@dataclass(frozen=True, slots=True)
class UdpPacket:
    """t_ns: time of capture, ns since 1970. source, destination: (address, port)."""

    t_ns: int
    source: tuple[str, int]
    destination: tuple[str, int]
    data: bytes


def is_capture(head: bytes) -> bool:
    """Whether a file that begins so is a pcap or pcapng."""
    return head[:4] in PCAP_MAGICS or head[:4] == PCAPNG_MAGIC


@dataclass(slots=True)
class PcapReader:
    """Iterates over the UDP packets of a capture; a cut last record ends it, what is not UDP over IPv4 is skipped.

    After iteration: `records`, `skipped` (other protocols), `incomplete` (fragments that never made a datagram),
    `is_cut` (the file ends within a record).
    Raises: FileFormatError: neither pcap nor pcapng.
    """

    path: Path
    records: int = field(init=False, default=0)
    skipped: int = field(init=False, default=0)
    incomplete: int = field(init=False, default=0)
    is_cut: bool = field(init=False, default=False)
    _partial: dict[tuple[bytes, bytes, int], dict[int, bytes]] = field(init=False, default_factory=dict)
    _ends: dict[tuple[bytes, bytes, int], int] = field(init=False, default_factory=dict)

    def __iter__(self) -> Iterator[UdpPacket]:
        data = self.path.read_bytes()
        if data[:4] in PCAP_MAGICS:
            frames = self._classic(data)
        elif data[:4] == PCAPNG_MAGIC:
            frames = self._next_generation(data)
        else:
            raise FileFormatError(
                f"{self.path}: expected a pcap or pcapng capture, it begins with {data[:4].hex() or 'nothing'}"
            )
        for t_ns, link, frame in frames:
            self.records += 1
            packet = self._udp(t_ns, link, frame)
            if packet is not None:
                yield packet
        self.incomplete += len(self._partial)

    def _classic(self, data: bytes) -> Iterator[tuple[int, int, bytes]]:
        order, unit_ns = PCAP_MAGICS[data[:4]]
        if len(data) < 24:
            raise FileFormatError(f"{self.path}: a pcap header has 24 bytes, the file has {len(data)}")
        link = struct.unpack_from(order + "I", data, 20)[0] & 0xFFFF
        record = struct.Struct(order + "IIII")
        at = 24
        while at < len(data):
            if at + 16 > len(data):
                self.is_cut = True
                return
            seconds, fraction, length, _ = record.unpack_from(data, at)
            at += 16
            if length > _MAX_RECORD or at + length > len(data):
                self.is_cut = True
                return
            yield seconds * 1_000_000_000 + fraction * unit_ns, link, data[at : at + length]
            at += length

    def _next_generation(self, data: bytes) -> Iterator[tuple[int, int, bytes]]:
        order = "<"
        interfaces: list[tuple[int, int, int]] = []  # link type, ticks a second, snap length
        at = 0
        while at + 12 <= len(data):
            if data[at : at + 4] == PCAPNG_MAGIC:
                order = "<" if data[at + 8 : at + 12] == b"\x4d\x3c\x2b\x1a" else ">"
                interfaces = []
            kind, length = struct.unpack_from(order + "II", data, at)
            if length < 12 or length % 4 or at + length > len(data):
                break
            body = data[at + 8 : at + length - 4]
            if kind == _INTERFACE and len(body) >= 8:
                link, _, snap = struct.unpack_from(order + "HHI", body)
                interfaces.append((link, _ticks_a_second(body[8:], order), snap))
            elif kind == _ENHANCED and len(body) >= 20:
                interface, high, low, captured, _ = struct.unpack_from(order + "IIIII", body)
                if interface < len(interfaces):
                    link, ticks, _ = interfaces[interface]
                    yield ((high << 32) | low) * 1_000_000_000 // ticks, link, body[20 : 20 + captured]
            elif kind == _SIMPLE and interfaces and len(body) >= 4:
                yield 0, interfaces[0][0], body[4 : 4 + struct.unpack_from(order + "I", body)[0]]
            at += length
        self.is_cut = self.is_cut or at != len(data)

    def _udp(self, t_ns: int, link: int, frame: bytes) -> UdpPacket | None:
        ip = _ip_of(link, frame)
        if ip is None or len(ip) < 20 or ip[0] >> 4 != 4 or ip[9] != 17:
            self.skipped += 1
            return None
        header = (ip[0] & 15) * 4
        total = struct.unpack_from(">H", ip, 2)[0] or len(ip)  # 0: segmentation offload, the whole frame counts
        identity, fragment = struct.unpack_from(">HH", ip, 4)
        source, destination = ip[12:16], ip[16:20]
        body: bytes | None = ip[header:total]
        if fragment & 0x3FFF and body is not None:
            body = self._join((source, destination, identity), (fragment & 0x1FFF) * 8, bool(fragment & 0x2000), body)
            if body is None:
                return None
        if body is None or len(body) < 8:
            self.skipped += 1
            return None
        source_port, destination_port, length = struct.unpack_from(">HHH", body)
        data = body[8 : length or len(body)]
        return UdpPacket(
            t_ns, (_dotted(source), source_port), (_dotted(destination), destination_port), data
        )  # fmt: skip

    def _join(self, key: tuple[bytes, bytes, int], offset: int, more: bool, part: bytes) -> bytes | None:
        """The whole datagram once all fragments are there, in whatever order they came."""
        parts = self._partial.setdefault(key, {})
        parts[offset] = part
        if not more:
            self._ends[key] = offset + len(part)
        end = self._ends.get(key)
        joined = bytearray()
        while len(joined) in parts and len(parts[len(joined)]):
            joined += parts[len(joined)]
        if end is not None and len(joined) == end:
            del self._partial[key], self._ends[key]
            return bytes(joined)
        if len(self._partial) > _MAX_PARTIAL:
            oldest = next(iter(self._partial))
            del self._partial[oldest]
            self._ends.pop(oldest, None)
            self.incomplete += 1
        return None


def _ip_of(link: int, frame: bytes) -> bytes | None:
    """The IP packet in a captured frame; None: another protocol or link type."""
    if link == _RAW_IP:
        return frame
    if link == _NULL:
        return frame[4:]
    if link == _LINUX_COOKED:
        return frame[16:] if frame[14:16] == b"\x08\x00" else None
    if link == _LINUX_COOKED_2:
        return frame[20:] if frame[:2] == b"\x08\x00" else None
    if link != _ETHERNET:
        return None
    at = 12
    while len(frame) >= at + 2 and struct.unpack_from(">H", frame, at)[0] in _VLAN_TYPES:
        at += 4
    return frame[at + 2 :] if frame[at : at + 2] == b"\x08\x00" else None


def _ticks_a_second(options: bytes, order: str) -> int:
    """if_tsresol of an interface block: powers of ten, or of two with the top bit set; a millionth by default."""
    at = 0
    while at + 4 <= len(options):
        code, length = struct.unpack_from(order + "HH", options, at)
        if code == 9 and length >= 1 and at + 5 <= len(options):
            value = options[at + 4]
            return 1 << (value & 0x7F) if value & 0x80 else 10 ** int(value)
        at += 4 + (length + 3) // 4 * 4
    return 1_000_000


def _dotted(address: bytes) -> str:
    return ".".join(str(b) for b in address)
