"""Python's search for reference cycles, out of the way of what must go on: it stops everything for as long as it looks."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from contextlib import contextmanager

YOUNG = 50_000  # objects more than were freed, before the young ones are looked through; Python's own: 700


@contextmanager
def collected_seldom() -> Iterator[None]:
    """Within: what is there already is not looked through, and what comes is only after many thousand objects.

    A flight makes next to no cycles (reference counts free what it drops), yet keeps every estimate and event, and to look
    through all of them takes longer the longer it flies.
    """
    before = gc.get_threshold()
    gc.freeze()
    gc.set_threshold(YOUNG, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)
        gc.unfreeze()
