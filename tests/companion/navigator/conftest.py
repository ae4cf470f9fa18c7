"""A flight stopped in each state, so that each loss can be tried in each."""

from __future__ import annotations

import copy
from collections.abc import Callable

import pytest

from companion.config import CompanionConfig
from companion.messages import OperatorCommand, OperatorCommandKind
from companion.navigator import NavigatorState
from tests.companion.navigator.halls import HALLS, Hall, Rig

S = NavigatorState
IN_THE_AIR = [S.CLIMB, S.FIND_WALL, S.FOLLOW, S.RETURN, S.LAND, S.HOLDING]


@pytest.fixture(scope="session")
def flights() -> dict[NavigatorState, Rig]:
    """Home again after a minute instead of a lap: the states are the same."""
    config = CompanionConfig.model_validate({"navigator": {"max_flight_time_s": 60.0, "height_m": 5.0}})
    rig = Rig(Hall(HALLS["cement_store"]), (12.0, 8.0, 0.7), config)
    kept: dict[NavigatorState, Rig] = {}
    for state in (S.WAIT_READY, S.ARMING, S.CLIMB, S.FIND_WALL, S.FOLLOW, S.RETURN, S.LAND):
        rig.fly_until(state)
        for _ in range(0 if state in (S.WAIT_READY, S.ARMING) else 60):
            rig.step()
        assert rig.navigator.state is state
        kept[state] = copy.deepcopy(rig)
        if state is S.FOLLOW:
            held = copy.deepcopy(rig)
            held.step(OperatorCommand(t_ns=held.t, kind=OperatorCommandKind.HOLD, source="test"))
            assert held.navigator.state is S.HOLDING
            kept[S.HOLDING] = held
    return kept


@pytest.fixture
def flown_to(flights: dict[NavigatorState, Rig]) -> Callable[[NavigatorState], Rig]:
    return lambda state: copy.deepcopy(flights[state])
