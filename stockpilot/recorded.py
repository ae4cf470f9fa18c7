"""Hangs a recorder on a flight: everything that goes into the flight core and everything that comes out."""

from __future__ import annotations

import subprocess
import time
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

import yaml

from companion.flight import Flight
from companion.messages import LevelledScan, VolumeReport
from companion.recording.log import Recorder
from companion.topics import VOLUME, Topic
from stockpilot.mission import Mission

if TYPE_CHECKING:  # needs the emulated side
    from stockpilot.lockstep import Lockstep

GIB = 1 << 30


def open_recorder(
    folder: Path, mission: Mission, *, lidar_metadata_json: str | None, autopilot: str, threaded: bool
) -> Recorder:
    """A recorder for a flight of this mission. Raises: StockpilotError: the files cannot be created."""
    config = mission.companion
    attachments = {
        "mission.yaml": yaml.safe_dump(mission.resolved(), sort_keys=False, allow_unicode=True).encode(),
        "companion.json": config.model_dump_json(indent=2).encode(),
    }
    if lidar_metadata_json is not None:
        attachments["lidar.json"] = lidar_metadata_json.encode()
    metadata = {"mission": mission.name, "seed": str(mission.seed), "autopilot": autopilot, "commit": commit()}
    return Recorder(
        folder, metadata=metadata, attachments=attachments, reserve_bytes=round(config.recording.reserve_gib * GIB),
        wall_offset_ns=time.time_ns() - time.monotonic_ns() if threaded else 0, threaded=threaded,
    )  # fmt: skip


def listen(recorder: Recorder, flight: Flight) -> None:
    """From now on the recorder hears all that this flight hears and says."""

    def tap(topic: Topic, t_ns: int, message: object) -> None:
        if isinstance(message, LevelledScan):
            if flight.estimate is not None:
                recorder.points(message, flight.estimate)
        else:
            recorder.tap(topic, t_ns, message)

    flight.record = recorder.input
    flight.tap = tap


def commit() -> str:
    """The commit of this program, or "unknown" where it is not run from its repository."""
    try:
        out = subprocess.run(
            ["git", "describe", "--always", "--dirty"], cwd=Path(__file__).parent, capture_output=True, text=True,
            timeout=5, check=True,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return out.stdout.strip()


class LockstepRecorder:
    """Records a lockstep flight; a context manager, so that the files are whole however it ends."""

    def __init__(self, folder: Path, mission: Mission, autopilot: str) -> None:
        self._folder = folder
        self._mission = mission
        self._autopilot = autopilot
        self._recorder: Recorder | None = None
        self._runner: Lockstep | None = None

    def attach(self, runner: Lockstep) -> None:
        self._runner = runner
        self._recorder = open_recorder(
            self._folder, self._mission, lidar_metadata_json=runner.flight.lidar_metadata_json,
            autopilot=self._autopilot, threaded=False,
        )  # fmt: skip
        listen(self._recorder, runner.flight)
        runner.on_output = self._recorder.output

    def volume(self, report: VolumeReport | None) -> None:
        """What the flight was flown for, measured after it."""
        if report is not None and self._recorder is not None and self._runner is not None:
            self._recorder.tap(VOLUME, self._runner.t_ns, report)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._recorder is None or self._runner is None:
            return
        navigation = self._runner.flight.navigation
        if error is not None or navigation is None:
            self._recorder.close({"state": "interrupted", "reason": "" if error is None else str(error)})
        else:
            self._recorder.close({"state": navigation.outcome or "ended", "reason": navigation.reason})
