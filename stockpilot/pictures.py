"""Pictures for people: the trajectory over the truth, the map, the surface. Colours that colour-blind readers can tell."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray

matplotlib.use("Agg")

from matplotlib import pyplot as plt
from matplotlib.colors import LightSource
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon

from companion.messages import Array, PointMap, VolumeReport

# Okabe and Ito's colours ("Color universal design", 2008).
BLACK, ORANGE, SKY, GREEN, BLUE, VERMILION, GREY = (
    "#000000", "#E69F00", "#56B4E9", "#009E73", "#0072B2", "#D55E00", "#8A8A8A",
)  # fmt: skip
HEIGHT_COLOURS = "viridis"
STYLE: Any = {
    "font.size": 10,
    "axes.titlesize": 11,
    "axes.grid": True,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "figure.constrained_layout.use": True,
}


def draw_trajectory(
    path: Path,
    *,
    outlines: Sequence[Array],
    truth_world_m: Array | None,
    estimated_world_m: Array,
    paper_world_m: Array | None = None,
    pile_outlines: Sequence[Array] = (),
    title: str = "",
) -> Path:
    """Plan of the hall with the flown path (truth), ours upon it and the paper's beside it; below, our error times 1.

    All in `world`, metres: outlines: rings (K, 2) of walls and obstacles; paths (N, 2). Where there is no truth (a real
    flight) all are in `map`, and the walls are those fitted.
    """
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(9, 6.2))
        for ring in pile_outlines:
            axes.add_patch(Polygon(ring, closed=True, facecolor="#EFE3CC", edgecolor="#C9B58C", lw=0.8, zorder=1))
        for ring in outlines:
            axes.add_patch(Polygon(ring, closed=True, facecolor="none", edgecolor=BLACK, lw=1.6, zorder=2))
        handles: list[Any] = [Line2D([], [], color=BLACK, lw=1.6, label="walls, obstacles")]
        if pile_outlines:
            handles.append(Patch(facecolor="#EFE3CC", edgecolor="#C9B58C", label="pile"))
        if truth_world_m is not None:
            axes.plot(*truth_world_m.T, color=SKY, lw=5.0, alpha=0.75, solid_capstyle="round", zorder=3)
            handles.append(Line2D([], [], color=SKY, lw=5, alpha=0.75, label="flown (truth)"))
        if paper_world_m is not None and len(paper_world_m):
            axes.plot(*paper_world_m.T, color=VERMILION, lw=1.2, ls="--", marker="o", ms=2.5, zorder=4)
            handles.append(
                Line2D([], [], color=VERMILION, lw=1.2, ls="--", marker="o", ms=3, label="estimated, the paper's")
            )
        if len(estimated_world_m):
            axes.plot(*estimated_world_m.T, color=BLUE, lw=1.3, zorder=5)
            handles.append(Line2D([], [], color=BLUE, lw=1.3, label="estimated, ours"))
            axes.plot(*estimated_world_m[0], marker="o", ms=8, mfc="white", mec=BLUE, mew=1.8, ls="", zorder=6)
            axes.plot(*estimated_world_m[-1], marker="X", ms=8, mfc=BLUE, mec="white", mew=0.8, ls="", zorder=7)
            handles.append(Line2D([], [], marker="o", mfc="white", mec=BLUE, ls="", ms=8, label="start"))
            handles.append(Line2D([], [], marker="X", mfc=BLUE, mec="white", ls="", ms=8, label="landing"))
        flown = estimated_world_m if truth_world_m is None else truth_world_m
        _plan(axes, [*outlines, flown], "map" if truth_world_m is None else "world")
        axes.set_title(title, loc="left")
        figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=9)
        return _save(figure, path)


def draw_map(path: Path, point_map: PointMap, *, title: str = "Map, coloured by height") -> Path:
    """The point map from above and from the side, coloured by height in `map`."""
    points = point_map.points_map
    with plt.rc_context(STYLE):
        if len(points) == 0:
            figure, axes = plt.subplots(figsize=(6, 3))
            axes.text(0.5, 0.5, "the map is empty", ha="center", va="center")
            axes.set_axis_off()
            return _save(figure, path)
        low, high = np.quantile(points, [0.001, 0.999], axis=0)
        span = np.maximum(high - low, 1.0)
        width = 9.0
        tall = float(np.clip(width * span[1] / span[0], 2.5, 9.0))
        flat = float(np.clip(width * span[2] / span[0], 1.0, 3.0))
        figure, (plan, side) = plt.subplots(2, 1, figsize=(width, tall + flat + 1.4), height_ratios=[tall, flat])
        picture, extent = _binned(points, low, high)
        shown: Any = {"cmap": HEIGHT_COLOURS, "vmin": low[2], "vmax": high[2]}
        dots = plan.imshow(picture, extent=extent, origin="lower", interpolation="nearest", **shown)
        plan.grid(visible=False)
        if len(point_map.path_map):
            plan.plot(*point_map.path_map[:, :2].T, color=VERMILION, lw=1.1, label="flown path")
            plan.legend(loc="upper right", frameon=True, framealpha=0.9, fontsize=9)
        _plan(plan, [np.vstack([low[:2], high[:2]])], "map")
        plan.set_title(f"{title} ({len(point_map.points_map):,} points)", loc="left")
        upright = [0, 2, 2]  # x to the right, z up, z the colour
        picture, extent = _binned(points[:, upright], low[upright], high[upright])
        side.imshow(picture, extent=extent, origin="lower", interpolation="nearest", **shown)
        side.grid(visible=False)
        side.set_xlim(plan.get_xlim())
        side.set_ylim(low[2] - 0.5, high[2] + 0.7)
        side.set_aspect("equal", adjustable="box")
        side.set_xlabel("x in map, m")
        side.set_ylabel("z in map, m")
        figure.colorbar(dots, ax=[plan, side], label="height z in map, m", shrink=0.8, pad=0.02)
        return _save(figure, path)


def _binned(points: Array, low: Array, high: Array) -> tuple[Array, tuple[float, float, float, float]]:
    """Mean of the third column by pixel of the first two, NaN where nothing was returned, and (left, right, bottom, top)."""
    pixel = max(float((high - low)[:2].max()) / 330, 0.02)
    shape = tuple(int(n) + 1 for n in np.ceil((high - low)[1::-1] / pixel + 6))
    column, row = (np.floor((points[:, i] - low[i]) / pixel).astype(np.int64) + 3 for i in (0, 1))
    inside = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1])
    key = row[inside] * shape[1] + column[inside]
    n = np.bincount(key, minlength=shape[0] * shape[1])
    total = np.bincount(key, points[inside, 2], minlength=n.size)
    with np.errstate(invalid="ignore"):
        picture = np.where(n > 0, total / np.maximum(n, 1), np.nan).reshape(shape)
    left, bottom = low[0] - 3 * pixel, low[1] - 3 * pixel
    return picture, (left, left + shape[1] * pixel, bottom, bottom + shape[0] * pixel)


def draw_surface(path: Path, report: VolumeReport, *, title: str | None = None) -> Path:
    """The surface in three dimensions, and its contours with what was seen, interpolated, unseen."""
    with plt.rc_context(STYLE):
        if report.surface_z_m.size == 0 or not np.isfinite(report.surface_z_m).any():
            figure, axes = plt.subplots(figsize=(6, 3))
            axes.text(0.5, 0.5, "no surface could be told", ha="center", va="center")
            axes.set_axis_off()
            return _save(figure, path)
        height = report.surface_z_m - report.floor_z_m
        rows, columns = (np.flatnonzero((report.cell_state > 0).any(axis=a)) for a in (1, 0))
        cut = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        x, y, height, state = report.x_m[cut[1]], report.y_m[cut[0]], height[cut], report.cell_state[cut]
        top = max(float(np.nanquantile(height, 0.9995)), 0.5)
        is_wide = np.ptp(x) >= np.ptp(y)
        figure = plt.figure(figsize=(9, 10) if is_wide else (12, 7))
        grid = figure.add_gridspec(2, 1, height_ratios=[1.15, 1]) if is_wide else figure.add_gridspec(1, 2)
        relief = figure.add_subplot(grid[0], projection="3d")
        _relief(relief, x, y, height, top)
        relief.set_title(title or f"Surface above the floor: {report.volume_m3:,.1f} m³", loc="left")
        plan = figure.add_subplot(grid[1])
        _contours(figure, plan, report, x, y, height, state, top)
        return _save(figure, path)


def _relief(axes: Any, x: Array, y: Array, height: Array, top: float) -> None:
    step = max(1, int(np.ceil(max(len(x), len(y)) / 110)))
    h = np.clip(height[::step, ::step], -0.5, top)
    gx, gy = np.meshgrid(x[::step], y[::step])
    light = LightSource(azdeg=315, altdeg=45)
    colours = plt.get_cmap(HEIGHT_COLOURS)(np.clip(np.nan_to_num(h) / top, 0, 1))
    shaded = light.shade_rgb(colours[..., :3], np.nan_to_num(h), blend_mode="soft", vert_exag=2.0)
    axes.plot_surface(gx, gy, h, facecolors=shaded, rstride=1, cstride=1, linewidth=0, antialiased=False)
    axes.set_box_aspect((np.ptp(x), np.ptp(y), 2.0 * top), zoom=1.15)
    axes.set_xlabel("x in map, m", labelpad=10)
    axes.set_ylabel("y in map, m", labelpad=8)
    axes.set_zlabel("height, m")
    axes.set_zticks(np.arange(0, top + 0.5, 2.0 if top > 3 else 1.0))
    axes.view_init(elev=28, azim=-62)
    axes.text2D(0.99, 0.02, "heights drawn twice as tall", transform=axes.transAxes, fontsize=8, color=GREY, ha="right")


def _contours(
    figure: Any, axes: Any, report: VolumeReport, x: Array, y: Array, height: Array, state: NDArray[np.int8], top: float
) -> None:
    interval = next(s for s in (0.1, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0) if top / s <= 16 or s == 10.0)
    levels = np.arange(0.0, top + interval, interval)
    filled = axes.contourf(x, y, np.clip(height, 0.0, None), levels=levels, cmap=HEIGHT_COLOURS, extend="max")
    lines = axes.contour(x, y, height, levels=levels[1:], colors="white", linewidths=0.5)
    axes.clabel(lines, lines.levels[1::2], fmt="%g", fontsize=7)
    handles: list[Any] = []
    for value, colour, hatch, name in (
        (2, ORANGE, "////", f"interpolated, {100 * report.interpolated_ratio:.1f} % of the floor"),
        (3, VERMILION, "xxxx", f"unseen, {100 * report.unseen_ratio:.1f} %"),
    ):
        if (state == value).any():
            with plt.rc_context({"hatch.color": colour, "hatch.linewidth": 0.7}):
                axes.contourf(x, y, (state == value).astype(float), levels=[0.5, 1.5], colors="none", hatches=[hatch])
                handles.append(Patch(facecolor="none", edgecolor=colour, hatch=hatch, label=name))
    if len(report.footprint_m):
        axes.add_patch(Polygon(report.footprint_m, closed=True, facecolor="none", edgecolor=BLACK, lw=1.4))
        handles.append(Line2D([], [], color=BLACK, lw=1.4, label="walls as fitted"))
    _plan(axes, [np.column_stack([x[[0, -1]], y[[0, -1]]])], "map")
    axes.set_title(f"Height above the floor; {100 * report.seen_ratio:.1f} % of the floor seen", loc="left")
    figure.colorbar(filled, ax=axes, label="height above the floor, m", shrink=0.9, pad=0.02)
    if handles:
        axes.legend(
            handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=3, fontsize=9, handlelength=2.4
        )


def _plan(axes: Any, shapes: Sequence[Array], frame: str) -> None:
    """A plan's axes: equal scales, all shapes in view, units told."""
    corners = np.vstack([s for s in shapes if len(s)] or [np.zeros((1, 2))])
    low, high = corners.min(axis=0), corners.max(axis=0)
    margin = 0.03 * max(float((high - low).max()), 1.0)
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(low[1] - margin, high[1] + margin)
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlabel(f"x in {frame}, m")
    axes.set_ylabel(f"y in {frame}, m")


def _save(figure: Any, path: Path) -> Path:
    part = path.with_name(f".{path.name}.part")
    try:
        kind = path.suffix.lstrip(".") or "png"
        figure.savefig(part, dpi=130, format=kind, metadata={"Software": None}, bbox_inches="tight", pad_inches=0.12)
    finally:
        plt.close(figure)
    os.replace(part, path)
    return path
