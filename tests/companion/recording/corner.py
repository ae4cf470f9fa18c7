"""The recorded flight round a corner, ready to be flown again."""

from __future__ import annotations

from pathlib import Path

from companion.flight import Flight
from companion.recording.run_files import read_run
from companion.recording.run_types import Input
from stockpilot.replay import recorded_config
from stockpilot.replay_edit import rebuild_scans

CORNER = Path(__file__).resolve().parents[3] / "missions" / "replays" / "corner" / "recording.packed.xz"


def recorded() -> tuple[Flight, list[Input]]:
    recording = read_run(CORNER)
    metadata = recording.attachments["lidar.json"].decode()
    return Flight(config=recorded_config(recording), lidar_metadata_json=metadata), rebuild_scans(
        recording.inputs, metadata
    )
