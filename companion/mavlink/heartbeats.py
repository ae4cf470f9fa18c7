"""Heartbeats of the companion (191) and of its estimator (197), gated on signs of life: a heartbeat that keeps coming
from a hung program lies."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

from companion.mavlink import wire
from companion.messages import OdometryEstimate

PERIOD_NS = 1_000_000_000
MAX_AGE_NS = 1_000_000_000
WEAK_SCAN_AGE_NS = 300_000_000  # FAULTS 1: 197 turns CRITICAL
FAILED_AGE_NS = 2_000_000_000
HUNG_AGE_NS = 5_000_000_000
_MAVLINK_VERSION = 3


class SystemStatus(IntEnum):
    """MAV_STATE."""

    STANDBY = 3
    ACTIVE = 4
    CRITICAL = 5
    FLIGHT_TERMINATION = 8


@dataclass(slots=True)
class SignsOfLife:
    """Newest time of each stream; None before it began: only then may it be missing."""

    t_scan_ns: int | None = None
    t_estimate_ns: int | None = None
    t_setpoint_ns: int | None = None
    quality: int = 0
    is_degenerate: bool = False
    is_flying_offboard: bool = False

    def note_scan(self, t_ns: int) -> None:
        self.t_scan_ns = t_ns if self.t_scan_ns is None else max(t_ns, self.t_scan_ns)

    def note_estimate(self, estimate: OdometryEstimate) -> None:
        self.note_scan(estimate.t_scan_ns)
        self.t_estimate_ns = estimate.t_ns
        self.quality, self.is_degenerate = estimate.quality, estimate.is_degenerate

    def stale(self, t_ns: int) -> list[str]:
        """Which streams have begun and then stood still for a second. Setpoints are awaited only in offboard flight."""
        streams = [("scan", self.t_scan_ns), ("estimate", self.t_estimate_ns)]
        if self.is_flying_offboard:
            streams.append(("setpoint", self.t_setpoint_ns))
        return [name for name, t in streams if t is not None and t_ns - t > MAX_AGE_NS]

    def is_hung(self, t_ns: int) -> bool:
        """Whatever had begun stands still."""
        times = [t for t in (self.t_scan_ns, self.t_estimate_ns, self.t_setpoint_ns) if t is not None]
        return bool(times) and t_ns - max(times) > HUNG_AGE_NS

    def estimator_status(self, t_ns: int) -> SystemStatus:
        if self.t_estimate_ns is None:
            return SystemStatus.STANDBY
        estimate_age = t_ns - self.t_estimate_ns
        if self.quality < 0 or estimate_age > FAILED_AGE_NS:
            return SystemStatus.FLIGHT_TERMINATION
        scan_age = t_ns - (self.t_scan_ns if self.t_scan_ns is not None else t_ns)
        if self.is_degenerate or max(scan_age, estimate_age) > WEAK_SCAN_AGE_NS:
            return SystemStatus.CRITICAL
        return SystemStatus.ACTIVE


class Heartbeats:
    """1 Hz of both components, or silence."""

    def __init__(self) -> None:
        self.t_next_ns = 0
        self.withheld = 0

    def poll(self, signs: SignsOfLife, t_ns: int) -> list[tuple[int, bytes]]:
        """(component, HEARTBEAT payload) due now. 191 stops when any stream stands still. 197 goes on telling that
        the estimate is weak or failed, and stops when everything stands still: then it is the program that hangs."""
        if t_ns < self.t_next_ns:
            return []
        is_late = t_ns - self.t_next_ns >= PERIOD_NS
        self.t_next_ns = (t_ns if is_late else self.t_next_ns) + PERIOD_NS
        out: list[tuple[int, bytes]] = []
        if not signs.stale(t_ns):
            out.append((wire.COMP_COMPANION, _payload(SystemStatus.ACTIVE)))
        else:
            self.withheld += 1
        if not signs.is_hung(t_ns):
            out.append((wire.COMP_ESTIMATOR, _payload(signs.estimator_status(t_ns))))
        return out


def _payload(status: SystemStatus) -> bytes:
    kind = wire.TYPE_ONBOARD_CONTROLLER
    return wire.pack(wire.HEARTBEAT, 0, kind, wire.AUTOPILOT_INVALID, 0, status, _MAVLINK_VERSION)
