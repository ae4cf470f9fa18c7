"""What goes into the navigator and what comes out."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from companion.messages import (
    Event,
    OdometryEstimate,
    OperatorCommand,
    Setpoint,
    VehicleRequest,
    VehicleState,
    WallRanges,
)


class NavigatorState(Enum):
    """Where the mission is. The order of the first eight is that of a flight without trouble."""

    WAIT_READY = "wait_ready"
    ARMING = "arming"
    CLIMB = "climb"
    FIND_WALL = "find_wall"
    FOLLOW = "follow"
    RETURN = "return"
    LAND = "land"
    DONE = "done"
    HOLDING = "holding"  # vision is poor or the operator said so: zero velocity, then on as before
    ABORTING = "aborting"  # latched: zero velocity, land
    ABORTED = "aborted"
    INTERRUPTED = "interrupted"  # the pilot or the flight controller took over: nothing is streamed
    FAILED = "failed"


IN_FLIGHT = frozenset(
    {
        NavigatorState.CLIMB,
        NavigatorState.FIND_WALL,
        NavigatorState.FOLLOW,
        NavigatorState.RETURN,
        NavigatorState.LAND,
        NavigatorState.HOLDING,
        NavigatorState.ABORTING,
    }
)
FINISHED = frozenset({NavigatorState.DONE, NavigatorState.ABORTED, NavigatorState.FAILED})


@dataclass(frozen=True, slots=True, kw_only=True)
class NavigatorInput:
    """The newest of everything. `commands`: those that arrived since the last step. `time_synced`: the flight
    controller's clock is known. `not_ready_because`: what else forbids arming (parameters, disk), for people. `sent`:
    the setpoint that left after the step before; None when none did."""

    estimate: OdometryEstimate | None
    walls: WallRanges | None
    vehicle: VehicleState | None
    commands: tuple[OperatorCommand, ...] = ()
    time_synced: bool = True
    not_ready_because: tuple[str, ...] = ()
    sent: Setpoint | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class NavigatorOutput:
    """What shall be done now.

    setpoint: None when the companion must not stream (before arming, after the pilot took over).
    is_straight: following a straight wall, not turning. progress_ratio: of the laps, by angle gone round.
    outcome: "completed", or in one word why not; "" while flying. reason: the same for people.
    lands_blind: it lands where it is, since nothing holds its position.
    """

    setpoint: Setpoint | None
    requests: tuple[VehicleRequest, ...]
    events: tuple[Event, ...]
    state: NavigatorState
    lap_closed: bool
    finished: bool
    is_straight: bool
    progress_ratio: float
    path_length_m: float
    outcome: str
    reason: str
    lands_blind: bool
