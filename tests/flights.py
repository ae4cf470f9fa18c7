"""Small missions for tests: the whole chain in a hall that is flown round in two minutes."""

from __future__ import annotations

from typing import Any

from stockpilot.mission import Mission, build_mission

SMALL_HALL: dict[str, Any] = {
    "name": "small_hall",
    "seed": 3,
    "world": {
        "footprint": [[0, 0], [22, 0], [22, 17], [0, 17]],
        "height_m": 9,
        "piles": [{"kind": "cone", "center": [11.5, 8.5], "height_m": 2.2, "repose_deg": 35}],
    },
    "vehicle": {"start": [5.5, 6.0, 40.0]},
    "navigator": {"forward_speed_mps": 0.8, "wall_distance_m": 5.0, "height_m": 4.5, "climb_speed_mps": 1.0},
    "odometry": {"keyframe_period_s": 3.2},
}


def small_mission(**sections: Any) -> Mission:
    """The small hall with some sections changed: small_mission(lidar={"noise_m": 0.03}, seed=5)."""
    raw = {key: dict(value) if isinstance(value, dict) else value for key, value in SMALL_HALL.items()}
    for key, value in sections.items():
        if isinstance(value, dict) and isinstance(raw.get(key), dict):
            raw[key] = {**raw[key], **value}
        else:
            raw[key] = value
    return build_mission(raw, source="small_hall.yaml")
