"""How far off is the planar odometry on other people's recordings, against hand-made true relations?

    python -m benchmarks.scans2d [aces.orig.bag] [intel.orig.bag] [--no-loops] [--json]

Both are read in place from ../shared/data/scans2d (or STOCKPILOT_SHARED_DATA). The metric is Kuemmerle et al.'s
(Autonomous Robots 27, 2009): over all relations between two scans, mean and standard deviation of the translational and
rotational part of inverse(true relation) * estimated one. The scans alone are used, not the wheel odometry beside them.
The CARMEN logs of the same buildings cannot be held to the relations: their clocks begin elsewhere.
"""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from companion.messages import Array
from companion.odometry.pose_graph import relative
from stockpilot.odometry_cli import track
from stockpilot.scan_files import open_scans

SHARED = os.environ.get("STOCKPILOT_SHARED_DATA") or Path(__file__).resolve().parents[2] / "shared" / "data"
DATA = Path(SHARED) / "scans2d"
NAMES = ("aces.orig.bag", "intel.orig.bag")
SAME_TIME_S = 0.01


@dataclass(frozen=True, slots=True)
class Errors:
    """Of a trajectory against relations: metres and degrees. left_out: relations without both scans."""

    relations: int
    left_out: int
    mean_m: float
    std_m: float
    median_m: float
    mean_deg: float
    std_deg: float


def relation_errors(t_ns: list[int], poses: Array, relations: Path) -> Errors:
    """poses: (N, 3) x, y, yaw at the times t_ns, which rise."""
    table = np.loadtxt(relations)
    times = np.array(t_ns, dtype=np.float64) * 1e-9
    index = [_nearest(times, table[:, k]) for k in (0, 1)]
    off_s = [np.abs(times[i] - table[:, k]) for k, i in enumerate(index)]
    known = (off_s[0] < SAME_TIME_S) & (off_s[1] < SAME_TIME_S)
    if not known.any():
        raise ValueError(f"{relations}: none of its times is one of a scan")
    estimated = relative(poses[index[0][known]], poses[index[1][known]])
    wrong = relative(table[known][:, [2, 3, 7]], estimated)
    metres, degrees = np.hypot(wrong[:, 0], wrong[:, 1]), np.degrees(np.abs(wrong[:, 2]))
    return Errors(
        relations=int(known.sum()),
        left_out=int((~known).sum()),
        mean_m=float(metres.mean()),
        std_m=float(metres.std()),
        median_m=float(np.median(metres)),
        mean_deg=float(degrees.mean()),
        std_deg=float(degrees.std()),
    )


def _nearest(times: Array, wanted: Array) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    right = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
    return np.where(wanted - times[right - 1] < times[right] - wanted, right - 1, right)


def measure(name: str, *, with_loops: bool) -> dict[str, object]:
    found = track(open_scans(DATA / name).scans, with_loops=with_loops)
    truth = DATA / f"{name.partition('.')[0]}.relations"
    errors = relation_errors(found.t_ns, np.stack(found.poses), truth)
    placed = float(np.mean(found.converged))
    return {"name": name, "loops": found.loops, "placed_ratio": placed, "wall_time_s": found.wall_time_s} | asdict(
        errors
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", default=NAMES, metavar="NAME")
    parser.add_argument("--no-loops", action="store_true", help="odometry alone")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = []
    if not options.json:
        print(
            f"{'recording':24} {'relations':>9} {'mean, m':>8} {'std':>7} {'median':>7} {'mean, deg':>9} {'loops':>6} {'s':>6}"
        )
    for name in options.names:
        row = measure(name, with_loops=not options.no_loops)
        rows.append(row)
        if not options.json:
            print(
                f"{name:24} {row['relations']:9} {row['mean_m']:8.4f} {row['std_m']:7.4f} {row['median_m']:7.4f}"
                f" {row['mean_deg']:9.3f} {row['loops']:6} {row['wall_time_s']:6.1f}",
                flush=True,
            )
    if options.json:
        print(json.dumps(rows))


if __name__ == "__main__":
    main()
