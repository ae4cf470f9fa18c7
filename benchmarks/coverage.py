"""Does the 95 % interval hold the truth in 90 to 99 % of flights? Over any number of sweeps at once.

    python -m benchmarks.coverage runs/paper_sweep runs/random/flights runs/worlds ... [--docs docs/results.md] [--json]

Each folder is one that `stockpilot sweep` wrote. Printed: for each sweep and for all of them how many flights gave a volume, in how
many of them the interval holds the truth, with the 95 % range that this count leaves for the ratio (Clopper and Pearson,
Biometrika 1934), how many that do not hold it carry no warning, and the errors over 1 sigma, RMS (1 where the interval is just as
wide as it should be). Flights of one world err alike: what holds in many worlds says more than what holds in many flights of one.
With --by-world the flights of all folders are told by their world instead: what they err by, and what the interval is made of.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from companion.errors import ConfigError
from stockpilot.sweep import read_result
from stockpilot.sweep_report import fill_block, interval_scores, is_confident_and_wrong, rms

Report = dict[str, Any]
WANTED = (0.90, 0.99)
PARTS_TOLD = 4  # of the interval, the largest first


def reports_of(folder: Path) -> list[Report]:
    """The reports of the flights that a sweep left there. Raises: ConfigError: there are none."""
    found = [r["report"] for path in sorted(folder.glob("*.json")) if (r := read_result(path)) is not None]
    if not found:
        raise ConfigError(
            f"{folder}: no flights: expected the folder of a sweep (stockpilot sweep FILE --out {folder})"
        )
    return found


def row(name: str, reports: Sequence[Report]) -> dict[str, Any]:
    """What is said of some flights. Those that gave no volume are counted, and not among those that should hold the truth."""
    told = [r for r in reports if r.get("volume_m3") is not None]
    inside = sum(bool(r.get("truth_in_interval")) for r in told)
    scores = [s["error_over_sigma"] for r in told if (s := interval_scores(r))]
    low, high = binomtest(inside, len(told)).proportion_ci(0.95, "exact") if told else (math.nan, math.nan)
    return {
        "flights of": name,
        "flights": len(reports),
        "with a volume": len(told),
        "inside": inside,
        "inside, %": 100.0 * inside / len(told) if told else math.nan,
        "95 % range, %": f"{100.0 * low:.1f} to {100.0 * high:.1f}",
        "outside without a warning": sum(is_confident_and_wrong(r) for r in told),
        "error over 1 sigma, RMS": rms(np.array(scores)) if scores else math.nan,
    }


def world_row(name: str, reports: Sequence[Report]) -> dict[str, Any]:
    """What is said of one world's flights whose interval has two ends, in percent of the volume."""
    scored = [(r, s["error_over_sigma"]) for r in reports if (s := interval_scores(r))]
    error = np.array([100.0 * (r["volume_m3"] / r["truth_volume_m3"] - 1.0) for r, _ in scored])
    parts: dict[str, float] = {}
    for r, _ in scored:
        for part, sigma_m3 in (r.get("error_budget_m3") or {}).items():
            parts[part] = parts.get(part, 0.0) + (100.0 * sigma_m3 / r["truth_volume_m3"]) ** 2 / len(scored)
    largest = sorted((p for p in parts if parts[p] > 0.0), key=lambda part: -parts[part])[:PARTS_TOLD]
    return {
        "world": name,
        "flights": len(scored),
        "inside": sum(bool(r.get("truth_in_interval")) for r, _ in scored),
        "error, %, mean": float(error.mean()) if len(error) else math.nan,
        "error, %, RMS": rms(error) if len(error) else math.nan,
        "error over 1 sigma, RMS": rms(np.array([z for _, z in scored])) if scored else math.nan,
        "largest parts of 1 sigma, %": ", ".join(f"{part} {math.sqrt(parts[part]):.3f}" for part in largest),
    }


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Markdown."""
    lines = ["| " + " | ".join(rows[0]) + " |", "|" + "---|" * len(rows[0])]
    lines += [
        "| " + " | ".join(f"{v:.3g}" if isinstance(v, float) else str(v) for v in r.values()) + " |" for r in rows
    ]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", type=Path, nargs="+", help="folders of sweeps")
    parser.add_argument(
        "--by-world", action="store_true", help="a row for each world; its block is `coverage_by_world`"
    )
    parser.add_argument("--docs", type=Path, help="fill this document's block `coverage`")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    try:
        by_sweep = {folder: reports_of(folder) for folder in args.folders}
    except ConfigError as error:
        parser.error(str(error))
    every = [report for reports in by_sweep.values() for report in reports]
    if args.by_world:
        worlds = sorted({str(report.get("mission")) for report in every})
        rows = [world_row(world, [r for r in every if str(r.get("mission")) == world]) for world in worlds]
    else:
        rows = [*(row(str(folder), reports) for folder, reports in by_sweep.items()), row("all", every)]
    if args.docs is not None:
        block, option = ("coverage_by_world", " --by-world") if args.by_world else ("coverage", "")
        command = f"`python -m benchmarks.coverage{option} {' '.join(map(str, args.folders))}`"
        fill_block(args.docs, block, f"{command}\n\n{table(rows)}")
    print(json.dumps(rows, indent=2) if args.json else table(rows))
    if args.json or args.by_world:
        return
    ratio = rows[-1]["inside, %"] / 100.0
    print(
        f"wanted: {WANTED[0]:.0%} to {WANTED[1]:.0%}; {'reached' if WANTED[0] <= ratio <= WANTED[1] else 'not reached'}"
    )


if __name__ == "__main__":
    main()
