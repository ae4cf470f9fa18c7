"""Ouster packets to scans, sans-IO. The only file of the flight code that knows ouster-sdk.

The vendor's SDK gives the packet's layout and the beam geometry; the fields of a whole turn are then read in one step.
Facts on packets: Ouster "Sensor Data" chapter of the firmware user manual, v2.3 to v3.1.
"""

# mypy: disable-error-code="name-defined,attr-defined"
# (ouster.sdk.core re-exports its names without saying so in a way that strict type checking accepts)

from __future__ import annotations

import struct
from dataclasses import dataclass, replace

import numpy as np
from fastcrc import crc64
from numpy.typing import NDArray
from ouster.sdk import core

from companion.config import LidarConfig
from companion.errors import FileFormatError
from companion.jit import kernel
from companion.lidar.sensor_clock import SensorClock
from companion.messages import LidarGeometry, LidarScan

DROP_REASONS = ("size", "header", "checksum", "foreign", "repeated", "reordered", "frozen")
NO_CHECKSUM = (0, 0xDEADBEEF0000C0DE)  # what firmware 2.2 and 2.3 leaves there (recorded OS-0-32 and OS-1-128)
SILENCE_NS = 500_000_000  # after this without a packet, another start of the same sensor is believed
PACKET_TYPE_LIDAR = 1
FRAMES_BACK = 8  # a frame this little older than the current one is late, not a counter that started anew

_COLUMN_START = struct.Struct("<QH")  # stamp, measurement id
_CHECKSUM = struct.Struct("<Q")
CHECKSUM_SIZE = _CHECKSUM.size


def _standard_start(header_size: int) -> struct.Struct:
    """Type, frame id, 24 bits init id and 40 bits serial number; after the header, stamp and measurement id."""
    return struct.Struct(f"<HHQ{header_size - 12}xQH")


@dataclass(frozen=True, slots=True)
class _Pixel:
    """Where range and signal lie in a pixel's bytes: numpy type, byte offset; range = (word & mask) << shift, mm."""

    range_type: str
    range_mask: int
    range_shift: int
    signal_type: str
    signal_offset: int


# The strongest return's range and signal by UDP profile; low data rate profiles carry no signal: reflectivity instead.
_WIDE = _Pixel("<u4", 0x7FFFF, 0, "<u2", 6)
_NARROW = _Pixel("<u2", 0x7FFF, 3, "u1", 2)
_PIXELS = {
    "LEGACY": replace(_WIDE, range_mask=0xFFFFF),
    "RNG19_RFL8_SIG16_NIR16": _WIDE,
    "RNG19_RFL8_SIG16_NIR16_ZONE16": _WIDE,
    "RNG19_RFL8_SIG16_NIR16_DUAL": replace(_WIDE, signal_offset=8),
    "RNG15_RFL8_NIR8": _NARROW,
    "RNG15_RFL8_NIR8_DUAL": _NARROW,
    "FUSA_RNG15_RFL8_NIR8_DUAL": _NARROW,
}


def sensor_info(metadata: str | LidarConfig) -> core.SensorInfo:
    """The sensor as its metadata JSON says, or one with the configured beams where no metadata is known: then every
    beam leaves the rotation axis itself, which is up to 28 mm off for a real sensor (give its metadata).

    Raises: FileFormatError: not a metadata JSON of an Ouster sensor.
    """
    if isinstance(metadata, str):
        try:
            return core.SensorInfo(metadata)
        except (RuntimeError, ValueError) as error:
            raise FileFormatError(f"LiDAR metadata: expected the JSON of an Ouster sensor, got: {error}") from error
    info = core.SensorInfo.from_default(core.LidarMode(metadata.columns, metadata.rate_hz))
    data_format = info.format
    data_format.udp_profile_lidar = core.UDPProfileLidar.RNG19_RFL8_SIG16_NIR16
    data_format.pixels_per_column = metadata.rows
    data_format.pixel_shift_by_row = [0] * metadata.rows
    info.format = data_format
    altitudes = np.linspace(metadata.elevation_max_deg, metadata.elevation_min_deg, metadata.rows)
    info.beam_altitude_angles = altitudes.tolist()
    info.beam_azimuth_angles = [0.0] * metadata.rows
    info.beam_to_lidar_transform = np.eye(4)
    info.lidar_origin_to_beam_origin_mm = 0.0
    return info


def geometry_of(info: core.SensorInfo) -> LidarGeometry:
    """Direction and offset of every measurement, (rows, columns), in the Ouster sensor frame: z up through the lid,
    x away from the connector, origin at the foot of the housing. Staggered: a column is what was measured at one time.
    """
    lut = core.XYZLut(info, use_extrinsics=False)
    shape = (info.h, info.w, 3)
    scaled = np.asarray(lut.direction, dtype=np.float64).reshape(shape)
    directions = scaled / np.linalg.norm(scaled, axis=2, keepdims=True)
    elevation = np.radians(np.asarray(info.beam_altitude_angles, dtype=np.float64))
    return LidarGeometry(
        directions=directions,
        offsets_m=np.asarray(lut.offset, dtype=np.float64).reshape(shape).copy(),
        elevation_rad=elevation,
        horizontal_row=int(np.argmin(np.abs(elevation))),
    )


class OusterDecoder:
    """Packets in, scans out; what is not a sound packet of this sensor is dropped and counted, never raised.

    A scan completes when its last missing packet came, or when the next frame begins; columns that never came are
    told by `column_valid`. Times are the companion's, from the sensor's own stamps (SensorClock). The sensor is the
    one whose serial number the metadata says, or else the first that is heard; its address and start number
    (init id) hold until it has been silent for half a second.
    """

    def __init__(self, metadata: str | LidarConfig) -> None:
        info = sensor_info(metadata)
        profile = str(info.format.udp_profile_lidar)
        if profile not in _PIXELS:
            raise FileFormatError(f"LiDAR profile {profile}: expected one of {', '.join(_PIXELS)}")
        self.info = info
        self.geometry = geometry_of(info)
        self.dropped: dict[str, int] = dict.fromkeys(DROP_REASONS, 0)
        self.packets = 0
        self.scans = 0
        self.restarts = 0
        self.clock = SensorClock()
        self._format = core.PacketFormat.from_info(info)
        self._pixel = _PIXELS[profile]
        self._has_identity = profile != "LEGACY"
        self._columns_per_packet = int(info.format.columns_per_packet)
        self._expected_packets = int(info.format.lidar_packets_per_frame())
        self._packet_size = int(self._format.lidar_packet_size)
        empty = np.zeros(self._packet_size, np.uint8)
        self._has_checksum = self._has_identity and self._format.crc(empty) is not None
        self._header_size = int(self._format.packet_header_size)
        is_standard = info.format.header_type == core.HeaderType.STANDARD and profile != "LEGACY"
        self._standard_start = _standard_start(self._header_size) if is_standard else None
        self._width = int(info.w)
        self._max_frame_id = int(self._format.max_frame_id)
        self._period_ns = round(1e9 / (int(info.format.fps) * info.w))
        self._serial = int(info.sn or 0)
        self._init_id: int | None = None
        self._host: str | None = None
        self._t_last_ns: int | None = None
        self._sender: tuple[tuple[int, int], str | None] | None = None  # of the last packet that was ours
        self._dtype = _packet_dtype(self._format, self._pixel, info.h, profile)
        slots = -(-info.w // self._columns_per_packet)
        self._packets: list[bytes] = [bytes(self._packet_size)] * slots
        self._received = 0
        self._frame_id: int | None = None
        self._is_open = False
        self._is_restarted = False
        self._last: LidarScan | None = None
        self._decode(0)  # blank packets: compiles what decodes now, and not while packets wait
        self._packets = [b""] * slots  # of the open frame; empty where none came yet

    @classmethod
    def from_config(cls, cfg: LidarConfig) -> OusterDecoder:
        """For a sensor whose metadata is not at hand: evenly spread beams as configured."""
        return cls(cfg)

    def receive(self, packet: bytes, t_ns: int, source: tuple[str, int] | None = None) -> list[LidarScan]:
        """The scans that this datagram completes: none, one, or (a new frame's only packet) two.

        Args:
            packet: UDP payload as it came. t_ns: companion time of its arrival. source: (host, port), if known.
        """
        self.packets += 1
        if len(packet) != self._packet_size:
            return self._drop("size")
        kind, frame_id, identity, stamp, measurement = self._read_start(packet)
        if kind != PACKET_TYPE_LIDAR or measurement >= self._width:
            return self._drop("header")
        if self._has_checksum and not self._is_sound(packet):
            return self._drop("checksum")
        sender = identity, None if source is None else source[0]
        if sender != self._sender:
            if not self._is_ours(*identity, sender[1], t_ns):
                return self._drop("foreign")
            self._sender = sender
        self._t_last_ns = t_ns
        self.clock.update(stamp + (self._columns_per_packet - 1) * self._period_ns, t_ns)
        return self._place(packet, frame_id, measurement // self._columns_per_packet)

    def _drop(self, reason: str) -> list[LidarScan]:
        self.dropped[reason] += 1
        return []

    def _read_start(self, packet: bytes) -> tuple[int, int, tuple[int, int], int, int]:
        """Packet type, frame id, (init id, serial number); stamp and measurement id of the first column."""
        if self._standard_start is not None:
            kind, frame_id, identity, stamp, measurement = self._standard_start.unpack_from(packet)
            return kind, frame_id, (identity & 0xFFFFFF, identity >> 24), stamp, measurement
        fmt, array = self._format, np.frombuffer(packet, dtype=np.uint8)
        stamp, measurement = _COLUMN_START.unpack_from(packet, self._header_size)
        identity = int(fmt.init_id(array)), int(fmt.prod_sn(array))
        return PACKET_TYPE_LIDAR, int(fmt.frame_id(array)), identity, stamp, measurement

    def _is_sound(self, packet: bytes) -> bool:
        """Whether the checksum in the last eight bytes is that of all before it."""
        end = len(packet) - CHECKSUM_SIZE
        (stored,) = _CHECKSUM.unpack_from(packet, end)
        return stored in NO_CHECKSUM or stored == crc64.xz(packet[:end])

    def _is_ours(self, init_id: int, serial: int, host: str | None, t_ns: int) -> bool:
        """Whether a packet of another sender than the last one's is believed."""
        if self._serial and serial != self._serial and self._has_identity:
            return False
        is_known = init_id == self._init_id and (host is None or self._host is None or host == self._host)
        if not is_known:
            if self._t_last_ns is not None and t_ns - self._t_last_ns < SILENCE_NS:
                return False
            if self._init_id is not None and init_id != self._init_id:
                self.restarts += 1
                self._is_restarted = True
                self.clock = SensorClock()
            self._init_id = init_id
        self._serial = serial or self._serial
        self._host = host or self._host
        return True

    def _place(self, packet: bytes, frame_id: int, slot: int) -> list[LidarScan]:
        done: list[LidarScan] = []
        if frame_id != self._frame_id or self._is_restarted:
            if self._is_older(frame_id) and not self._is_restarted:
                return self._drop("reordered")
            done += self._finish()
            self._frame_id = frame_id
            self._packets = [b""] * len(self._packets)
            self._received = 0
            self._is_open, self._is_restarted = True, False
        if self._packets[slot] or not self._is_open:
            self.dropped["repeated"] += 1
            return done
        self._packets[slot] = packet
        self._received += 1
        if self._received >= self._expected_packets:
            done += self._finish()
        return done

    def _is_older(self, frame_id: int) -> bool:
        if self._frame_id is None:
            return False
        behind = (self._frame_id - frame_id) % (self._max_frame_id + 1)
        return 0 < behind <= FRAMES_BACK

    def _finish(self) -> list[LidarScan]:
        """Close the frame: its scan, unless there is none or the sensor repeats itself (FAULTS: LiDAR stuck)."""
        if not self._is_open or self._frame_id is None:
            return []
        self._is_open = False
        scan = self._decode(self._frame_id)
        last, self._last = self._last, scan
        if last is not None and _is_same(last, scan):
            return self._drop("frozen")
        self.scans += 1
        return [scan]

    def _decode(self, frame_id: int) -> LidarScan:
        column = np.frombuffer(b"".join(self._packets), dtype=self._dtype)["column"].reshape(-1)
        pixel = column["pixel"]
        range_m, signal, column_valid, stamps = _spread_columns(
            column["measurement_id"], column["status"], column["stamp"], pixel["range"], pixel["signal"],
            self._width, self._pixel.range_mask, self._pixel.range_shift,
        )  # fmt: skip
        t_column = self._fill_stamps(stamps, column_valid) + (self.clock.offset_ns or 0)
        return LidarScan(
            t_ns=int(t_column[-1]),
            frame_id=frame_id,
            t_column_ns=t_column,
            range_m=range_m,
            signal=signal,
            column_valid=column_valid,
            geometry=self.geometry,
        )

    def _fill_stamps(self, stamps: NDArray[np.int64], is_valid: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Sensor time of every column: lost ones from the nearest before (or after) at the nominal turn rate."""
        known = np.flatnonzero(is_valid)
        if len(known) == 0:
            newest = (self._t_last_ns or 0) - (self.clock.offset_ns or 0)
            return newest + (np.arange(len(stamps)) - len(stamps) + 1) * np.int64(self._period_ns)
        if len(known) == len(stamps):
            return stamps
        index = np.arange(len(stamps))
        nearest = known[np.maximum(np.searchsorted(known, index, side="right") - 1, 0)]
        filled: NDArray[np.int64] = stamps[nearest] + (index - nearest) * np.int64(self._period_ns)
        return filled


@kernel
def _spread_columns(
    measurement_id: NDArray[np.uint16],
    status: NDArray[np.unsignedinteger],
    stamp: NDArray[np.uint64],
    range_word: NDArray[np.unsignedinteger],
    signal_word: NDArray[np.unsignedinteger],
    columns: int,
    range_mask: int,
    range_shift: int,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], NDArray[np.int64]]:
    """What came of a turn, (N,) columns and (N, rows) pixels in any order, each at its own place.

    Returns: range_m, signal (rows, columns), whether a column came and its stamp in ns (columns,); 0 where it did not.
    """
    rows = range_word.shape[1]
    range_m, signal = np.zeros((rows, columns), np.float32), np.zeros((rows, columns), np.float32)
    column_valid, stamps = np.zeros(columns, np.bool_), np.zeros(columns, np.int64)
    for n in range(len(measurement_id)):
        c = int(measurement_id[n])
        if status[n] & 1 != 1 or c >= columns:
            continue
        for i in range(rows):
            range_mm = (int(range_word[n, i]) & range_mask) << range_shift
            range_m[i, c] = np.float32(range_mm) / np.float32(1000.0)
            signal[i, c] = np.float32(signal_word[n, i])
        column_valid[c] = True
        stamps[c] = np.int64(stamp[n])
    return range_m, signal, column_valid, stamps


def _is_same(a: LidarScan, b: LidarScan) -> bool:
    """Whether two scans carry the very same measurements. Noise of range and signal makes that impossible in life; two
    scans in which nothing came back are not counted."""
    return bool(np.array_equal(a.range_m, b.range_m) and np.array_equal(a.signal, b.signal) and np.any(b.range_m))


def _packet_dtype(fmt: core.PacketFormat, pixel: _Pixel, rows: int, profile: str) -> np.dtype[np.void]:
    """A packet as a numpy record, from the sizes that the SDK states."""
    is_legacy = profile == "LEGACY"
    pixel_size = (fmt.col_size - fmt.col_header_size - fmt.col_footer_size) // rows
    pixel_type = np.dtype(
        {
            "names": ["range", "signal"],
            "formats": [pixel.range_type, pixel.signal_type],
            "offsets": [0, pixel.signal_offset],
            "itemsize": pixel_size,
        }
    )
    status_offset = fmt.col_size - fmt.col_footer_size if is_legacy else 10  # legacy: all ones in the column's footer
    column_type = np.dtype(
        {
            "names": ["stamp", "measurement_id", "status", "pixel"],
            "formats": ["<u8", "<u2", "<u4" if is_legacy else "<u2", (pixel_type, (rows,))],
            "offsets": [0, 8, status_offset, fmt.col_header_size],
            "itemsize": fmt.col_size,
        }
    )
    return np.dtype(
        {
            "names": ["column"],
            "formats": [(column_type, (fmt.columns_per_packet,))],
            "offsets": [fmt.packet_header_size],
            "itemsize": fmt.lidar_packet_size,
        }
    )
