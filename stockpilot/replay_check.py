"""Mission replay tests: `make replay` flies the recordings of missions/replays again, `make refs` rewrites what is expected.

Each folder holds an expected.json: where the recording is, edits that make faults of it, and a few values with their
tolerance and its reason. Run as python -m stockpilot.replay_check [--write] [NAME ...]. Exit codes: 0 all as expected,
1 something differs (with --write: was rewritten), 2 a folder is broken.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from companion.errors import FileFormatError, StockpilotError
from companion.flight import Flight
from companion.geometry import rotation2, wrap_angle, yaw_from_quat
from companion.lidar.ouster import OusterDecoder
from companion.lidar.pcap import PcapReader
from companion.messages import Array, LidarScan, OdometryEstimate, WallRanges
from companion.recording import codec
from companion.recording.replay import Replay
from companion.recording.run_files import read_run
from stockpilot.replay import recorded_config
from stockpilot.replay_edit import edit_inputs, message_ids, rebuild_scans

ROOT = Path(__file__).resolve().parents[1]
REPLAYS = ROOT / "missions" / "replays"
EXPECTED = "expected.json"
TRUTH_NAME = "truth.csv"
SHARED = "shared:"
ODOMETRY = 331  # MAVLink common
SETPOINT = 84
TOLD = "told "  # before an event's name: how often it was told; 0 unless measured


@dataclass(frozen=True, slots=True)
class Check:
    """One value of a replay: expected, what came, and whether it is within its tolerance."""

    name: str
    expected: float | str | None
    got: float | str | None
    tolerance: float
    reason: str

    @property
    def is_kept(self) -> bool:
        if isinstance(self.expected, (int, float)) and isinstance(self.got, (int, float)):
            return abs(self.got - self.expected) <= self.tolerance
        return self.expected == self.got


@dataclass(frozen=True, slots=True)
class Outcome:
    """Of one folder. skipped: why it could not be tried."""

    name: str
    checks: tuple[Check, ...]
    skipped: str = ""

    @property
    def is_kept(self) -> bool:
        return bool(self.checks) and all(c.is_kept for c in self.checks)


def folders(names: Sequence[str] = ()) -> list[Path]:
    """The folders of missions/replays, or those named. Raises: FileFormatError: there is none."""
    found = sorted(p.parent for p in REPLAYS.glob(f"*/{EXPECTED}"))
    if names:
        found = [p for p in found if p.name in names]
    if not found:
        raise FileFormatError(f"{REPLAYS}: nothing to replay{' called ' + ', '.join(names) if names else ''}")
    return found


def check_folder(folder: Path) -> Outcome:
    """Replay one folder and compare. Raises: FileFormatError: it expects nothing, or a value that is not measured."""
    content = load_expected(folder)
    source = shared_path(content)
    if source is not None and not source.exists():
        return Outcome(folder.name, (), skipped=f"{content['recording']} is not here")
    measured = measure_folder(folder, content)
    expected: dict[str, dict[str, Any]] = content["expected"]
    for name in expected:
        if name.startswith(TOLD):
            measured.setdefault(name, 0)
    missing = [name for name in expected if name not in measured]
    if missing:
        raise FileFormatError(
            f"{folder / EXPECTED}: {', '.join(missing)} is not measured; there is: {', '.join(measured)}"
        )
    return Outcome(
        folder.name,
        tuple(
            Check(name, want["value"], measured[name], float(want.get("tolerance", 0.0)), str(want["reason"]))
            for name, want in expected.items()
        ),
    )


def load_expected(folder: Path) -> dict[str, Any]:
    """Raises: FileFormatError: not such a file, or one that compares nothing."""
    path = folder / EXPECTED
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise FileFormatError(f"{path}: {error}") from None
    for key in ("about", "recording", "expected"):
        if not content.get(key):
            raise FileFormatError(f"{path}: {key} is missing or empty: a test that compares nothing must not pass")
    for name, want in content["expected"].items():
        if "value" not in want or not want.get("reason"):
            raise FileFormatError(f"{path}: {name} needs a value and the reason of its tolerance")
    return content


def shared_path(content: dict[str, Any]) -> Path | None:
    """Where a shared recording is; None for one of our own."""
    name = str(content["recording"])
    if not name.startswith(SHARED):
        return None
    root = os.environ.get("STOCKPILOT_SHARED_DATA") or ROOT.parent / "shared" / "data"
    return Path(root) / name.removeprefix(SHARED)


def measure_folder(folder: Path, content: dict[str, Any]) -> dict[str, float | str | None]:
    """All values that a folder may expect."""
    source = shared_path(content)
    if source is not None:
        return measure_capture(source, source.parent / str(content["metadata"]))
    file = (folder / str(content["recording"])).resolve()
    recording = read_run(file)
    config = recorded_config(recording, content.get("settings", ()))
    metadata = recording.attachments["lidar.json"].decode()
    inputs = rebuild_scans(edit_inputs(recording.inputs, content.get("edits", ())), metadata)
    replay = Replay(Flight(config=config, lidar_metadata_json=metadata))
    watch = _Watch()
    replay.on_scan = lambda result: watch.take(result.estimate, result.wall_ranges)
    replay.run(inputs)
    truth_file = file.parent / TRUTH_NAME
    truth = np.loadtxt(truth_file, delimiter=",", skiprows=1) if truth_file.exists() else None
    start_ns = next(i.t_ns for i in recording.inputs if i.kind == "lidar")
    return watch.values(replay, [i.t_ns for i in inputs if i.kind == "lidar"], truth, start_ns)


class _Watch:
    """Gathers estimates and wall distances of a replay."""

    def __init__(self) -> None:
        self.estimates: list[OdometryEstimate] = []
        self.walls: list[WallRanges] = []

    def take(self, estimate: OdometryEstimate, walls: WallRanges) -> None:
        self.estimates.append(estimate)
        self.walls.append(walls)

    def values(
        self, replay: Replay, lidar_ns: list[int], truth: Array | None, start_ns: int
    ) -> dict[str, float | str | None]:
        flight, estimates = replay.flight, self.estimates
        sent = [t for t, frame in replay.frames if ODOMETRY in message_ids(frame)]
        gaps = np.diff(np.array([t for t in sent if t <= lidar_ns[-1]], dtype=np.int64)) * 1e-9
        values: dict[str, float | str | None] = {
            "scans": flight.scans,
            "estimates": len(estimates),
            "keyframes": sum(e.is_keyframe for e in estimates),
            "rejected_scans": sum(not e.converged for e in estimates),
            "failed_scans": sum(e.quality < 0 for e in estimates),
            "degenerate_ratio": _mean([float(e.is_degenerate) for e in estimates]),
            "resets": estimates[-1].reset_counter - estimates[0].reset_counter if estimates else 0,
            "dropped_packets": sum(flight.decoder.dropped.values()),
            "frozen_scans": flight.decoder.dropped["frozen"],
            "right_m": _median([w.right_m for w in self.walls]),
            "front_m": _median([w.front_m for w in self.walls]),
            "odometry_rate_hz": (len(sent) - 1) / ((sent[-1] - sent[0]) * 1e-9) if len(sent) > 1 else 0.0,
            "odometry_max_gap_s": float(gaps.max()) if len(gaps) else None,
            "odometry_stops_after_s": (sent[-1] - lidar_ns[-1]) * 1e-9 if sent else None,
            "control_requests": sum(
                codec.fields(data)["kind"] in ("arm", "offboard")
                for _, data in replay.messages.get("navigator/request", [])
            ),
            "setpoints": sum(SETPOINT in message_ids(frame) for _, frame in replay.frames),
        }
        for event in flight.events:
            name = TOLD + event.name
            values[name] = int(values.get(name) or 0) + 1
        if estimates:
            values |= _motion(estimates)
            if truth is not None:
                values |= _errors(estimates, truth, start_ns)
        return values


def _motion(estimates: list[OdometryEstimate]) -> dict[str, float | str | None]:
    first, last = estimates[0], estimates[-1]
    path = np.array([e.position_map_m for e in estimates])
    yaws = [yaw_from_quat(e.q_map_body_wxyz) for e in estimates]
    moved = last.position_map_m - first.position_map_m
    return {
        "moved_m": float(np.hypot(moved[0], moved[1])),
        "climbed_m": float(moved[2]),
        "turned_deg": math.degrees(sum(wrap_angle(b - a) for a, b in pairwise(yaws))),
        "path_m": float(np.hypot(*np.diff(path[:, :2], axis=0).T).sum()),
        "sigma_m": float(math.sqrt(max(last.pose_covariance[0, 0], last.pose_covariance[1, 1]))),
    }


def _errors(estimates: list[OdometryEstimate], truth: Array, start_ns: int) -> dict[str, float | str | None]:
    """Against truth.csv, pinned to the true pose of the first estimate; nothing is aligned afterwards."""
    times = np.array([(e.t_ns - start_ns) * 1e-9 for e in estimates])
    true = np.stack([np.interp(times, truth[:, 0], truth[:, k]) for k in range(1, 5)], axis=1)
    yaws = np.unwrap([yaw_from_quat(e.q_map_body_wxyz) for e in estimates])
    offset = math.radians(true[0, 3]) - yaws[0]
    moved = np.array([e.position_map_m - estimates[0].position_map_m for e in estimates])
    flat = moved[:, :2] @ rotation2(offset).T - (true[:, :2] - true[0, :2])
    distance = np.hypot(flat[:, 0], flat[:, 1])
    turned = np.degrees(yaws - yaws[0]) - (true[:, 3] - true[0, 3])
    return {
        "error_rms_m": float(np.sqrt(np.mean(distance**2))),
        "error_max_m": float(distance.max()),
        "error_height_m": float(np.abs(moved[:, 2] - (true[:, 2] - true[0, 2])).max()),
        "error_yaw_deg": float(np.abs(turned).max()),
    }


def measure_capture(capture: Path, metadata: Path) -> dict[str, float | str | None]:
    """Of a real sensor's packets: what decoding and projection give."""
    decoder = OusterDecoder(metadata.read_text(encoding="utf-8"))
    scans: list[LidarScan] = []
    for packet in PcapReader(capture):
        scans += decoder.receive(packet.data, packet.t_ns, packet.source)
    if not scans:
        raise FileFormatError(f"{capture}: no whole scan in it")
    first = scans[0]
    points = first.geometry.directions * first.range_m[..., None].astype(np.float64) + first.geometry.offsets_m
    seen = first.range_m > 0
    return {
        "scans": len(scans),
        "lost_columns": int(sum((~s.column_valid).sum() for s in scans)),
        "dropped_packets": sum(n for reason, n in decoder.dropped.items() if reason != "size"),
        "seen_ratio": float(seen.mean()),
        "range_sum_m": float(first.range_m.astype(np.float64).sum()),
        "lowest_m": float(np.percentile(points[seen][:, 2], 1)),
        "turn_ms": (first.t_column_ns[-1] - first.t_column_ns[0]) * 1e-6,
    }


def rewrite(folder: Path) -> list[str]:
    """Put today's values into expected.json; returns a line for each that changed."""
    content = load_expected(folder)
    source = shared_path(content)
    if source is not None and not source.exists():
        return []
    measured = measure_folder(folder, content)
    changed = []
    for name, want in content["expected"].items():
        got = measured.get(name, 0) if name.startswith(TOLD) else measured[name]
        new = round(got, 4) if isinstance(got, float) else got
        if new != want["value"]:
            changed.append(f"{folder.name}: {name} {want['value']} -> {new}")
            want["value"] = new
    if changed:
        text = json.dumps(content, indent=2, ensure_ascii=False) + "\n"
        (folder / EXPECTED).write_text(text, encoding="utf-8")
    return changed


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m stockpilot.replay_check", description=__doc__)
    parser.add_argument("names", nargs="*", help="folders of missions/replays; default: all")
    parser.add_argument("--write", action="store_true", help="rewrite what is expected and print what changed")
    parser.add_argument("--measure", action="store_true", help="print all that could be expected")
    args = parser.parse_args(arguments)
    try:
        chosen = folders(args.names)
        if args.measure:
            for folder in chosen:
                print(json.dumps({folder.name: measure_folder(folder, load_expected(folder))}, indent=2))
            return 0
        return _write(chosen) if args.write else _check(chosen)
    except StockpilotError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def _write(chosen: Iterable[Path]) -> int:
    changed = [line for folder in chosen for line in rewrite(folder)]
    print("\n".join(changed) if changed else "nothing changed")
    return 1 if changed else 0


def _check(chosen: Iterable[Path]) -> int:
    outcomes = [check_folder(folder) for folder in chosen]
    for outcome in outcomes:
        if outcome.skipped:
            print(f"skipped  {outcome.name}: {outcome.skipped}")
            continue
        print(f"{'kept   ' if outcome.is_kept else 'BROKEN '}  {outcome.name}")
        for c in outcome.checks:
            if not c.is_kept:
                print(f"    {c.name}: {c.got}, expected {c.expected} within {c.tolerance:g} ({c.reason})")
    tried = [o for o in outcomes if not o.skipped]
    if not tried:
        print("nothing was compared", file=sys.stderr)
        return 2
    return 0 if all(o.is_kept for o in tried) else 1


def _mean(values: list[float]) -> float:
    return float(np.mean(values)) if values else 0.0


def _median(values: Iterable[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.median(known)) if known else None


if __name__ == "__main__":
    raise SystemExit(main())
