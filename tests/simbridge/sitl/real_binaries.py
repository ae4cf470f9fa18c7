"""Where the user's own autopilots are: given by the environment, never in the repository."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

VARIABLES = {"px4": "STOCKPILOT_PX4", "ardupilot": "STOCKPILOT_ARDUCOPTER"}
BOTH = [
    pytest.param("px4", marks=[pytest.mark.px4, pytest.mark.xdist_group("px4")]),  # its ports are fixed
    pytest.param("ardupilot", marks=pytest.mark.ardupilot),
]


def real_binary(kind: str) -> Path:
    """The binary; skips the calling test, saying so, where none is given."""
    path = os.environ.get(VARIABLES[kind])
    if not path:
        pytest.skip(f"needs a real {kind}: give the path of its SITL binary in {VARIABLES[kind]}")
    return Path(path)
