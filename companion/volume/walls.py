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
from companion.volume.grid import Grid, Index, Mask, cells_of, disc
from companion.volume.polygon import contains, coverage, edge_distance, outline, resample, signed_area, simplify_closed

SLAB_HALF_M = 0.75  # about the flight height: every ray of the horizontal layer ends on something upright
UPRIGHT_SPREAD_M = 1.2  # height spread over one cell that no slope of loose material reaches
BRIDGED_GAPS_M = (0.75, 1.5, 3.0)  # holes in the walls that are still closed, tried in this order
MAX_FIT_POINTS = 150_000
FILLED_LEVELS = (0.1, 0.2, 0.4, 0.03)  # how full a wall's cell is against the fullest; dust fills few cells so well
WITHIN_ENOUGH = 0.97  # share of all returns that true walls hold in, but for noise and open doors


@dataclass(frozen=True, slots=True, kw_only=True)
class Footprint:
    """What the walls enclose.

    polygon_m: (V, 2) counter-clockwise, in map. has_walls: False where the map's own extent had to do.
    share: (ny, nx) part of each cell inside the walls and outside obstacles. depth_m: (ny, nx) distance to the
    nearest wall, negative outside. blocked: cells whose returns belong to obstacles. noise_m: 1 sigma of wall returns
    about the fitted walls. fit_sigma_m: of the walls' own place. pose_sigma_m: how far the keyframes disagree on it.
    beyond_ratio: share of all returns that lie beyond the walls, farther than noise throws them.
    """

    polygon_m: Array
    has_walls: bool
    share: Array
    depth_m: Array
    blocked: Mask
    obstacle_area_m2: float
    noise_m: float
    fit_sigma_m: float
    pose_sigma_m: float
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
        depth_m=np.where(region, depth, -grid.cell_m),
        blocked=np.zeros(grid.shape, dtype=np.bool_),
        obstacle_area_m2=0.0,
        noise_m=0.0,
        fit_sigma_m=0.0,
        pose_sigma_m=0.0,
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
    polygon, fits = _fit_edges(fine, points, spread)
    noise = float(np.median([f.noise_m for f in fits])) if fits else spread
    cx, cy = grid.centres()
    inside = contains(polygon, cx, cy)
    depth = np.where(inside, 1.0, -1.0) * edge_distance(polygon, cx, cy)
    footprint = Footprint(
        polygon_m=polygon,
        has_walls=True,
        share=coverage(polygon, grid),
        depth_m=depth,
        blocked=np.zeros(grid.shape, dtype=np.bool_),
        obstacle_area_m2=0.0,
        noise_m=noise,
        fit_sigma_m=float(np.median([f.waviness_m for f in fits])) if fits else grid.cell_m,
        pose_sigma_m=_pose_disagreement(fits, points, point_map.keyframe_id[wall]),
        ceiling_m=ceiling,
        beyond_ratio=0.0,
        warnings=(),
    )
    return _cut_obstacles(footprint, point_map.points_map, grid, key, structure)


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


@dataclass(frozen=True, slots=True, kw_only=True)
class _EdgeFit:
    """One straight stretch: a point on it, its direction, and how its returns lie about it."""

    point: Array
    direction: Array
    noise_m: float
    waviness_m: float
    members: Index
    offsets_m: Array


def _fit_edges(loop: Array, points: Array, spread: float) -> tuple[Array, list[_EdgeFit]]:
    """Straight stretches by Douglas and Peucker, each fitted to its returns, joined at their intersections."""
    corners = loop[simplify_closed(loop, max(0.12, 0.7 * spread))]
    if signed_area(corners) < 0:
        corners = corners[::-1]
    ends = np.roll(corners, -1, axis=0)
    lines = [_fit_edge(a, b, points, spread) for a, b in zip(corners, ends, strict=True)]
    corners, lines = _without_chamfers(corners, ends, lines)
    vertices: list[Array] = []
    for i, corner in enumerate(corners):
        vertices += _join(lines[i - 1], lines[i], corner)
    return np.array(vertices), [line for line in lines if line is not None]


def _without_chamfers(corners: Array, ends: Array, lines: list[_EdgeFit | None]) -> tuple[Array, list[_EdgeFit | None]]:
    """Leave out the short cuts that smoothing draws across corners: where the walls on both sides meet just beyond."""
    count = len(lines)
    length = np.hypot(*(ends - corners).T)
    is_cut = length < 1.0
    if count < 4 or is_cut.all():
        return corners, lines
    start = int(np.flatnonzero(~is_cut)[0])
    kept: list[tuple[Array, _EdgeFit | None]] = []
    run: list[int] = []
    for k in [(start + n) % count for n in range(1, count + 1)]:
        if is_cut[k]:
            run.append(k)
            continue
        corner = corners[k]
        if run:
            middle = 0.5 * (corners[run[0]] + ends[run[-1]])
            before, after = lines[run[0] - 1], lines[k]
            is_corner = before is not None and after is not None and len(_join(before, after, middle)) == 1
            if is_corner and float(length[run].sum()) < 1.6:
                corner = middle
            else:
                kept += [(corners[r], lines[r]) for r in run]
        kept.append((corner, lines[k]))
        run = []
    return np.array([c for c, _ in kept]), [line for _, line in kept]


def _fit_edge(a: Array, b: Array, points: Array, spread: float) -> _EdgeFit | None:
    length = float(np.hypot(*(b - a)))
    if length < 0.8:
        return None
    direction = (b - a) / length
    trim = min(0.4, 0.2 * length)
    d = points - a
    along = d @ direction
    across = d @ np.array([direction[1], -direction[0]])
    near = np.flatnonzero((along > trim) & (along < length - trim) & (np.abs(across) < 6 * spread + 0.1))
    if len(near) < 30:
        return None
    s, e = along[near] - 0.5 * length, across[near]
    offset, slope, sigma = 0.0, 0.0, 2 * spread + 0.05
    for _ in range(5):
        r = e - offset - slope * s
        ok = np.abs(r) < 3.5 * sigma
        if ok.sum() < 20:
            return None
        slope, offset = (float(v) for v in np.polyfit(s[ok], e[ok], 1))
        sigma = max(1.4826 * float(np.median(np.abs(e[ok] - offset - slope * s[ok]))), 0.005)
    r = e - offset - slope * s
    ok = np.abs(r) < 3.5 * sigma
    normal = np.array([direction[1], -direction[0]])
    turned = direction + slope * normal
    return _EdgeFit(
        point=a + 0.5 * length * direction + offset * normal,
        direction=turned / np.hypot(*turned),
        noise_m=sigma,
        waviness_m=_waviness(s[ok], r[ok], length),
        members=near[ok],
        offsets_m=r[ok],
    )


def _waviness(s: Array, r: Array, length: float) -> float:
    """1 sigma of the wall's own place along the stretch: means over about 1 m, less what noise explains."""
    bins = max(2, int(length))
    index = np.clip(((s / length + 0.5) * bins).astype(np.int64), 0, bins - 1)
    n = np.bincount(index, minlength=bins)
    full = n >= 5
    if full.sum() < 2:
        return 0.0
    means = np.bincount(index, r, minlength=bins)[full] / n[full]
    explained = float(np.mean(np.var(r) / n[full]))
    return float(np.sqrt(max(float(np.mean(means**2)) - explained, 0.0)))


def _join(before: _EdgeFit | None, after: _EdgeFit | None, corner: Array) -> list[Array]:
    """The vertex (or two) where two stretches meet: their intersection where it is well placed."""
    if before is None and after is None:
        return [corner]
    if before is None or after is None:
        line = before or after
        assert line is not None
        return [line.point + ((corner - line.point) @ line.direction) * line.direction]
    cross = before.direction[0] * after.direction[1] - before.direction[1] * after.direction[0]
    if abs(cross) > 0.1:
        gap = after.point - before.point
        t = (gap[0] * after.direction[1] - gap[1] * after.direction[0]) / cross
        meeting = before.point + t * before.direction
        if np.hypot(*(meeting - corner)) < 1.0:
            return [meeting]
    return [line.point + ((corner - line.point) @ line.direction) * line.direction for line in (before, after)]


def _pose_disagreement(fits: list[_EdgeFit], points: Array, keyframe: Index) -> float:
    """How far the keyframes disagree on where a wall is, 1 sigma: their own mean offsets, less what noise explains."""
    total, weight = 0.0, 0.0
    for fit in fits:
        ids, index = np.unique(keyframe[fit.members], return_inverse=True)
        n = np.bincount(index)
        seen = n >= 8
        if len(ids) < 3 or seen.sum() < 3:
            continue
        means = np.bincount(index, fit.offsets_m)[seen] / n[seen]
        spread = float(np.median(np.abs(means - np.median(means))) * 1.4826) ** 2
        total += float(seen.sum()) * max(spread - float(np.mean(fit.noise_m**2 / n[seen])), 0.0)
        weight += float(seen.sum())
    return float(np.sqrt(total / weight)) if weight else 0.0


def _cut_obstacles(footprint: Footprint, points: Array, grid: Grid, key: Index, structure: Mask) -> Footprint:
    """Columns and the like: upright things inside the walls. Their returns go, and the floor that they cover."""
    free_of_wall = footprint.depth_m > footprint.margin_m + grid.cell_m
    label, n = ndimage.label(structure & free_of_wall, np.ones((3, 3)))
    if n == 0:
        return footprint
    blocked = np.zeros(grid.shape, dtype=np.bool_)
    share, area, warnings = footprint.share.copy(), 0.0, list(footprint.warnings)
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
        cells_area = float(body.sum()) * grid.cell_area_m2
        radius = np.sqrt(cells_area / np.pi)
        true_radius = max(radius - 1.2 * footprint.noise_m - 0.3 * grid.cell_m, 0.3 * radius)
        share[body] *= 1.0 - (true_radius / radius) ** 2
        area += float(np.pi * true_radius**2)
        blocked |= ndimage.binary_dilation(body, disc(cells_of(footprint.margin_m, grid)))
    return replace(footprint, share=share, blocked=blocked, obstacle_area_m2=area, warnings=tuple(warnings))
