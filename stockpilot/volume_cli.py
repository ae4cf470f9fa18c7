"""`stockpilot volume`: the volume from any point cloud, with the surface and the interval of a mission's own."""

from __future__ import annotations

import json
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console

from companion.config import VolumeConfig
from companion.errors import FileFormatError
from companion.mapping.export import load_point_map
from companion.messages import PointMap, VolumeReport
from companion.recording.manifest import require_unaltered_file
from companion.volume import estimate_volume

MIN_CELL_M, MAX_CELL_M = 0.05, 5.0
RETURNS_A_CELL = 12.0  # a cell is chosen so large that it usually holds so many
TALLEST_STORE_M = 150.0  # heights over a larger span are not in metres
COARSE_M = 0.02  # coordinates that come in larger steps are told


def volume_command(
    cloud: Annotated[Path, typer.Argument(help="PLY (ascii or binary), LAS, LAZ, or text with x y z in each line")],
    cell: Annotated[
        float | None, typer.Option(help="cell size, m; default: 0.25, larger for thin clouds", show_default=False)
    ] = None,
    floor: Annotated[
        str, typer.Option(help="auto: found in the cloud; or the height of a level floor in the cloud's z, m")
    ] = "auto",
    level: Annotated[float, typer.Option(help="confidence of the interval")] = 0.95,
    scale: Annotated[float, typer.Option(help="multiply coordinates, e.g. 0.001 for millimetres")] = 1.0,
    density: Annotated[
        float | None, typer.Option(help="bulk density of the material, t/m3: tells the mass too", show_default=False)
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="folder for report.json, report.html and pictures", show_default=False)
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print the result as JSON on stdout")] = False,
) -> None:
    """Measure the material in a point cloud: z up, in metres.

    Walls and floor are found in the cloud; a heap in the open without walls will do as well.
    Exit code: 0 a volume; 1 none could be told; 2 the file or an option is wrong.
    """
    report, volume, point_map = measure(
        cloud, cell_m=cell, floor=floor, level=level, scale=scale, density_t_m3=density, quiet=False
    )
    if out is not None:
        _write(out, report, volume, point_map)
    if as_json:
        typer.echo(json.dumps(report, indent=2, allow_nan=False))
    else:
        from stockpilot.report import text_summary

        Console().print(text_summary(report))
        if out is not None:
            typer.echo(f"results in {out}")
    if report["volume_m3"] is None:
        raise typer.Exit(1)


def measure(
    cloud: Path,
    *,
    cell_m: float | None = None,
    floor: str = "auto",
    level: float = 0.95,
    scale: float = 1.0,
    density_t_m3: float | None = None,
    quiet: bool = True,
) -> tuple[dict[str, Any], VolumeReport, PointMap]:
    """The report of a cloud as a dict, the surface, and the cloud as it was used.

    Raises: FileFormatError: no such file, not a cloud, empty, or not in metres. typer.BadParameter: an option.
    """
    floor_z = _options(floor, level, scale, cell_m, density_t_m3)
    console = Console(stderr=True, quiet=quiet)
    begin = time.monotonic()
    with console.status(f"reading {cloud}"):
        point_map = _checked(cloud, _scaled(_load(cloud), scale))
    console.print(f"{len(point_map.points_map):,} points read in {time.monotonic() - begin:.1f} s", style="dim")
    begin = time.monotonic()
    with console.status("finding walls, floor and surface"):
        cell_m = cell_m or fitting_cell_m(point_map)
        volume = estimate_volume(point_map, VolumeConfig(cell_m=cell_m, interval_level=level), floor_z_m=floor_z)
    console.print(f"measured in {time.monotonic() - begin:.1f} s, cells of {cell_m:g} m", style="dim")
    return _report(cloud, volume, point_map, cell_m, density_t_m3), volume, point_map


def fitting_cell_m(point_map: PointMap) -> float:
    """0.25 m, or larger where the cloud is so thin that cells of it would stay empty."""
    square = np.floor(point_map.points_map[:, :2] - point_map.points_map[:, :2].min(axis=0)).astype(np.int64)
    _, counts = np.unique((square[:, 0] << 32) | square[:, 1], return_counts=True)
    cell = math.sqrt(RETURNS_A_CELL / max(float(np.median(counts)), 1e-3))
    return round(min(max(cell, VolumeConfig().cell_m), MAX_CELL_M), 2)


def _options(floor: str, level: float, scale: float, cell_m: float | None, density_t_m3: float | None) -> float | None:
    if cell_m is not None and not MIN_CELL_M <= cell_m <= MAX_CELL_M:
        raise typer.BadParameter(f"{cell_m:g} is not from {MIN_CELL_M} to {MAX_CELL_M:g} m", param_hint="--cell")
    if not 0.5 < level < 1.0:
        raise typer.BadParameter(f"{level:g} is not between 0.5 and 1", param_hint="--level")
    if not (math.isfinite(scale) and scale > 0):
        raise typer.BadParameter(f"{scale:g} is not above 0", param_hint="--scale")
    if density_t_m3 is not None and not 0 < density_t_m3 < 30:
        raise typer.BadParameter(f"{density_t_m3:g} is not a bulk density in t/m3", param_hint="--density")
    if floor == "auto":
        return None
    try:
        value = float(floor)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise typer.BadParameter(f"'{floor}' is neither 'auto' nor a height in metres", param_hint="--floor")
    return value


def _load(cloud: Path) -> PointMap:
    if cloud.is_dir():
        inside = cloud / "map.ply"
        if not inside.is_file():
            raise FileFormatError(f"{cloud}: a folder; expected a point cloud file, or a run's folder with map.ply")
        cloud = inside
    try:
        require_unaltered_file(cloud)
        return load_point_map(cloud)
    except FileNotFoundError:
        raise FileFormatError(f"{cloud}: there is no such file") from None
    except OSError as error:
        raise FileFormatError(f"{cloud}: cannot be read: {error.strerror or error}") from None


def _scaled(point_map: PointMap, scale: float) -> PointMap:
    if scale == 1.0:
        return point_map
    return replace(
        point_map,
        points_map=point_map.points_map * scale,
        range_m=point_map.range_m * scale,
        path_map=point_map.path_map * scale,
        position_sigma_m=point_map.position_sigma_m * scale,
        height_sigma_m=point_map.height_sigma_m * scale,
    )


def _checked(cloud: Path, point_map: PointMap) -> PointMap:
    """The cloud, its points that are numbers, refused where no volume in metres can be in it."""
    finite = np.asarray(np.isfinite(point_map.points_map).all(axis=1))
    points = point_map.points_map[finite]
    if len(points) == 0:
        raise FileFormatError(f"{cloud}: no points in it ({len(finite)} rows, none of them finite)")
    if len(points) < 200:
        raise FileFormatError(f"{cloud}: only {len(points)} points: a surface needs some 200 at the very least")
    low, high = np.quantile(points, [0.01, 0.99], axis=0)
    span = high - low
    told = " x ".join(f"{s:,.3g}" for s in span)
    if span[2] > TALLEST_STORE_M:
        raise FileFormatError(
            f"{cloud}: {told} is no store in metres: for millimetres give --scale 0.001, for centimetres --scale 0.01, "
            "for feet --scale 0.3048; or is z not up in it?"
        )
    if max(span[:2]) < 0.5:
        raise FileFormatError(
            f"{cloud}: {told} m is too small for a store: if the cloud is in kilometres give --scale 1000"
        )
    if span[2] > 2 * max(span[:2]):
        raise FileFormatError(f"{cloud}: {told} m is taller than it is wide: is z up in it?")
    return point_map.only(finite)


def _coarse_step_m(point_map: PointMap) -> float:
    """Step between neighbouring coordinates of a cloud that was stored in single precision far from its origin, else 0."""
    plan = point_map.points_map[:, :2]
    single = plan.astype(np.float32)
    step = float(np.spacing(np.abs(single).max()))
    return step if step > COARSE_M and np.array_equal(single, plan) else 0.0


def _report(
    cloud: Path, volume: VolumeReport, point_map: PointMap, cell_m: float, density_t_m3: float | None
) -> dict[str, Any]:
    known = math.isfinite(volume.volume_m3)
    warnings = list(volume.warnings)
    step_m = _coarse_step_m(point_map)
    if step_m:
        warnings.append(
            f"the cloud's coordinates come in steps of {step_m:g} m: it was stored in single precision far from its "
            "origin; export it in double precision, or nearer to its origin"
        )
    report: dict[str, Any] = {
        "cloud": cloud.name,
        "points": len(point_map.points_map),
        "cell_m": cell_m,
        "volume_m3": volume.volume_m3 if known else None,
        "volume_interval_m3": list(volume.interval_m3) if known else None,
        "volume_interval_level": volume.interval_level,
        "seen_ratio": volume.seen_ratio,
        "interpolated_ratio": volume.interpolated_ratio,
        "unseen_ratio": volume.unseen_ratio,
        "floor_area_m2": volume.floor_area_m2,
        "pile_area_m2": volume.pile_area_m2,
        "error_budget_m3": dict(volume.error_budget_m3),
        "warnings": warnings,
    }
    if density_t_m3 is not None and known:
        report["bulk_density_t_m3"] = density_t_m3
        report["mass_t"] = volume.volume_m3 * density_t_m3
    return report


def _write(folder: Path, report: dict[str, Any], volume: VolumeReport, point_map: PointMap) -> None:
    from stockpilot.pictures import draw_map, draw_surface
    from stockpilot.report import write_report_page

    folder.mkdir(parents=True, exist_ok=True)
    pictures = {
        "surface": draw_surface(folder / "surface.png", volume),
        "map": draw_map(folder / "map.png", point_map),
    }
    write_report_page(folder / "report.html", report, pictures)
    part = folder / ".report.json.part"
    part.write_text(json.dumps(report, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    part.replace(folder / "report.json")
