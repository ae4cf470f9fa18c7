"""What the volume's interval is made of: each part is a 1 sigma in m3, named, and they add in quadrature.

The parts follow from the map itself wherever it can tell (spread of returns, disagreement of keyframes on walls and
floor, undulation of the floor, cross-validation of the interpolation); constants below are the few it cannot tell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np
from scipy import ndimage

from companion.messages import Array
from companion.volume.bending import Bending
from companion.volume.contact import Contact
from companion.volume.floor import BLOCK_M, FROM_M, TO_M, Floor
from companion.volume.grid import Grid, Index, Mask, squares
from companion.volume.keyframes import DRIFTS
from companion.volume.material import RIM_M
from companion.volume.poses import PoseErrors
from companion.volume.surface import Cells, CellState, Surface

STEP_M = 0.5  # across the rim
SLOWEST = 0.8  # of a step's height the next has so much: slower no foot runs out
GAP_M = 4.0  # seen cells so far apart on a gap's rim err on their own
CONTRADICTED = 0.5  # of what walls would change of the volume: the truth lies between them and the odometry
BESIDE_FLOOR = 0.2  # of an error in height is left where the same scans see the floor around


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """All that the error budget looks at. position_sigma_m, height_sigma_m: as told by the odometry.
    bending: None where the map does not tell its beams."""

    grid: Grid
    cells: Cells
    surface: Surface
    hidden_sigma_m: Array
    contact: Contact
    floor: Floor
    rise_sigma_m: Array
    waves_m: float
    height_m: Array
    share: Array
    cut_unsure: Array
    pile: Mask
    depth_m: Array
    poses: PoseErrors
    range_offset_sigma_m: float
    bending: Bending | None
    position_sigma_m: float
    height_sigma_m: float
    wall_sigma_m: float


def error_budget(e: Evidence) -> dict[str, float]:
    """1 sigma of each part, m3."""
    area = e.grid.cell_area_m2 * e.share * e.pile
    per_range = None if e.bending is None else e.bending.per_range_m2
    if per_range is None:
        per_range = _guessed_per_range(area, _flanks(e, area))
    gaps, hidden = _interpolation(e, area)
    returns = _sampling(e, area)
    spread = e.poses.spread_m3
    return {
        "returns": returns,
        # Stretches differ by their returns' noise too, which is counted already.
        "poses": _told_poses(e, float(area.sum())) if spread is None else math.sqrt(max(spread**2 - returns**2, 0.0)),
        "turns": e.poses.turns_m3,
        "scale": 0.0 if e.bending is None else CONTRADICTED * abs(e.bending.contradicted_m3),
        "range": e.range_offset_sigma_m * abs(per_range),
        "floor": math.hypot(_floor(e, area), _thin(e)),
        # Who maps the wall is not who maps what lies on it: a slow drift between them shows in no stretch.
        "walls": math.hypot(e.wall_sigma_m, e.position_sigma_m) * e.poses.face_m2,
        "contact": _contact_height(e, area),
        "interpolated": gaps,
        "unseen": math.hypot(hidden, _shadows(e)),
        "obstacles": _obstacles(e),
    }


def interval(volume_m3: float, budget: dict[str, float], level: float) -> tuple[float, float]:
    """Two-sided interval; no volume is less than nothing."""
    half = NormalDist().inv_cdf(0.5 + level / 2) * math.sqrt(sum(v * v for v in budget.values()))
    return max(volume_m3 - half, min(volume_m3, 0.0)), volume_m3 + half


def _sampling(e: Evidence, area: Array) -> float:
    sigma = np.nan_to_num(e.cells.sigma_m)
    return math.sqrt(float(np.sum((area * sigma) ** 2)))


def _told_poses(e: Evidence, pile_m2: float) -> float:
    """What the odometry's own word for its errors makes of them over a lap."""
    return math.hypot(flank_m2(e) * e.position_sigma_m, pile_m2 * e.height_sigma_m * BESIDE_FLOOR) / math.sqrt(DRIFTS)


def flank_m2(e: Evidence) -> float:
    """The volume that a metre of error in plan moves, of another way on each side of the pile."""
    return math.sqrt(sum(f * f for f in _flanks(e, e.grid.cell_area_m2 * e.share * e.pile)))


def _flanks(e: Evidence, area: Array) -> tuple[float, float, float, float]:
    """Area of the pile's flanks as seen from +x, -x, +y, -y: the volume that a metre of error there moves."""
    gx, gy = e.surface.slope_x * area, e.surface.slope_y * area
    sides = (np.maximum(gx, 0), np.maximum(-gx, 0), np.maximum(gy, 0), np.maximum(-gy, 0))
    a, b, c, d = (float(side.sum()) for side in sides)
    return a, b, c, d


def _guessed_per_range(area: Array, flanks: tuple[float, ...]) -> float:
    """Volume that a metre added to all ranges adds, where the map does not tell it: beams 20 to 45 deg down, from all sides."""
    return 0.3 * float(area.sum()) + 0.7 * sum(flanks)


def _floor(e: Evidence, area: Array) -> float:
    """The floor under the piles: from the floor around each, or from the plane's covariance where there is none; and the
    undulation that the pile hides."""
    around = np.isfinite(e.rise_sigma_m)
    near = _one_error_a_patch(around & e.pile, np.where(around, e.rise_sigma_m, 0.0) * area)
    far = np.where(around, 0.0, area)
    x, y = e.grid.centres()
    design = np.array([far.sum(), np.sum(far * (x - e.floor.centre_m[0])), np.sum(far * (y - e.floor.centre_m[1]))])
    plane = float(design @ e.floor.covariance @ design)
    hidden = e.waves_m**2 * float(area.sum()) * BLOCK_M**2
    return math.sqrt(near**2 + max(plane, 0.0) + hidden)


def _thin(e: Evidence) -> float:
    """What runs out beyond the rim too thin to be told from floor, or lifts what is taken for floor, where a foot does run out:
    dust on a floor is not material."""
    label, n = ndimage.label(e.pile)
    from_edge_m = ndimage.distance_transform_edt(e.pile | (e.share <= 0)) * e.grid.cell_m
    free = e.depth_m > e.grid.cell_m
    edge = e.pile & ~ndimage.binary_erosion(e.pile) & free
    out = 0.0
    for k in range(1, n + 1):
        own = label == k
        beyond_m2, lifted_m = _tail(e, own & free & (e.share > 0), from_edge_m)
        edge_m, area_m2 = float((edge & own).sum()) * e.grid.cell_m, float(e.share[own].sum()) * e.grid.cell_area_m2
        out += beyond_m2 * edge_m + lifted_m * area_m2
    return out


def _tail(e: Evidence, own: Mask, from_edge_m: Array) -> tuple[float, float]:
    """What lies beyond the rim of one pile, for each metre along it, and how high it lies where the floor is told: as its
    foot runs out within the rim, so it goes on."""
    bands = [own & (from_edge_m > RIM_M - far) & (from_edge_m <= RIM_M - far + STEP_M) for far in (STEP_M, 2 * STEP_M)]
    first, second = (float(np.mean(e.height_m[band])) if band.any() else 0.0 for band in bands)
    if first <= 0.0 or second <= 0.0:
        return 0.0, 0.0
    ratio = min(second / first, SLOWEST)
    at_edge_m = first * ratio ** (RIM_M / STEP_M)
    ring = np.arange(FROM_M, TO_M + STEP_M, STEP_M) / STEP_M
    return at_edge_m * STEP_M / (1.0 - ratio), at_edge_m * float(np.mean(ratio**ring))


def _contact_height(e: Evidence, area: Array) -> float:
    """Height at which the material meets the walls; neighbouring steps share their returns."""
    known = e.contact.step >= 0
    each = np.bincount(e.contact.step[known], (area * e.contact.sigma_m)[known])
    return math.sqrt(2.0 * float(np.sum(each**2)))


def _interpolation(e: Evidence, area: Array) -> tuple[float, float]:
    """Gaps, and what was not seen: the error grows with distance to the nearest seen cell."""
    state = e.surface.state
    per_m = roughness(e)
    out = []
    for wanted in (CellState.INTERPOLATED, CellState.UNSEEN):
        reach = per_m * np.minimum(e.surface.gap_m, 10.0)
        if wanted == CellState.UNSEEN:
            reach = np.maximum(3.0 * reach, 0.3 * np.minimum(e.surface.gap_m, 10.0))
        # Outside the pile, too, something may lie where nothing was seen.
        weight = e.grid.cell_area_m2 * e.share * np.where(e.pile, 1.0, 0.5 if wanted == CellState.UNSEEN else 0.1)
        # A gap is narrow and may be long: errors a few metres apart on the seen cells beside it are not the same.
        square = squares(e.grid, GAP_M) if wanted == CellState.INTERPOLATED else None
        out.append(_one_error_a_patch((state == wanted) & (e.share > 0), reach * weight, square))
    return out[0], out[1]


def gaps_together_m3(e: Evidence) -> float:
    """What gaps within the piles hold, if all of them err alike: where a good part of a pile lies in gaps, they do."""
    gaps = (e.surface.state == CellState.INTERPOLATED) & e.pile
    return roughness(e) * float(np.sum((e.surface.gap_m * e.share)[gaps])) * e.grid.cell_area_m2


def _one_error_a_patch(where: Mask, m3: Array, square: Index | None = None) -> float:
    """The sum of m3 over each connected patch, in quadrature; square: (ny, nx), patches are cut along their edges."""
    patch, _ = ndimage.label(where)
    if square is not None:
        patch = patch * (square.max() + 1) + square
    _, index = np.unique(patch[where], return_inverse=True)
    return math.sqrt(float(np.sum(np.bincount(index, m3[where]) ** 2)))


def _shadows(e: Evidence) -> float:
    """What crests hide: one error for each patch."""
    return _one_error_a_patch(e.hidden_sigma_m > 0, e.hidden_sigma_m * e.grid.cell_area_m2 * e.share)


def roughness(e: Evidence) -> float:
    """Error of linear interpolation per metre of distance, from cells left out: each against the mean of the seen
    cells three to either side of it."""
    z = np.where(e.cells.seen & e.pile, e.surface.z_m, np.nan)
    errors = []
    step = max(1, round(0.75 / e.grid.cell_m))
    for axis in (0, 1):
        a, b = np.roll(z, step, axis), np.roll(z, -step, axis)
        d = z - 0.5 * (a + b)
        errors.append(d[np.isfinite(d)])
    all_errors = np.concatenate(errors)
    if len(all_errors) < 20:
        return 0.3
    return max(float(np.sqrt(np.mean(all_errors**2))), 0.02) / (step * e.grid.cell_m)


def _obstacles(e: Evidence) -> float:
    """What the obstacles that stand in the pile take from it, by how well the foot of each is known."""
    inside = e.pile & (e.share < 1.0) & (e.depth_m > 2 * e.grid.cell_m)
    cut = (1.0 - e.share) * e.cut_unsure * e.grid.cell_area_m2 * np.maximum(e.height_m, 0.0)
    return _one_error_a_patch(inside, np.where(inside, cut, 0.0))
