"""Does the 95 % interval hold the truth? Many synthetic maps over all kinds of halls, noise, poses, dust.

    python -m benchmarks.volume_interval --maps 120 [--first 0] [--json FILE]

Prints one line for each map and the share of maps whose interval holds the true volume (wanted: 90 to 99 %).
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

from companion.config import VolumeConfig
from companion.volume import estimate_volume
from tests.companion.volume.synthetic import (
    Flight,
    Hall,
    circle,
    cone,
    l_shape,
    leaning,
    make_map,
    rectangle,
    ridge,
    rotated,
)

KINDS = ("cement", "cone", "leaning", "l_shaped", "silo", "columns")


def random_hall(kind: str, rng: np.random.Generator) -> Hall:
    """A store of that kind with its own sizes; piles stay below the flight height."""
    slope, height = rng.uniform(0.5, 0.85), rng.uniform(4.0, 7.0)
    common = {
        "floor_slope": tuple(rng.choice([0.0, 1.0], p=[0.6, 0.4]) * rng.uniform(-0.02, 0.02, 2)),
        "floor_waves_m": float(rng.choice([0.0, 0.02], p=[0.7, 0.3])),
    }
    long, wide = rng.uniform(40, 60), rng.uniform(28, 34)
    x, y = long / 2 + rng.uniform(-3, 3), wide / 2 + rng.uniform(-1, 1)
    if kind in ("cement", "columns"):
        columns = tuple(
            (float(rng.uniform(7, long - 7)), float(rng.choice([8.5, wide - 8.5])), float(rng.uniform(0.2, 0.5)))
            for _ in range(int(rng.integers(2, 6)) if kind == "columns" else 0)
        )
        pile = ridge(x, y, rng.uniform(2, 9), height, slope, rng.uniform(0.0, 0.4))
        return Hall(footprint=rectangle(long, wide), pile=pile, columns=columns, **common)
    if kind == "cone":
        angle = rng.uniform(0, np.pi)
        at = rotated(np.array([[x, y]]), angle)[0]
        return Hall(footprint=rotated(rectangle(long, wide), angle), pile=cone(*at, height, slope), **common)
    if kind == "leaning":
        pile = leaning(wide, x, rng.uniform(2, 9), height, slope)
        return Hall(footprint=rectangle(long, wide), pile=pile, **common)
    if kind == "l_shaped":
        return Hall(footprint=l_shape(), pile=cone(*rng.uniform(12, 17, 2), min(height, 5.5), slope), **common)
    radius = rng.uniform(13, 18)
    off = rng.uniform(0, 0.6 * radius)
    return Hall(footprint=circle(radius), pile=cone(off, 0.0, min(height, 6.0), slope), **common)


def random_flight(rng: np.random.Generator, *, hard: bool, scan_period_s: float) -> Flight:
    return Flight(
        scan_period_s=scan_period_s,
        noise_m=float(rng.choice([0.03, 0.12, 0.12, 0.12, 0.3])),
        position_sigma_m=float(rng.uniform(0.005, 0.03)),
        height_sigma_m=float(rng.uniform(0.002, 0.015)),
        yaw_sigma_rad=float(rng.uniform(0, 0.0015)),
        tilt_sigma_rad=float(rng.uniform(0, 0.002)),
        dust_ratio=float(rng.uniform(0.0, 0.05)) if hard else 0.0,
        lost_ratio=float(rng.uniform(0.0, 0.1)) if hard else 0.0,
    )


def run(index: int, scan_period_s: float = 0.5) -> dict[str, object]:
    """One map by its number: the same number gives the same map."""
    rng = np.random.default_rng([7, index])
    kind = KINDS[index % len(KINDS)]
    hall = random_hall(kind, rng)
    flight = random_flight(rng, hard=rng.random() < 0.3, scan_period_s=scan_period_s)
    synthetic = make_map(hall, flight, index)
    begin = time.perf_counter()
    report = estimate_volume(synthetic.point_map, VolumeConfig())
    seconds = time.perf_counter() - begin
    low, high = report.interval_m3
    truth = synthetic.true_volume_m3
    return {
        "index": index,
        "kind": kind,
        "noise_m": flight.noise_m,
        "position_sigma_m": round(flight.position_sigma_m, 4),
        "height_sigma_m": round(flight.height_sigma_m, 4),
        "tilt_sigma_rad": round(flight.tilt_sigma_rad, 5),
        "dust": round(flight.dust_ratio, 3),
        "truth_m3": truth,
        "e_v_percent": 100.0 * (report.volume_m3 / truth - 1.0),
        "half_percent": 50.0 * (high - low) / truth,
        "z": 3.92 * (report.volume_m3 - truth) / (high - low),
        "holds": low <= truth <= high,
        "seen": report.seen_ratio,
        "seconds": seconds,
        "budget": dict(report.error_budget_m3),
        "warnings": report.warnings,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--maps", type=int, default=60)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--scan-period", type=float, default=0.5, help="seconds between mapped scans")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = []
    for index in range(args.first, args.first + args.maps):
        row = run(index, args.scan_period)
        rows.append(row)
        print(
            f"{index:4d} {row['kind']:9s} noise {row['noise_m']:.2f} pos {row['position_sigma_m']:.3f} "
            f"z {row['height_sigma_m']:.3f} tilt {row['tilt_sigma_rad']:.4f} dust {row['dust']:.3f} "
            f"truth {row['truth_m3']:7.1f} e_v {row['e_v_percent']:+.3f} % +- {row['half_percent']:.3f} % "
            f"z {row['z']:+.2f} {'' if row['holds'] else 'MISSED'} {' | '.join(map(str, row['warnings']))}",
            flush=True,
        )
    error = np.array([abs(float(str(r["e_v_percent"]))) for r in rows])
    z = np.array([float(str(r["z"])) for r in rows])
    print(
        f"\n{len(rows)} maps: the interval holds the truth in {100 * np.mean([bool(r['holds']) for r in rows]):.1f} %"
    )
    print(f"|e_v| median {np.median(error):.3f} %, 95th {np.quantile(error, 0.95):.3f} %, largest {error.max():.3f} %")
    print(f"error over 1 sigma: rms {np.sqrt(np.mean(z**2)):.2f}, mean {np.mean(z):+.2f}")
    print(f"seconds a map: median {np.median([float(str(r['seconds'])) for r in rows]):.2f}")
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
