"""Where the recordings of real sensors and real autopilots are: beside the repository, never in it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


def shared_data(*parts: str) -> Path:
    """The path of a shared recording; skips the calling test, saying so, where the recordings are absent.

    Looked for in STOCKPILOT_SHARED_DATA, then in ../shared/data beside the repository.
    """
    root = Path(os.environ.get("STOCKPILOT_SHARED_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data")
    path = root.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"shared recording {'/'.join(parts)} is not here (looked in {root}); set STOCKPILOT_SHARED_DATA")
    return path
