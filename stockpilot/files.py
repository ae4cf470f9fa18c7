"""Files that a flight leaves behind, written whole or not at all. Needs nothing of the emulated side."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from companion.messages import OdometryEstimate, VolumeReport
from companion.recording.tum import tum_line


def write_json(path: Path, data: dict[str, Any]) -> None:
    """Written whole or not at all; numbers that are not numbers become null."""
    temporary = path.with_name(path.name + ".part")
    with temporary.open("w", encoding="utf-8") as file:
        json.dump(finite(data), file, indent=2, allow_nan=False)
        file.write("\n")
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def write_trajectory(path: Path, estimates: list[OdometryEstimate]) -> None:
    """TUM lines of full precision: t x y z qx qy qz qw."""
    path.write_text("".join(tum_line(estimate) for estimate in estimates), encoding="utf-8")


def volume_keys(volume: VolumeReport | None) -> dict[str, Any]:
    """The report's keys that speak of the volume; None where nothing was mapped."""
    return {
        "volume_m3": volume.volume_m3 if volume else None,
        "volume_interval_m3": list(volume.interval_m3) if volume else None,
        "volume_interval_level": volume.interval_level if volume else None,
        "seen_ratio": volume.seen_ratio if volume else None,
        "interpolated_ratio": volume.interpolated_ratio if volume else None,
        "unseen_ratio": volume.unseen_ratio if volume else None,
        "floor_area_m2": volume.floor_area_m2 if volume else None,
        "pile_area_m2": volume.pile_area_m2 if volume else None,
        "error_budget_m3": dict(volume.error_budget_m3) if volume else {},
        "warnings": list(volume.warnings) if volume else ["nothing was mapped"],
    }


def finite(value: Any) -> Any:
    """For JSON, which knows neither NaN nor infinity: None instead."""
    if isinstance(value, dict):
        return {key: finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [finite(item) for item in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.integer | np.bool_):
        return value.item()
    return value
