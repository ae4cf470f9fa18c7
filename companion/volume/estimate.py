"""PointMap -> VolumeReport: walls, cells, floor, surface, sum, interval."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from companion.config import VolumeConfig
from companion.messages import Array, PointMap, VolumeReport
from companion.volume.beams import where_beams_meet
from companion.volume.bending import bending
from companion.volume.contact import Contact, fit_contact
from companion.volume.doubt import doubt
from companion.volume.floor import Floor, fit_floor, floor_around, floor_beside, floor_beyond, level_floor, waves_m
from companion.volume.grid import Grid, Index, Mask, grid_around
from companion.volume.interval import Evidence, error_budget, interval
from companion.volume.jackknife import cut_in_stretches
from companion.volume.material import pile_mask
from companion.volume.objects import LARGEST_CELL_M, Objects, find_objects, on_grid, without_objects
from companion.volume.poses import pose_errors, wall_faces
from companion.volume.shadow import Shadow, lay_hidden
from companion.volume.surface import Cells, CellState, Surface, build_surface, robust_cells, without_strays
from companion.volume.walls import UNMEASURED, Footprint, find_footprint

MIN_MAP_POINTS = 200
INTERPOLATION_REACH_M = 2.0  # up to here from a seen cell a height is called interpolated, beyond it unseen

LEAST_FROM_ABOVE = 0.3  # of the map's points
BESIDE_WALLS_M = 1.0  # beyond the strip
SLIVERS_M = 0.5  # the same
LEAST_WALL_SIGMA_M = 0.003  # of a wall's place, however straight its returns lie


def estimate_volume(
    point_map: PointMap, cfg: VolumeConfig, *, floor_z_m: float | None = None, is_cut_short: bool = False
) -> VolumeReport:
    """Volume of the material above the floor and within the walls, with its interval.

    Args:
        point_map: in `map`, z up. A path is used when there is one (where it is free, how high was flown).
        cfg: cell size and level of the interval.
        floor_z_m: height of a level floor, taken as exact; None: the floor is found in the map.
        is_cut_short: the flight did not go all round: where no closed walls are found either, nobody knows how much lies
            beyond the map, and the interval has no upper end.

    Returns: the report. A poor map is told by `warnings` and a wide interval, never by an exception; a map that shows
        no surface at all gives volume NaN and the interval (0, inf).
    """
    points, told = point_map.points_map, point_map.scan_index
    if told is not None and (len(told) != len(points) or not ((told >= 0) & (told < len(point_map.path_map))).all()):
        point_map = replace(point_map, scan_index=None)  # of another path, or another cloud
    finite: Mask = np.asarray(np.isfinite(points).all(axis=1))
    if not finite.all():
        point_map = point_map.only(finite)
        points = point_map.points_map
    if len(points) < MIN_MAP_POINTS:
        return _nothing(cfg, f"the map has only {len(points)} points: no surface can be told")
    point_map = _seen_from_above(point_map)
    points = point_map.points_map
    relief = _relief(point_map, cfg.cell_m, floor_z_m)
    if relief is None:
        return _nothing(cfg, "the map shows no surface within the walls")
    objects = _find_objects(relief, point_map, floor_z_m)
    report = _report(point_map, cfg, relief, objects)
    return _at_least(report) if is_cut_short and not relief.footprint.has_walls else report


@dataclass(frozen=True, slots=True, kw_only=True)
class _Relief:
    """What the map shows on one grid."""

    grid: Grid
    footprint: Footprint
    cells: Cells
    floor: Floor
    contact: Contact
    shadow: Shadow

    def height_m(self) -> Array:
        """(ny, nx) of the surface above the floor, 0 where it is not known."""
        floor_z = np.where(self.footprint.share > 0, self.floor.z(*self.grid.centres()), np.nan)
        return np.asarray(np.nan_to_num(self.shadow.surface.z_m - floor_z))


def _relief(point_map: PointMap, cell_m: float, floor_z_m: float | None) -> _Relief | None:
    """None: no surface within the walls."""
    points = point_map.points_map
    grid = grid_around(points, cell_m)
    key = grid.key(points)
    footprint = find_footprint(point_map, grid, key)
    strip = (footprint.depth_m < footprint.margin_m + 0.5 * grid.cell_m) | footprint.blocked
    low = points[:, 2] < footprint.ceiling_m
    wanted = (key >= 0) & low & ~strip.ravel()[np.maximum(key, 0)]
    cells = robust_cells(points, np.where(wanted, key, -1), grid)
    cells = where_beams_meet(point_map, cells, grid, ~strip & (footprint.share > 0), footprint.noise_m)
    if footprint.has_walls:
        cells = without_strays(cells, grid, footprint.depth_m < footprint.margin_m + BESIDE_WALLS_M)
    usable = cells.seen & (footprint.share > 0)
    if usable.sum() < 20:
        return None
    if floor_z_m is None:
        floor = fit_floor(grid, cells.x, cells.y, cells.z, cells.sigma_m, usable)
    else:
        floor = level_floor(grid, floor_z_m)
    # Beside the strip slivers between cells far apart along the wall would bridge what the slope tells.
    beside = (footprint.depth_m < footprint.margin_m + SLIVERS_M) & ~cells.seen
    surface = build_surface(
        grid,
        cells,
        footprint.share > 0,
        strip | beside,
        reach_m=INTERPOLATION_REACH_M,
        strip_width_m=footprint.margin_m,
    )
    surface, contact = _meet_walls(points, grid, np.where(low, key, -1), footprint, floor, surface)
    shadow = lay_hidden(point_map, grid, surface, floor.z(*grid.centres()), footprint.noise_m)
    return _Relief(grid=grid, footprint=footprint, cells=cells, floor=floor, contact=contact, shadow=shadow)


def _find_objects(relief: _Relief, point_map: PointMap, floor_z_m: float | None) -> Objects:
    """What stands upright in it, looked for in cells that are small enough to show it."""
    fine = relief if relief.grid.cell_m <= LARGEST_CELL_M else _relief(point_map, LARGEST_CELL_M, floor_z_m)
    if fine is None:
        fine = relief
    inside = fine.footprint.share > 0
    trusted = (
        inside & (fine.footprint.depth_m > fine.footprint.margin_m + 2 * fine.grid.cell_m) & ~fine.footprint.blocked
    )
    trusted &= ~ndimage.binary_dilation(fine.shadow.sigma_m > 0)
    objects = find_objects(fine.grid, fine.height_m(), inside, trusted)
    return objects if fine is relief else on_grid(objects, fine.grid, relief.grid)


def _at_least(report: VolumeReport) -> VolumeReport:
    said = "the flight was cut short and no closed walls were found: what lies beyond the map is not counted"
    return replace(report, interval_m3=(report.interval_m3[0], float("inf")), warnings=(*report.warnings, said))


def _meet_walls(
    points: Array, grid: Grid, key: Index, footprint: Footprint, floor: Floor, surface: Surface
) -> tuple[Surface, Contact]:
    """The surface brought to where the walls' returns say that it meets them."""
    strip = (np.abs(footprint.depth_m) < footprint.margin_m + 0.5 * grid.cell_m) & (footprint.share > 0)
    x, y = grid.centres()
    contact = fit_contact(
        grid, points, key, footprint.polygon_m, surface.carried_m, surface.carried_m - floor.z(x, y), strip,
        width_m=footprint.margin_m + grid.cell_m, noise_m=footprint.noise_m,
    )  # fmt: skip
    return replace(surface, z_m=surface.z_m + contact.rise_m), contact


def _report(point_map: PointMap, cfg: VolumeConfig, relief: _Relief, objects: Objects) -> VolumeReport:
    grid, cells, floor, shadow, surface = relief.grid, relief.cells, relief.floor, relief.shadow, relief.shadow.surface
    inside = relief.footprint.share > 0
    height = without_objects(grid, relief.height_m(), objects.covered, inside)
    floor_z = np.where(inside, floor.z(*grid.centres()), np.nan)
    footprint = replace(
        relief.footprint,
        share=relief.footprint.share * (1.0 - objects.share),
        warnings=(*relief.footprint.warnings, *objects.warnings),
    )
    pile = pile_mask(height, footprint.share > 0, cells, floor, grid)
    beyond = floor_beyond(floor, grid, cells.x, cells.y, cells.z, pile)
    if beyond is not floor:
        shift = np.where(inside, beyond.z(*grid.centres()) - floor_z, 0.0)
        height, floor_z, floor = height - shift, floor_z + shift, beyond
        pile = pile_mask(height, footprint.share > 0, cells, floor, grid)
    stretches = cut_in_stretches(point_map, grid, cells, surface, footprint.fit_keyframe)
    halves = None if stretches is None else stretches.halves_m()
    rise, rise_sigma = floor_beside(grid, floor, height, pile, halves)
    waves = waves_m(grid, floor, height, halves)
    height, floor_z = height - rise, floor_z + rise
    area = grid.cell_area_m2 * footprint.share
    volume = float(np.sum((height * area)[pile]))
    rings = [(own, ring if ring.any() else floor.cells) for own, ring in floor_around(grid, floor, pile)]
    faces = wall_faces(footprint, grid, (area * pile) > 0.0, height)
    poses = pose_errors(point_map, grid, cells, surface, footprint, floor, stretches, area * pile, rings, faces)
    bent = bending(point_map, grid, cells, surface, footprint, floor, area * pile, rings, faces)
    evidence = Evidence(
        grid=grid,
        cells=cells,
        surface=surface,
        hidden_sigma_m=shadow.sigma_m,
        contact=relief.contact,
        floor=floor,
        rise_sigma_m=rise_sigma,
        waves_m=waves,
        height_m=height,
        share=footprint.share,
        cut_unsure=np.where(objects.share > 0, UNMEASURED, footprint.cut_unsure),
        pile=pile,
        depth_m=footprint.depth_m,
        poses=poses,
        range_offset_sigma_m=cfg.range_offset_sigma_m,
        bending=bent,
        position_sigma_m=point_map.position_sigma_m,
        height_sigma_m=point_map.height_sigma_m,
        wall_sigma_m=float(np.hypot(footprint.fit_sigma_m, LEAST_WALL_SIGMA_M)) if footprint.has_walls else 0.0,
    )
    total = float(area.sum())
    ratio = {s: float(area[surface.state == s].sum()) / total for s in CellState}
    doubts = doubt(evidence, footprint, cells, floor, point_map, volume, ratio[CellState.UNSEEN], objects.doubtful_m3)
    budget = error_budget(evidence) | {"doubt": doubts.sigma_m3}
    return VolumeReport(
        volume_m3=volume,
        interval_m3=interval(volume, budget, cfg.interval_level),
        interval_level=cfg.interval_level,
        seen_ratio=ratio[CellState.SEEN],
        interpolated_ratio=ratio[CellState.INTERPOLATED],
        unseen_ratio=ratio[CellState.UNSEEN],
        floor_area_m2=total,
        pile_area_m2=float(area[pile].sum()),
        x_m=grid.x_m,
        y_m=grid.y_m,
        surface_z_m=surface.z_m,
        floor_z_m=floor_z,
        cell_state=surface.state,
        warnings=doubts.warnings,
        footprint_m=footprint.polygon_m,
        error_budget_m3=tuple(budget.items()),
    )


def _seen_from_above(point_map: PointMap) -> PointMap:
    """Without what was seen in the climb and the landing: the attitude's bias (0.2 to 0.4 deg) is found on the way up, and
    what was seen before, from afar and flat, is centimetres off. All of it where that would leave little."""
    if point_map.scan_index is None:
        return point_map
    height = point_map.path_map[point_map.scan_index, 2]
    keep = height >= 0.5 * np.median(height)
    return point_map.only(keep) if keep.sum() >= LEAST_FROM_ABOVE * len(keep) else point_map


def _nothing(cfg: VolumeConfig, why: str) -> VolumeReport:
    empty = np.zeros((0, 0))
    return VolumeReport(
        volume_m3=float("nan"),
        interval_m3=(0.0, float("inf")),
        interval_level=cfg.interval_level,
        seen_ratio=0.0,
        interpolated_ratio=0.0,
        unseen_ratio=1.0,
        floor_area_m2=0.0,
        pile_area_m2=0.0,
        x_m=np.zeros(0),
        y_m=np.zeros(0),
        surface_z_m=empty,
        floor_z_m=empty,
        cell_state=empty.astype(np.int8),
        warnings=(why,),
    )
