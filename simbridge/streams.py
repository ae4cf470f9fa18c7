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
    """Normal vectors of one width, drawn in blocks: a draw a step would cost more than the physics."""

    def __init__(
        self,
        rng: np.random.Generator,
        width: int,
        sigma: NDArray[np.float64] | float = 1.0,
        mean: NDArray[np.float64] | float = 0.0,
    ) -> None:
        """sigma, mean: of each component."""
        self._rng, self._width, self._sigma, self._mean = rng, width, sigma, mean
        self._refill()

    def draw(self) -> NDArray[np.float64]:
        """(width,), not to be changed by the caller."""
        if self._next == BLOCK:
            self._refill()
        row: NDArray[np.float64] = self._block[self._next]
        self._next += 1
        return row

    def _refill(self) -> None:
        self._block = self._mean + self._sigma * self._rng.standard_normal((BLOCK, self._width))
        self._next = 0
