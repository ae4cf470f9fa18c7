"""Signs that a map is degraded: what to say, and by how much to widen the interval for it.

A wrong volume with a narrow interval is the worst result that this program can give: each sign that the other parts
of the error budget cannot measure adds to it here, in m3 at 1 sigma.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from companion.messages import PointMap
from companion.volume.floor import Floor
from companion.volume.grid import Mask
from companion.volume.interval import Evidence, flank_m2, gaps_together_m3
from companion.volume.keyframes import DRIFTS
from companion.volume.surface import Cells, CellState
from companion.volume.walls import Footprint

BEYOND_WALLS = 0.03  # of all returns; an open door lets out less
IN_THE_AIR = 0.05  # of the returns within the walls
WALLS_DOUBLED_M = 0.06  # disagreement of keyframes on the walls; good poses keep within 0.03 m
FLOOR_DOUBLED_M = 0.02  # disagreement of keyframes on the floor; upright poses keep within 0.012 m
FLOOR_BENT_M = 0.04  # undulation; power-floated and dozed floors keep within 0.02 m
FLOOR_SEEN = 0.03  # of the area within the walls
UNSEEN = 0.05  # of the floor
UNSEEN_IN_PILE = 0.01
WIDE_GAP_M, IN_WIDE_GAPS = 0.5, 0.05  # to what was seen; of the pile's own area
PIT_DEPTH_M = 0.5  # floors do not sink so far
PIT_M2 = 4.0
CUT_FACE_M2 = 2.0  # of material on the edge of a map without walls; a heap's foot is all around
THIN_CELLS = 4.0  # returns in the median cell


@dataclass(frozen=True, slots=True, kw_only=True)
class Doubt:
    sigma_m3: float
    warnings: tuple[str, ...]


def doubt(
    e: Evidence,
    footprint: Footprint,
    cells: Cells,
    floor: Floor,
    point_map: PointMap,
    volume_m3: float,
    unseen: float,
    doubtful_m3: float,
) -> Doubt:
    """All signs at once: their warnings, and what they add to the interval.

    unseen: share of the floor. doubtful_m3: counted as material, and may be objects.
    """
    area = e.grid.cell_area_m2 * e.share
    pile_area, total = float(area[e.pile].sum()), float(area.sum())
    said: list[str] = list(footprint.warnings)
    extra: list[float] = [doubtful_m3]
    if not footprint.has_walls:
        said.append("no closed walls were found: the volume is of the map's own extent, its edge cut where returns end")
        if len(point_map.path_map):
            extra.append(0.05 * abs(volume_m3))
        face_m2 = _cut_face_m2(e)
        if face_m2 > CUT_FACE_M2:
            said.append(
                f"the material goes on beyond the edge of the map, over a face of {face_m2:.0f} m2: some is missing"
            )
            extra.append(face_m2 * 0.5 * math.sqrt(total))  # as far again as half the map reaches
    elif footprint.beyond_ratio > BEYOND_WALLS:
        said.append(
            f"{100 * footprint.beyond_ratio:.0f} % of the returns lie beyond the walls that were found: "
            "they may be the wrong ones, or have openings"
        )
        extra.append(footprint.beyond_ratio * abs(volume_m3))
    if footprint.pose_sigma_m > max(WALLS_DOUBLED_M, 3.0 * point_map.position_sigma_m):
        said.append(
            f"the keyframes disagree on the walls by {footprint.pose_sigma_m:.2f} m (1 sigma), "
            f"the odometry told {point_map.position_sigma_m:.2f} m: poses are not consistent"
        )
        extra.append(footprint.pose_sigma_m / math.sqrt(DRIFTS) * flank_m2(e))
    if e.poses.floor_disagreement_m > FLOOR_DOUBLED_M:
        said.append(
            f"the keyframes disagree on the floor by {e.poses.floor_disagreement_m:.3f} m (1 sigma): "
            "their heights or the attitude are off"
        )
        # An attitude that is off bends floor and pile alike all along the lap: that does not average out.
        extra.append(e.poses.floor_disagreement_m * pile_area)
    if cells.dropped_ratio > IN_THE_AIR:
        said.append(f"{100 * cells.dropped_ratio:.0f} % of the returns were not of the surface: dust, or poor poses")
        extra.append(0.1 * cells.dropped_ratio * abs(volume_m3))
    floor_share = float(area[floor.cells].sum()) / total if total else 0.0
    if not floor.found:
        said.append("no floor could be told: the volume counts from the lowest surface seen")
        extra.append(0.3 * pile_area)
    elif floor_share < FLOOR_SEEN and floor.cells.any():
        said.append(
            f"only {100 * floor_share:.1f} % of the area within the walls shows bare floor: it may not be the floor"
        )
        extra.append(0.05 * pile_area)
    pit = (e.height_m < -PIT_DEPTH_M) & (e.surface.state == CellState.SEEN)
    pit_m2 = float(area[pit].sum())
    if pit_m2 > PIT_M2:
        said.append(
            f"{pit_m2:.0f} m2 lie up to {-float(e.height_m[pit].min()):.1f} m below the floor that was found: "
            "it may not be the floor, or z is not up"
        )
        extra.append(float((-e.height_m * area)[pit].sum()))
    if floor.undulation_m > FLOOR_BENT_M:
        said.append(f"the floor departs from a plane by {floor.undulation_m:.2f} m (1 sigma) over a few metres")
    if unseen > UNSEEN:
        said.append(f"{100 * unseen:.0f} % of the floor was not seen: what lies there is guessed from its surroundings")

    def share_of_pile(where: Mask) -> float:
        return float(area[e.pile & where].sum()) / pile_area if pile_area else 0.0

    hidden = share_of_pile(e.surface.state == CellState.UNSEEN)
    if hidden > UNSEEN_IN_PILE:
        said.append(f"{100 * hidden:.0f} % of the pile's own area was not seen: its height there is guessed")
    in_gaps = share_of_pile((e.surface.state == CellState.INTERPOLATED) & (e.surface.gap_m > WIDE_GAP_M))
    if in_gaps > IN_WIDE_GAPS:
        said.append(
            f"{100 * in_gaps:.0f} % of the pile's own area lies farther than {WIDE_GAP_M:g} m from anything that was seen, on "
            "straight lines across gaps: scans that are nearer together, or more layers, would show it"
        )
        extra.append(gaps_together_m3(e))
    thin = float(np.median(cells.kept[cells.seen])) if cells.seen.any() else 0.0
    if thin < THIN_CELLS:
        said.append(f"the map is thin: {thin:.0f} returns in the median cell of {e.grid.cell_m:g} m")
    return Doubt(sigma_m3=math.sqrt(sum(v * v for v in extra)), warnings=tuple(said))


def _cut_face_m2(e: Evidence) -> float:
    """Area of the face along which the edge of the map cuts the material."""
    rim = (e.share > 0) & ~ndimage.binary_erosion(e.share > 0)
    return float(np.maximum(e.height_m, 0.0)[rim & e.pile].sum()) * e.grid.cell_m
