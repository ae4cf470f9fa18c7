"""Writes what a flight leaves behind into its folder: report, map, trajectory, pictures, page."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import yaml

from companion.mapping.export import save_point_map
from companion.messages import Array
from companion.recording.manifest import write_manifest
from stockpilot.files import write_json, write_trajectory
from stockpilot.pictures import draw_map, draw_surface, draw_trajectory
from stockpilot.report import write_report_page
from stockpilot.run import Flown


def write_results(folder: Path, flown: Flown) -> None:
    """report.json last but for the manifest: where it is, the rest is whole."""
    scored, outcome = flown.scored, flown.outcome
    save_point_map(scored.point_map, folder / "map.ply")
    save_point_map(scored.point_map, folder / "map.laz")
    write_trajectory(folder / "trajectory.tum", outcome.estimates)
    resolved = yaml.safe_dump(flown.mission.resolved(), sort_keys=False, allow_unicode=True)
    (folder / "mission.yaml").write_text(resolved, encoding="utf-8")
    estimated = np.array([e.position_map_m for e in outcome.estimates], dtype=np.float64).reshape(-1, 3)
    pictures = {
        "trajectory": draw_trajectory(
            folder / "trajectory.png",
            outlines=flown.world.outlines(),
            pile_outlines=flown.world.plan.piles,
            truth_world_m=outcome.truth.position_world_m[:, :2],
            estimated_world_m=scored.pin.to_world(estimated)[:, :2],
            paper_world_m=_paper_world(flown),
            title=f"{flown.mission.name}, seed {flown.mission.seed}",
        ),
        "map": draw_map(folder / "map.png", scored.point_map),
    }
    if scored.volume is not None:
        pictures["surface"] = draw_surface(folder / "surface.png", scored.volume)
    write_report_page(folder / "report.html", scored.report, pictures)
    write_json(folder / "report.json", scored.report)
    write_manifest(folder)


def _paper_world(flown: Flown) -> Array:
    path = flown.scored.paper_path_map_m
    return flown.scored.pin.to_world(np.column_stack([path, np.zeros(len(path))]))[:, :2]
