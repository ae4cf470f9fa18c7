"""CRC-64 as Ouster's packets carry it (CRC-64/XZ: polynomial of ECMA-182, reflected), eight bytes at a time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from companion.jit import kernel

_POLYNOMIAL = 0xC96C5795D7870F42  # ECMA-182, bits reversed


def _tables() -> NDArray[np.uint64]:
    """(8, 256): what a byte does to the checksum when 0 to 7 more bytes follow it."""
    tables = np.zeros((8, 256), np.uint64)
    for byte in range(256):
        value = byte
        for _ in range(8):
            value = (value >> 1) ^ (_POLYNOMIAL if value & 1 else 0)
        tables[0, byte] = value
    for k in range(1, 8):
        tables[k] = (tables[k - 1] >> np.uint64(8)) ^ tables[0, (tables[k - 1] & np.uint64(0xFF)).astype(np.intp)]
    return tables


TABLES = _tables()


@kernel
def crc64(data: NDArray[np.uint8], end: int, tables: NDArray[np.uint64]) -> np.uint64:
    """Checksum of the first `end` bytes. tables: TABLES."""
    one, low = np.uint64(8), np.uint64(0xFF)
    crc = np.uint64(0xFFFFFFFFFFFFFFFF)
    at = 0
    while at + 8 <= end:
        word = np.uint64(0)
        for k in range(8):
            word |= np.uint64(data[at + k]) << np.uint64(8 * k)
        crc ^= word
        mixed = np.uint64(0)
        for k in range(8):
            mixed ^= tables[7 - k, (crc >> np.uint64(8 * k)) & low]
        crc = mixed
        at += 8
    while at < end:
        crc = tables[0, (crc ^ np.uint64(data[at])) & low] ^ (crc >> one)
        at += 1
    return ~crc
