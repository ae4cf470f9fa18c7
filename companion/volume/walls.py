"""Where the walls are, read from the map: the footprint of the store and what stands upright in it.

No number here is set for one hall: walls are what the rays met at flight height (or, in a cloud without a path, what
spreads far in height over one spot), the footprint is what they enclose, each stretch is then fitted to its points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from companion.messages import Array, PointMap
from companion.volume.columns import measure_column
from companion.volume.edges import EdgeFit, fit_edges, pose_disagreement
from companion.volume.grid import Grid, Index, Mask, cells_of, disc
from companion.volume.polygon import contains, coverage, edge_distance, outline, resample

SLAB_HALF_M = 0.75  # about the flight height: every ray of the horizontal layer ends on something upright
UPRIGHT_SPREAD_M = 1.2  # height spread over one cell that no slope of loose material reaches
BRIDGED_GAPS_M = (0.75, 1.5, 3.0)  # holes in the walls that are still closed, tried in this order
MAX_FIT_POINTS = 150_000
FILLED_LEVELS = (0.1, 0.2, 0.4, 0.03)  # how full a wall's cell is against the fullest; dust fills few cells so well
UNMEASURED = 1.0 / 12.0**0.5  # 1 sigma of what an obstacle's foot holds: anything from nothing to all of it
LEAST_SHARE = 0.01  # of a cell that an obstacle covers: it stays one within the walls
WITHIN_ENOUGH = 0.97  # share of all returns that true walls hold in, but for noise and open doors


@dataclass(frozen=True, slots=True, kw_only=True)
class Footprint:
    """What the walls enclose.

    polygon_m: (V, 2) counter-clockwise, in map. has_walls: False where the map's own extent had to do.
    share: (ny, nx) part of each cell inside the walls and outside obstacles. cut_unsure: (ny, nx) 1 sigma of what obstacles
    cut from it, over that. depth_m: (ny, nx) distance to the nearest wall, negative outside. blocked: cells whose
    returns belong to obstacles. noise_m: 1 sigma of wall returns about the fitted walls. fit_sigma_m: of the walls' own
    place. pose_sigma_m: how far single keyframes disagree on it; NaN where it cannot be told. fits: the stretches of wall;
    fit_keyframe: (F,) of the points that they were fitted to. beyond_ratio: share of all returns that lie beyond the walls,
    farther than noise throws them.
    """

    polygon_m: Array
    has_walls: bool
    share: Array
    cut_unsure: Array
    depth_m: Array
    blocked: Mask
    noise_m: float
    fit_sigma_m: float
    pose_sigma_m: float
    fits: tuple[EdgeFit, ...]
    fit_keyframe: Index
    ceiling_m: float
    beyond_ratio: float
    warnings: tuple[str, ...]

    @property
    def margin_m(self) -> float:
        """Nearer to a wall than this, a return may be the wall's: beyond 3 sigma of it."""
        return 3.0 * self.noise_m + 0.05 if self.has_walls else 0.0


def cruise_height(path_map: Array) -> float | None:
    """Height of the flown lap, None without a path: the median over what was flown in the upper half."""
    if len(path_map) < 2:
        return None
    z = path_map[:, 2]
    return float(np.median(z[z >= 0.5 * (z.min() + z.max())]))


def find_footprint(point_map: PointMap, grid: Grid, key: Index) -> Footprint:
    """Fit the walls. Never raises for a poor map: `has_walls` and `warnings` tell."""
    fly_z = cruise_height(point_map.path_map)
    if fly_z is not None:
        upright = np.abs(point_map.points_map[:, 2] - fly_z) < SLAB_HALF_M
        ceiling = fly_z + SLAB_HALF_M
    else:
        upright = _upright_without_path(point_map.points_map, grid, key)
        ceiling = np.inf
    upright &= key >= 0
    count = grid.count(key[upright])
    best: tuple[float, Mask, Mask] | None = None
    for level in FILLED_LEVELS:
        structure = _structure_cells(count, level)
        region = _enclosed(structure, grid, key, point_map.path_map, fly_z)
        if region is None:
            continue
        held = ndimage.binary_dilation(region, disc(cells_of(1.0, grid)))
        within = float(np.mean(held.ravel()[np.maximum(key, 0)] & (key >= 0)))
        if best is None or within > best[0]:
            best = (within, structure, region)
        if within >= WITHIN_ENOUGH:
            break
    if best is None:
        return _open_footprint(grid, key, ceiling)
    footprint = _closed_footprint(point_map, grid, key, upright, best[1], best[2], ceiling)
    return replace(footprint, beyond_ratio=1.0 - best[0])


def _upright_without_path(points: Array, grid: Grid, key: Index) -> Mask:
    """Points on upright things: the cell's heights run without a gap over more than any slope can explain."""
    order = np.lexsort((points[:, 2], key))
    k, z = key[order], points[order, 2]
    new_run = np.ones(len(k), dtype=np.bool_)
    new_run[1:] = (k[1:] != k[:-1]) | (np.diff(z) > 0.6)
    run = np.cumsum(new_run) - 1
    first = np.flatnonzero(new_run)
    last = np.append(first[1:], len(k)) - 1
    # The run without its outermost points: two strays do not make a wall.
    inner_first = np.minimum(first + 2, last)
    inner_last = np.maximum(last - 2, first)
    upright_run = z[inner_last] - z[inner_first] > UPRIGHT_SPREAD_M + grid.cell_m
    foot = z[first]
    upright = np.zeros(len(points), dtype=np.bool_)
    upright[order] = upright_run[run] & (z > foot[run] + 0.5)
    return upright


def _structure_cells(count: Array, level: float) -> Mask:
    """Cells that upright returns fill well, against the best-filled cell nearby (noise thins out to the sides)."""
    filled = count[count > 0]
    if len(filled) == 0:
        return np.zeros(count.shape, dtype=np.bool_)
    least = max(3.0, level * float(np.quantile(filled, 0.95)))
    nearby = ndimage.maximum_filter(count, size=7, mode="constant")
    return np.asarray((count >= least) & (count >= 0.15 * nearby))


def _enclosed(structure: Mask, grid: Grid, key: Index, path: Array, fly_z: float | None) -> Mask | None:
    """The cells that the walls enclose around the path (or around most of the cloud); None where they leak."""
    if not structure.any():
        return None
    seeds = np.zeros(grid.shape, dtype=np.bool_)
    if fly_z is not None:
        path_key = grid.key(path[path[:, 2] > fly_z - SLAB_HALF_M])
        seeds.ravel()[path_key[path_key >= 0]] = True
    else:
        seeds.ravel()[key[key >= 0]] = True
    for gap_m in BRIDGED_GAPS_M:
        reach = cells_of(gap_m / 2, grid)
        barrier = ndimage.binary_dilation(structure, disc(reach))
        label, n = ndimage.label(~barrier)
        votes = np.bincount(label[seeds & ~barrier], minlength=n + 1)
        votes[0] = 0
        border = np.unique(np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]]))
        if fly_z is None:
            votes[border] = 0
        winner = int(np.argmax(votes))
        if votes[winner] == 0 or winner in border:
            continue
        region = ndimage.binary_dilation(label == winner, disc(reach)) & ~structure
        label, n = ndimage.label(region)
        region = label == int(np.argmax(np.bincount(label[region]))) if n > 1 else region
        region = np.asarray(ndimage.binary_fill_holes(region))
        data = grid.count(key) > 0
        if (data & region).sum() >= 0.2 * data.sum():
            return region
    return None


def _open_footprint(grid: Grid, key: Index, ceiling: float) -> Footprint:
    """No walls: the extent of the map itself."""
    data = ndimage.binary_opening(grid.count(key) > 0, disc(1))
    reach = cells_of(1.5, grid)
    padded = np.pad(data, reach)
    closed = ndimage.binary_closing(padded, disc(reach))[reach:-reach, reach:-reach]
    label, n = ndimage.label(ndimage.binary_fill_holes(closed))
    if n == 0:
        region = np.zeros(grid.shape, dtype=np.bool_)
    else:
        sizes = np.bincount(label.ravel())
        sizes[0] = 0
        region = label == int(np.argmax(sizes))
    depth = ndimage.distance_transform_edt(np.pad(region, 1))[1:-1, 1:-1] * grid.cell_m
    return Footprint(
        polygon_m=outline(region, grid),
        has_walls=False,
        share=region.astype(np.float64),
        cut_unsure=np.full(grid.shape, UNMEASURED),
        depth_m=np.where(region, depth, -grid.cell_m),
        blocked=np.zeros(grid.shape, dtype=np.bool_),
        noise_m=0.0,
        fit_sigma_m=0.0,
        pose_sigma_m=float("nan"),
        fits=(),
        fit_keyframe=np.zeros(0, dtype=np.int64),
        ceiling_m=ceiling,
        beyond_ratio=0.0,
        warnings=(),
    )


def _closed_footprint(
    point_map: PointMap, grid: Grid, key: Index, upright: Mask, structure: Mask, region: Mask, ceiling: float
) -> Footprint:
    wall = np.flatnonzero(upright)
    wall = wall[:: max(1, len(wall) // MAX_FIT_POINTS)]
    points = point_map.points_map[wall, :2]
    rough = resample(outline(region, grid), 0.4)
    fine, spread = _pull_to_wall(rough, points)
    polygon, fits = fit_edges(fine, points, spread)
    noise = float(np.median([f.noise_m for f in fits])) if fits else spread
    keyframe = point_map.keyframe_id[wall]
    cx, cy = grid.centres()
    inside = contains(polygon, cx, cy)
    depth = np.where(inside, 1.0, -1.0) * edge_distance(polygon, cx, cy)
    footprint = Footprint(
        polygon_m=polygon,
        has_walls=True,
        share=coverage(polygon, grid),
        cut_unsure=np.full(grid.shape, UNMEASURED),
        depth_m=depth,
        blocked=np.zeros(grid.shape, dtype=np.bool_),
        noise_m=noise,
        fit_sigma_m=float(np.median([f.waviness_m for f in fits])) if fits else grid.cell_m,
        pose_sigma_m=pose_disagreement(fits, keyframe),
        fits=tuple(fits),
        fit_keyframe=keyframe,
        ceiling_m=ceiling,
        beyond_ratio=0.0,
        warnings=(),
    )
    return _cut_obstacles(footprint, point_map.points_map, grid, key, structure, upright)


def _pull_to_wall(loop: Array, points: Array) -> tuple[Array, float]:
    """Move each point of the rough outline onto the middle of the wall returns before it.

    Returns: the moved loop; 1 sigma of the returns across the wall.
    """
    tree = cKDTree(points)
    ahead = np.roll(loop, -2, axis=0) - np.roll(loop, 2, axis=0)
    normals = np.column_stack([ahead[:, 1], -ahead[:, 0]]) / np.maximum(np.hypot(*ahead.T), 1e-9)[:, None]
    fine = loop.copy()
    spreads = []
    for i, near in enumerate(tree.query_ball_point(loop + 0.4 * normals, r=1.3)):
        if len(near) < 10:
            continue
        d = points[near] - loop[i]
        across = d @ normals[i]
        along = d @ np.array([-normals[i, 1], normals[i, 0]])
        across = across[np.abs(along) < 0.5]
        if len(across) < 10:
            continue
        middle = float(np.median(across))
        for _ in range(3):
            sigma = max(1.4826 * float(np.median(np.abs(across - middle))), 0.01)
            near_middle = across[np.abs(across - middle) < 3 * sigma]
            middle = float(near_middle.mean())
        fine[i] = loop[i] + middle * normals[i]
        spreads.append(sigma)
    return fine, float(np.median(spreads)) if spreads else 0.1


def _cut_obstacles(
    footprint: Footprint, points: Array, grid: Grid, key: Index, structure: Mask, upright: Mask
) -> Footprint:
    """Columns and the like: upright things inside the walls. Their returns go, and the floor that they cover."""
    free_of_wall = footprint.depth_m > footprint.margin_m + grid.cell_m
    label, n = ndimage.label(structure & free_of_wall, np.ones((3, 3)))
    if n == 0:
        return footprint
    blocked = np.zeros(grid.shape, dtype=np.bool_)
    share, unsure = footprint.share.copy(), footprint.cut_unsure.copy()
    warnings = list(footprint.warnings)
    standing = points[upright, :2]
    at = label.ravel()[np.maximum(key, 0)] * (key >= 0)
    for i in range(1, n + 1):
        z = points[at == i, 2]
        body = label == i
        if np.quantile(z, 0.95) - np.quantile(z, 0.05) < UPRIGHT_SPREAD_M:
            if body.sum() * grid.cell_area_m2 > 0.5:
                y, x = (float(c) * grid.cell_m for c in ndimage.center_of_mass(body))
                warnings.append(
                    f"material or a roof reaches the flight height near x {grid.x0_m + x:.1f} m, "
                    f"y {grid.y0_m + y:.1f} m: what is hidden behind it is not known"
                )
            continue
        body = ndimage.binary_fill_holes(body)
        blocked |= ndimage.binary_dilation(body, disc(cells_of(footprint.margin_m, grid)))
        column = measure_column(points[(at == i) & upright, :2], standing, footprint.noise_m)
        if column is not None:
            covered = coverage(column.outline_m, grid)
            share *= np.maximum(1.0 - covered, LEAST_SHARE)
            unsure[covered > 0] = column.sigma_m2 / column.area_m2
            continue
        cells_area = float(body.sum()) * grid.cell_area_m2
        radius = np.sqrt(cells_area / np.pi)
        true_radius = max(radius - 1.2 * footprint.noise_m - 0.3 * grid.cell_m, 0.3 * radius)
        share[body] *= 1.0 - (true_radius / radius) ** 2
    return replace(footprint, share=share, cut_unsure=unsure, blocked=blocked, warnings=tuple(warnings))
