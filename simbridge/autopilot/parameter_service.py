"""The parameter protocol: list, read, set, and PX4's errors."""

from __future__ import annotations

import math
import struct
from collections import deque
from typing import Any

from simbridge.autopilot import params
from simbridge.autopilot.params import (
    HASH_NAME,
    INDEX,
    INT32,
    NAMES,
    REAL32,
    ParamStore,
    from_float,
    to_float,
    wire_type,
)
from simbridge.autopilot.server import Link

DOES_NOT_EXIST, TYPE_MISMATCH = 1, 7  # MAV_PARAM_ERROR, as PX4 uses them
TOLD_AGAIN_NS = 6_000_000  # PX4 reports a change once more from its own notification


class ParameterService:
    """Answers on the link that asked; tells every link of changes."""

    def __init__(self, store: ParamStore, links: list[Link]) -> None:
        self._store = store
        self._links = links
        self._again: deque[tuple[int, str]] = deque()

    def step(self, t_ns: int) -> None:
        """Send the second notice of changes that is due."""
        if not self._again or self._again[0][0] > t_ns:
            return
        names = sorted(name for _, name in self._again)
        self._again.clear()
        for link in self._links:
            for name in names:
                self.send_value(link, name)

    def send_value(self, link: Link, name: str) -> None:
        """One PARAM_VALUE."""
        count = len(NAMES)
        if name == HASH_NAME:
            value = struct.unpack("<f", struct.pack("<I", self._store.hash()))[0]
            kind, index = params.UINT32, 65535
        else:
            value, kind, index = to_float(self._store.value(name)), wire_type(name), INDEX[name]
        link.send(
            "PARAM_VALUE", param_id=name, param_value=value, param_type=kind, param_count=count, param_index=index
        )

    def list_all(self, link: Link) -> None:
        """PARAM_REQUEST_LIST: the hash first, then all, a few with each step."""
        link.params_left.clear()
        if self._store.integer("MAV_HASH_CHK_EN"):
            link.params_left.append(HASH_NAME)
        link.params_left.extend(NAMES)

    def read(self, link: Link, f: dict[str, Any], system: int, component: int) -> None:
        """PARAM_REQUEST_READ by name or index."""
        name = f["param_id"] if f["param_index"] < 0 else ""
        if not name and 0 <= f["param_index"] < len(NAMES):
            name = NAMES[f["param_index"]]
        if name == HASH_NAME or name in self._store:
            self.send_value(link, name)
        else:
            self._error(link, f["param_id"], DOES_NOT_EXIST, system, component)

    def set(self, link: Link, f: dict[str, Any], system: int, component: int, t_ns: int) -> None:
        """PARAM_SET: answered by the value, and told again a little later if it changed."""
        name, kind = f["param_id"], f["param_type"]
        if name == HASH_NAME:
            return
        if name not in self._store:
            self._error(link, name, DOES_NOT_EXIST, system, component)
            return
        value = from_float(f["param_value"], kind)
        if kind != wire_type(name) or kind not in (INT32, REAL32) or not math.isfinite(value):
            self._error(link, name, TYPE_MISMATCH, system, component)
            return
        if value != self._store.value(name):
            self._store.set(name, value)
            self._again = deque(entry for entry in self._again if entry[1] != name)
            self._again.append((t_ns + TOLD_AGAIN_NS, name))
        self.send_value(link, name)

    @staticmethod
    def _error(link: Link, name: str, error: int, system: int, component: int) -> None:
        link.send(
            "PARAM_ERROR", param_id=name, param_index=-1, error=error, target_system=system, target_component=component
        )
