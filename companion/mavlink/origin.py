"""The EKF origin: asked for first, set only where there is none, and repeated until GPS_GLOBAL_ORIGIN comes back.

SET_GPS_GLOBAL_ORIGIN has no acknowledgement and ArduPilot drops it while its EKF starts. PX4 must have it before the
first vision sample: set while vision is fused, the local position jumps by thousands of kilometres. Altitude 0: with
vision as height reference PX4 takes the height of vision for absolute altitude (PX4.md, 6 and 7).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from companion.mavlink import wire

ASK_PERIOD_NS = 500_000_000
ASK_TRIES = 3
SET_PERIOD_NS = 1_000_000_000


class OriginState(Enum):
    ASKING = "asking"
    SETTING = "setting"
    CONFIRMED = "confirmed"


class OriginAction(Enum):
    ASK = "ask"
    SET = "set"


@dataclass(slots=True)
class Origin:
    """latitude_e7, longitude_e7: 1e-7 degrees. confirmed_e7: what the autopilot says, (lat, lon, altitude in mm)."""

    latitude_e7: int
    longitude_e7: int
    state: OriginState = OriginState.ASKING
    confirmed_e7: tuple[int, int, int] | None = None
    t_next_ns: int = 0
    _asked: int = 0
    sent: int = 0

    def restart(self, t_ns: int) -> None:
        self.state = OriginState.ASKING
        self.confirmed_e7 = None
        self._asked = 0
        self.sent = 0
        self.t_next_ns = t_ns

    def on_origin(self, latitude_e7: int, longitude_e7: int, altitude_mm: int) -> bool:
        """GPS_GLOBAL_ORIGIN came. True when this is news."""
        is_news = self.state is not OriginState.CONFIRMED
        self.state = OriginState.CONFIRMED
        self.confirmed_e7 = (latitude_e7, longitude_e7, altitude_mm)
        return is_news

    def poll(self, t_ns: int, *, may_set: bool) -> OriginAction | None:
        """What to send now. may_set: on the ground, disarmed, and the estimator holds no horizontal position yet."""
        if self.state is OriginState.CONFIRMED or t_ns < self.t_next_ns:
            return None
        if self.state is OriginState.ASKING and self._asked < ASK_TRIES:
            self._asked += 1
            self.t_next_ns = t_ns + ASK_PERIOD_NS
            return OriginAction.ASK
        self.state = OriginState.SETTING
        self.t_next_ns = t_ns + (SET_PERIOD_NS if may_set else ASK_PERIOD_NS)
        if not may_set:
            return OriginAction.ASK
        self.sent += 1
        return OriginAction.SET

    def payload(self, target_system: int, t_ns: int) -> bytes:
        """SET_GPS_GLOBAL_ORIGIN with altitude 0."""
        return wire.pack(
            wire.SET_GPS_GLOBAL_ORIGIN, self.latitude_e7, self.longitude_e7, 0, target_system, t_ns // 1000
        )
