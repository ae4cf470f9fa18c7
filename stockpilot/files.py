"""Files that a flight leaves behind, written whole or not at all. Needs nothing of the emulated side."""

from __future__ import annotations

import itertools
import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from companion.errors import FileFormatError
from companion.messages import OdometryEstimate, VolumeReport
from companion.odometry.turned import TurnedBy
from companion.recording.log import MCAP_NAME
from companion.recording.manifest import MANIFEST_NAME
from companion.recording.tum import tum_line

OF_THE_LAST_RUN = (MANIFEST_NAME, "report.json", "map.ply")  # what replay would hold against a newer recording


def make_folder(folder: Path) -> Path:
    """The folder, made if need be. Raises: FileFormatError: it cannot be, or is a file."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        why = "it is a file" if isinstance(error, FileExistsError) else error.strerror
        raise FileFormatError(f"{folder}: cannot be made a folder: {why}; choose another with --out") from None
    return folder


def begin_folder(folder: Path) -> Path:
    """The same for a run that is flown anew: what would speak of the last one's files is gone before the first is
    written, so that a run that is cut off is not taken for one that was altered."""
    make_folder(folder)
    for name in OF_THE_LAST_RUN:
        (folder / name).unlink(missing_ok=True)
    return folder


def fresh_folder(folder: Path) -> Path:
    """folder, or where a flight was recorded there already: folder-2, folder-3, ... A flight is never written over: a
    companion that starts again in the air is given the same --out."""
    names = itertools.chain([folder], (folder.with_name(f"{folder.name}-{n}") for n in itertools.count(2)))
    return make_folder(next(name for name in names if not (name / MCAP_NAME).exists()))


def require_place(path: Path) -> None:
    """Raises: FileFormatError: no file can be written there: better told before a long computation than after it."""
    if path.is_dir():
        raise FileFormatError(f"{path}: cannot be written: Is a directory")
    if not path.parent.is_dir():
        raise FileFormatError(f"{path}: cannot be written: {path.parent} is no folder")


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


def turned_keys(turned_by: TurnedBy) -> dict[str, float]:
    """The report's keys that say how far the LiDAR is turned beyond its mount, by the flight, and 1 sigma of it."""
    return {
        "lidar_turned_deg": math.degrees(turned_by.angle_rad),
        "lidar_turned_sigma_deg": math.degrees(turned_by.sigma_rad),
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
