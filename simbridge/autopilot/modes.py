"""Flight modes: their numbers on the wire, what each needs, and which one follows when one cannot run.

Source: PX4 px4_custom_mode.h, mode_requirements.cpp, framework.cpp.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

MANUAL, ALTCTL, POSCTL, AUTO, ACRO, OFFBOARD_MAIN, STABILIZED = 1, 2, 3, 4, 5, 6, 7


@dataclass(frozen=True, slots=True)
class ModeInfo:
    """main, sub: custom_mode; base: base_mode without the armed bit; standard: CURRENT_MODE.standard_mode."""

    main: int
    sub: int
    base: int
    standard: int
    needs_local: bool
    needs_global: bool
    is_manual: bool


class Mode(Enum):
    """PX4's navigation states that this emulation flies."""

    POSCTL = ModeInfo(POSCTL, 0, 81, 1, True, False, True)
    ALTCTL = ModeInfo(ALTCTL, 0, 81, 4, False, False, True)
    STABILIZED = ModeInfo(STABILIZED, 0, 81, 0, False, False, True)
    MANUAL = ModeInfo(MANUAL, 0, 81, 0, False, False, True)
    ACRO = ModeInfo(ACRO, 0, 65, 0, False, False, True)
    OFFBOARD = ModeInfo(OFFBOARD_MAIN, 0, 17, 0, False, False, False)
    TAKEOFF = ModeInfo(AUTO, 2, 29, 8, True, False, False)
    LOITER = ModeInfo(AUTO, 3, 29, 0, False, True, False)
    MISSION = ModeInfo(AUTO, 4, 29, 6, False, True, False)
    RTL = ModeInfo(AUTO, 5, 29, 5, False, True, False)
    LAND = ModeInfo(AUTO, 6, 29, 7, True, False, False)
    DESCEND = ModeInfo(AUTO, 6, 29, 0, False, False, False)  # the heartbeat cannot tell it from LAND

    @property
    def custom_mode(self) -> int:
        return self.value.main << 16 | self.value.sub << 24


_BY_NUMBER = {(m.value.main, m.value.sub): m for m in Mode if m is not Mode.DESCEND}
_MAIN_MODES = {m.value.main for m in Mode}


def by_number(main: int, sub: int) -> Mode | str:
    """The mode of DO_SET_MODE's param2 and param3, or PX4's text for an unknown one."""
    if main not in _MAIN_MODES:
        return "Unsupported main mode\t"
    mode = _BY_NUMBER.get((main, sub if main == AUTO else 0))
    return mode if mode is not None else "Unsupported auto mode\t"
