"""Where to fly: the mission's state machine, the wall follower, and the guard that has the last word."""

from companion.navigator.interface import NavigatorInput, NavigatorOutput, NavigatorState
from companion.navigator.mission import Navigator

__all__ = ["Navigator", "NavigatorInput", "NavigatorOutput", "NavigatorState"]
