"""One way to compile kernels, so that every one of them is deterministic to the last bit."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

import numba

P = ParamSpec("P")
T = TypeVar("T")


def kernel(function: Callable[P, T]) -> Callable[P, T]:
    """Compile with numba: cached on disk, one thread, no fast-math (sums keep their order)."""
    compiled = numba.njit(cache=True, parallel=False, fastmath=False, nogil=True)(function)
    return cast(Callable[P, T], compiled)
