"""How flight is asked for: stream first, then OFFBOARD, then arm; each asked again a few times, then given up."""

from __future__ import annotations

from enum import Enum

from companion.messages import FlightMode, RequestKind, VehicleState

STREAM_FIRST_NS = 1_000_000_000  # PX4 wants the stream to be there; half its 2 Hz rule would do
OFFBOARD_EVERY_NS = 2_000_000_000  # the mode shows in the heartbeat, once a second
ARM_EVERY_NS = 2_000_000_000  # ArduPilot's estimators agree only after up to 24 s
MAX_OFFBOARD_REQUESTS = 15
MAX_ARM_REQUESTS = 20


class Progress(Enum):
    GOING_ON = "going on"
    READY = "ready"
    GIVEN_UP = "given up"


class Handshake:
    """One attempt to get control. `may_arm` False: only take OFFBOARD of a vehicle that flies already."""

    def __init__(self, t_ns: int, *, may_arm: bool) -> None:
        self._may_arm = may_arm
        self._start_ns = t_ns
        self._next_offboard_ns = t_ns + STREAM_FIRST_NS
        self._next_arm_ns = t_ns + STREAM_FIRST_NS
        self._offboards = 0
        self._arms = 0

    def step(self, t_ns: int, vehicle: VehicleState) -> tuple[RequestKind | None, Progress]:
        """What to ask now, and how it stands."""
        if vehicle.mode is not FlightMode.OFFBOARD:
            if t_ns < self._next_offboard_ns:
                return None, Progress.GOING_ON
            if self._offboards >= MAX_OFFBOARD_REQUESTS:
                return None, Progress.GIVEN_UP
            self._offboards += 1
            self._next_offboard_ns = t_ns + OFFBOARD_EVERY_NS
            return RequestKind.OFFBOARD, Progress.GOING_ON
        if vehicle.is_armed:
            return None, Progress.READY
        if not self._may_arm or self._arms >= MAX_ARM_REQUESTS:
            return None, Progress.GIVEN_UP
        if t_ns < self._next_arm_ns:
            return None, Progress.GOING_ON
        self._arms += 1
        self._next_arm_ns = t_ns + ARM_EVERY_NS
        return RequestKind.ARM, Progress.GOING_ON
