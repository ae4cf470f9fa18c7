"""Random streams by name: what one part draws never shifts what another part gets."""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray

BLOCK = 256


def stream(seed: int, name: str) -> np.random.Generator:
    """The Generator of that name, the same for the same seed on every machine."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=(zlib.crc32(name.encode()),))))


class Normals:
    """Standard normal vectors of one width, drawn in blocks: a draw a step would cost more than the physics."""

    def __init__(self, rng: np.random.Generator, width: int) -> None:
        self._rng, self._width = rng, width
        self._block, self._next = rng.standard_normal((BLOCK, width)), 0

    def draw(self) -> NDArray[np.float64]:
        """(width,), not to be changed by the caller."""
        if self._next == BLOCK:
            self._block, self._next = self._rng.standard_normal((BLOCK, self._width)), 0
        row: NDArray[np.float64] = self._block[self._next]
        self._next += 1
        return row
