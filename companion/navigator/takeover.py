"""Whether the vehicle is ours to command: on the ground (may it fly) and in the air (does it still listen to us)."""

from __future__ import annotations

from dataclasses import dataclass

from companion.messages import FlightMode, LandedState
from companion.navigator.interface import NavigatorInput, NavigatorState
from companion.navigator.situation import Situation

READY_FOR_NS = 1_000_000_000
TELL_EVERY_NS = 2_000_000_000  # at most, of what forbids arming
LINK_LOST_NS = 3_000_000_000
LANDING_MODES = frozenset({FlightMode.LAND, FlightMode.DESCEND})


@dataclass(frozen=True, slots=True)
class Loss:
    """Control has ended: as wished (landed), before it began (failure), or else somebody took it."""

    outcome: str
    why: str
    is_landed: bool = False
    is_failure: bool = False


def not_ready(now: Situation, inputs: NavigatorInput) -> tuple[str, ...]:
    """Everything that forbids arming, in words; empty when nothing does."""
    why, vehicle = list(inputs.not_ready_because), now.vehicle
    if vehicle is None or not vehicle.is_connected:
        why.append("the flight controller is not heard")
    elif not vehicle.is_ready_to_arm:
        why += vehicle.not_ready_because or ("the flight controller is not ready",)
    if not inputs.time_synced:
        why.append("the clocks are not synchronised")
    if not now.vision.is_good:
        why.append(now.vision.why)
    return tuple(why)


class Readiness:
    """Ready means ready and seeing for READY_FOR_NS without a break."""

    def __init__(self) -> None:
        self._told: set[str] = set()  # the kinds of reasons that people were told last
        self._told_ns: int | None = None
        self._since_ns: int | None = None

    def note(self, now: Situation, inputs: NavigatorInput) -> str:
        """What forbids arming, for people, when that has changed: not just how much is missing, and not each of the many
        changes in the first second; else empty."""
        why = not_ready(now, inputs)
        if not why:
            self._told, self._since_ns = set(), now.t_ns if self._since_ns is None else self._since_ns
            return ""
        self._since_ns = None
        kinds = {reason.partition(":")[0] for reason in why}
        if kinds == self._told or (self._told_ns is not None and now.t_ns - self._told_ns < TELL_EVERY_NS):
            return ""
        self._told, self._told_ns = kinds, now.t_ns
        return "not ready: " + "; ".join(why)

    def is_ready(self, now: Situation) -> bool:
        return self._since_ns is not None and now.t_ns - self._since_ns >= READY_FOR_NS


def control_lost(now: Situation, state: NavigatorState, *, land_asked: bool) -> Loss | None:
    """None while the vehicle flies as we ask. The pilot's word shows in the mode, a reboot in that it is disarmed."""
    vehicle = now.vehicle
    if vehicle is None or not vehicle.is_connected or now.t_ns - vehicle.t_heartbeat_ns > LINK_LOST_NS:
        return Loss("link_lost", "the flight controller is not heard")
    if not vehicle.is_armed:
        if land_asked:
            return Loss("", "", is_landed=True)
        if state is NavigatorState.CLIMB and vehicle.landed_state is LandedState.ON_GROUND:
            return Loss("disarmed", "the flight controller disarmed before take-off", is_failure=True)
        return Loss("disarmed", "the flight controller disarmed or rebooted in flight")
    if vehicle.mode is FlightMode.OFFBOARD:
        return None
    if land_asked and vehicle.mode in LANDING_MODES:
        return None
    if state is NavigatorState.ABORTING and vehicle.mode is not FlightMode.MANUAL:
        return None
    who = "the flight controller's failsafe" if vehicle.is_failsafe else "the pilot or the ground station"
    return Loss("taken_over", f"{who} chose {vehicle.mode.value}")
