"""Stores drawn by number, to fly what nobody thought of: halls, piles, clutter, sensor, starts and settings.

    python -m benchmarks.random_stores --count 40 [--first 0] --out runs/random
    stockpilot sweep runs/random/sweep.yaml --out runs/random/flights

Each number gives the same mission; what a mission file may not say is drawn again.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from companion.errors import ConfigError
from simbridge.config import SimConfig
from simbridge.loop import start_pose
from simbridge.world import build_world
from stockpilot.mission import build_mission

MOST_TRIES = 400
LEAST_SEEN_M = 0.3  # of a box, above the pile that it stands in


def draw(number: int) -> dict[str, Any]:
    """A mission that is allowed. Raises: RuntimeError where none was found."""
    rng = np.random.default_rng([11, number])
    for _ in range(MOST_TRIES):
        raw = _any_mission(rng, number)
        try:
            sim = build_mission(raw, source="drawn").sim
            assert sim is not None
            start_pose(sim)
        except (ConfigError, ValueError):  # not allowed; no place to stand
            continue
        if not _hides_a_box(sim):
            return raw
    raise RuntimeError(f"number {number}: no allowed mission in {MOST_TRIES} draws")


def _hides_a_box(sim: SimConfig) -> bool:
    """A pile that covers a box holds less than it shows, and nothing that flies can tell."""
    world = build_world(sim.store)
    return any(world.surface_height(*box.center) > box.size_m[2] - LEAST_SEEN_M for box in sim.world.boxes)


def _any_mission(rng: np.random.Generator, number: int) -> dict[str, Any]:
    corners, size = _footprint(rng)
    height = float(rng.uniform(9, 17))
    flight = round(float(rng.uniform(5.5, min(10.0, height - 2.0))), 1)
    middle = np.mean(np.array(corners), axis=0) if isinstance(corners, list) else np.array(corners["circle"]["center"])
    world: dict[str, Any] = {"footprint": corners, "height_m": round(height, 1)}
    if rng.random() < 0.3:
        world["floor_slope"] = [round(float(s), 4) for s in rng.uniform(-0.015, 0.015, 2)]
    if rng.random() < 0.3:
        world["wall_roughness"] = {"rms_m": round(float(rng.uniform(0.01, 0.06)), 3), "seed": number}
    if rng.random() < 0.3:
        spacing, depth = float(rng.uniform(3, 8)), float(rng.uniform(0.15, 0.6))
        world["pilasters"] = [{"wall": "all", "spacing_m": round(spacing, 1), "depth_m": round(depth, 2)}]
    world["columns"] = [
        {"center": _spot(rng, middle, size), "radius_m": round(float(rng.uniform(0.2, 0.6)), 2)}
        for _ in range(int(rng.choice([0, 0, 0, 1, 2, 4])))
    ]
    world["boxes"] = [
        {
            "center": _spot(rng, middle, size),
            "size_m": [round(float(s), 1) for s in rng.uniform(0.8, 4.0, 3)],
            "yaw_deg": float(rng.integers(0, 90)),
        }
        for _ in range(int(rng.choice([0, 0, 1, 2])))
    ]
    world["piles"] = [_pile(rng, middle, size, flight, number) for _ in range(int(rng.choice([1, 1, 2, 3])))]
    if rng.random() < 0.3:
        world["wind"] = {"gust_mps": round(float(rng.uniform(0.3, 1.5)), 1)}
    return {
        "name": f"store_{number}",
        "world": world,
        "vehicle": {"start": {"circle": {"center": [round(float(v), 1) for v in middle], "radius_m": 80}}},
        "lidar": {
            "rows": int(rng.choice([5, 5, 5, 16, 32])),
            "noise_m": float(rng.choice([0.03, 0.06, 0.12, 0.12])),
            "max_range_m": float(rng.choice([50, 50, 100])),
        },
        "navigator": {
            "forward_speed_mps": float(rng.choice([0.31, 0.43, 0.55, 0.8])),
            "wall_distance_m": float(rng.choice([4, 5, 6, 6, 7])),
            "height_m": flight,
        },
        "odometry": {"keyframe_period_s": float(rng.choice([1.6, 3.2, 4.8, 6.4]))},
        "volume": {"cell_m": float(rng.choice([0.25, 0.25, 0.4]))},
    }


def _footprint(rng: np.random.Generator) -> tuple[Any, np.ndarray]:
    """Corners or a circle, and the half size of what encloses them."""
    kind = rng.choice(["rectangle", "rectangle", "l", "t", "u", "skew", "hexagon", "round"])
    long, wide = float(rng.uniform(24, 62)), float(rng.uniform(20, 40))
    if kind == "round":
        radius = round(float(rng.uniform(11, 20)), 1)
        return {"circle": {"center": [0, 0], "radius_m": radius}}, np.array([radius, radius])
    a, b = float(rng.uniform(0.35, 0.65)), float(rng.uniform(0.35, 0.65))
    shapes = {
        "rectangle": [(0, 0), (1, 0), (1, 1), (0, 1)],
        "l": [(0, 0), (1, 0), (1, b), (a, b), (a, 1), (0, 1)],
        "t": [(0, 0), (1, 0), (1, b), (0.7, b), (0.7, 1), (0.3, 1), (0.3, b), (0, b)],
        "u": [(0, 0), (1, 0), (1, 1), (0.65, 1), (0.65, b), (0.35, b), (0.35, 1), (0, 1)],
        "skew": [(0, 0), (1, rng.uniform(0, 0.25)), (rng.uniform(0.75, 1), 1), (rng.uniform(0, 0.25), 0.85)],
        "hexagon": [(0.25, 0), (0.75, 0), (1, 0.5), (0.75, 1), (0.25, 1), (0, 0.5)],
    }
    if kind in ("l", "t", "u"):
        long, wide = max(long, 40.0), max(wide, 34.0)
    corners = np.array(shapes[str(kind)], dtype=float) * (long, wide)
    turn = float(rng.uniform(0, math.pi)) if rng.random() < 0.5 else 0.0
    c, s = math.cos(turn), math.sin(turn)
    turned = corners @ np.array([[c, s], [-s, c]])
    turned -= turned.mean(axis=0)
    return [[round(float(x), 2), round(float(y), 2)] for x, y in turned], np.abs(turned).max(axis=0)


def _spot(rng: np.random.Generator, middle: np.ndarray, size: np.ndarray) -> list[float]:
    return [round(float(v), 1) for v in middle + rng.uniform(-0.9, 0.9, 2) * size]


def _pile(rng: np.random.Generator, middle: np.ndarray, size: np.ndarray, flight: float, number: int) -> dict[str, Any]:
    kind = str(rng.choice(["cone", "ridge", "gaussians"]))
    height = round(float(rng.uniform(1.5, flight - 1.3)), 1)
    leaning = bool(rng.random() < 0.35)
    pile: dict[str, Any] = {"kind": kind, "leaning": leaning}
    if kind == "gaussians":
        hills = [
            {
                "center": _spot(rng, middle, size * 0.5),
                "height_m": height,
                "sigma_m": round(float(rng.uniform(2, 4)), 1),
            }
            for _ in range(int(rng.integers(1, 4)))
        ]
        return {**pile, "hills": hills}
    pile |= {
        "center": _spot(rng, middle, size if leaning else size * 0.6),
        "height_m": height,
        "repose_deg": round(float(rng.uniform(26, 40)), 1),
        "unevenness_m": round(float(rng.uniform(0, 0.3)), 2),
        "seed": number,
    }
    if kind == "ridge":
        pile |= {"length_m": round(float(rng.uniform(3, 18)), 1), "yaw_deg": float(rng.integers(0, 180))}
    return pile


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/random"))
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    names = []
    for number in range(args.first, args.first + args.count):
        raw = draw(number)
        names.append(f"{raw['name']}.yaml")
        (args.out / names[-1]).write_text(yaml.safe_dump(raw, sort_keys=False))
    sweep = {"name": "random", "description": "Stores drawn by number.", "missions": names, "seeds": [0]}
    (args.out / "sweep.yaml").write_text(yaml.safe_dump(sweep, sort_keys=False))
    print(f"{len(names)} missions in {args.out}; fly them: stockpilot sweep {args.out / 'sweep.yaml'}")


if __name__ == "__main__":
    main()
