"""Reads the parameters of the manifest from the autopilot, so that what is wrong stands against arming (FAULTS 26)."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable

from companion.mavlink import wire
from companion.mavlink.checks import Facts, Verdict, check_parameters
from companion.mavlink.manifest import MANIFESTS

RETRY_NS = 500_000_000
TRIES = 5
_WINDOW = 6  # questions on the wire at a time
_REAL32 = 9  # MAV_PARAM_TYPE
_BY_NAME = -1


class Parameters:
    """`values` by name; None: the autopilot does not have it, or does not answer. ask: sends PARAM_REQUEST_READ."""

    def __init__(self, ask: Callable[[bytes], None], target_system: int) -> None:
        self._ask = ask
        self._system = target_system
        self._open: dict[str, tuple[int, int]] = {}  # name -> tries, time of the next
        self._waiting: list[str] = []
        self._autopilot = ""
        self._is_bytewise = False
        self._reasons: tuple[str, ...] | None = None
        self.values: dict[str, float | None] = {}

    def restart(self, autopilot: str, *, is_bytewise: bool) -> None:
        """Begin to read anew. is_bytewise: integers lie in the float's bytes (PX4), else they are cast (ArduPilot)."""
        self._autopilot, self._is_bytewise = autopilot, is_bytewise
        names = [name for e in MANIFESTS[autopilot].parameters for name in (e.name, *e.other_names)]
        self._waiting = list(dict.fromkeys(names))
        self._open.clear()
        self.values.clear()
        self._reasons = None

    def poll(self, t_ns: int) -> None:
        for name, (tries, t_next_ns) in list(self._open.items()):
            if t_next_ns > t_ns:
                continue
            if tries < TRIES:
                self._request(name, tries, t_ns)
            else:
                self._take(name, None)
        while self._waiting and len(self._open) < _WINDOW:
            self._request(self._waiting.pop(0), 0, t_ns)

    def next_deadline_ns(self, t_ns: int) -> int | None:
        if self._waiting and len(self._open) < _WINDOW:
            return t_ns
        return min(t for _, t in self._open.values()) if self._open else None

    def _request(self, name: str, tries: int, t_ns: int) -> None:
        self._open[name] = (tries + 1, t_ns + RETRY_NS)
        self._ask(
            wire.pack(
                wire.PARAM_REQUEST_READ, _BY_NAME, self._system, wire.COMP_AUTOPILOT, name.encode().ljust(16, b"\0")
            )
        )

    def on_value(self, payload: bytes) -> None:
        """PARAM_VALUE: our answer, or one that came unasked because somebody changed it."""
        raw, _, _, param_id, param_type = wire.unpack(wire.PARAM_VALUE, payload)
        name = param_id.split(b"\0")[0].decode("ascii", errors="replace")
        if name in self._open or name in self.values:
            self._take(name, self._decode(payload, raw, param_type))

    def on_error(self, payload: bytes) -> None:
        """PARAM_ERROR: PX4 does not have it. (ArduPilot gives no answer at all.)"""
        param_id = wire.unpack(wire.PARAM_ERROR, payload)[3]
        name = param_id.split(b"\0")[0].decode("ascii", errors="replace")
        if name in self._open:
            self._take(name, None)

    def _decode(self, payload: bytes, raw: float, param_type: int) -> float | None:
        if self._is_bytewise and param_type != _REAL32:
            (number,) = struct.unpack("<i", payload[:4].ljust(4, b"\0"))
            return float(number)
        return float(raw) if math.isfinite(raw) else None

    def _take(self, name: str, value: float | None) -> None:
        self._open.pop(name, None)
        self.values[name] = value
        self._reasons = None

    @property
    def is_read(self) -> bool:
        return bool(self._autopilot) and not self._open and not self._waiting

    def reasons(self) -> tuple[str, ...]:
        """What of the parameters stands against arming: each with what is expected, why, and how to mend it."""
        if not self.is_read:
            left = len(self._open) + len(self._waiting)
            return (f"parameters: being read, {left} to go",)
        if self._reasons is None:
            self._reasons = self._judge()
        return self._reasons

    def _judge(self) -> tuple[str, ...]:
        if all(value is None for value in self.values.values()):
            return ("parameters: the autopilot answers no request for one: does the link carry both ways?",)
        checks = check_parameters(Facts(autopilot=self._autopilot, parameters=self.values))
        return tuple(
            f"{check.name}: is {check.actual}, expected {check.expected}: {check.why}. {check.mend}"
            for check in checks
            if check.verdict is Verdict.FAIL
        )
