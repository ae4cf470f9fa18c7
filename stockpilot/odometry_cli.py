"""`stockpilot odometry`: the odometry on other people's recordings, without any flight controller."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from companion.errors import FileFormatError
from companion.messages import Array, PointMap
from companion.odometry.loop_closure import LoopCloser
from companion.odometry.planar import PlanarMatcher
from companion.recording.tum import seconds
from stockpilot.file_scan import FileScan, ScanFile
from stockpilot.files import require_place
from stockpilot.scan_files import open_scans

MAP_EVERY_M = 0.3  # a scan goes into the map when the scanner has moved this far or turned this much
MAP_EVERY_RAD = math.radians(10.0)
MAP_CELL_M = 0.05


@dataclass(slots=True)
class Track:
    """What odometry made of a recording: a pose (x, y, yaw) at each scan's own time.

    poses: in map, with loops closed, or in odom where that was not asked for. map_scans: index and points of the scans
    that make the map.
    """

    t_ns: list[int] = field(default_factory=list)
    poses: list[Array] = field(default_factory=list)
    converged: list[bool] = field(default_factory=list)
    map_scans: list[tuple[int, Array]] = field(default_factory=list)
    out_of_order: int = 0
    loops: int = 0
    wall_time_s: float = 0.0

    def tum(self) -> Iterator[str]:
        """Lines t x y z qx qy qz qw; z 0: the scanner moves in a plane."""
        for t_ns, (x, y, yaw) in zip(self.t_ns, self.poses, strict=True):
            half = float(yaw) / 2
            yield f"{seconds(t_ns)} {float(x)!r} {float(y)!r} 0.0 0.0 0.0 {math.sin(half)!r} {math.cos(half)!r}\n"


def track(scans: Iterator[FileScan], *, with_map: bool = False, with_loops: bool = True) -> Track:
    """Run the odometry over scans in their order; one whose time does not follow the last one's is left out."""
    matcher, closer = PlanarMatcher(), LoopCloser()
    found = Track()
    last_map: Array | None = None
    began = time.perf_counter()
    for scan in scans:
        if found.t_ns and scan.t_ns <= found.t_ns[-1]:
            found.out_of_order += 1
            continue
        match = matcher.match(scan.points, scan.t_ns)
        if with_loops:
            closer.add(scan.points, match.pose, match.information, converged=match.converged)
        found.t_ns.append(scan.t_ns)
        found.poses.append(match.pose)
        found.converged.append(match.converged)
        if with_map and match.converged and _has_moved(last_map, match.pose):
            last_map = match.pose
            found.map_scans.append((len(found.poses) - 1, scan.points_3d))
    if with_loops:
        found.poses, found.loops = list(closer.poses()), closer.loops
    found.wall_time_s = time.perf_counter() - began
    return found


def _has_moved(last: Array | None, pose: Array) -> bool:
    if last is None:
        return True
    turned = abs((pose[2] - last[2] + math.pi) % (2 * math.pi) - math.pi)
    return bool(math.hypot(pose[0] - last[0], pose[1] - last[1]) > MAP_EVERY_M or turned > MAP_EVERY_RAD)


def _placed(points_3d: Array, pose: Array) -> Array:
    c, s = math.cos(pose[2]), math.sin(pose[2])
    placed: Array = points_3d @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    placed[:, :2] += pose[:2]
    return placed


def write_map(path: Path, found: Track) -> int:
    """One point for each 5 cm, as PLY or LAS/LAZ by the name's end; returns how many."""
    from companion.mapping.export import save_point_map

    placed = [_placed(points, found.poses[index]) for index, points in found.map_scans]
    every = np.concatenate(placed) if placed else np.zeros((0, 3))
    _, first = np.unique(np.floor(every / MAP_CELL_M).astype(np.int64), axis=0, return_index=True)
    kept = every[np.sort(first)]
    flown = np.column_stack([np.array([p[:2] for p in found.poses]), np.zeros(len(found.poses))])
    nothing = np.zeros(len(kept))
    try:
        save_point_map(
            PointMap(points_map=kept, keyframe_id=nothing.astype(np.int64), range_m=nothing, path_map=flown), path
        )
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be written: {error.strerror}") from None
    return len(kept)


def odometry_command(
    file: Annotated[
        Path, typer.Argument(help="Ouster or Velodyne pcap, ROS 1 or 2 bag, MCAP, CARMEN log", show_default=False)
    ],
    tum: Annotated[Path | None, typer.Option(help="write the trajectory there (TUM, for evo)")] = None,
    map_out: Annotated[Path | None, typer.Option("--map", help="write the map there (.ply, .las or .laz)")] = None,
    metadata: Annotated[
        Path | None, typer.Option(help="an Ouster sensor's metadata JSON; default: the one beside the pcap")
    ] = None,
    topic: Annotated[str | None, typer.Option(help="which LaserScan or PointCloud2, if there are several")] = None,
    loops: Annotated[
        bool, typer.Option(help="close loops where a place is seen again; without: odometry alone, which drifts")
    ] = True,
    as_json: Annotated[bool, typer.Option("--json", help="print the result as JSON on stdout")] = False,
) -> None:
    """Run the odometry on a recording of another robot: the kind is recognised by content, times are those of the scans.

    The scanner is taken to move in a plane: of a 3D sensor, the horizontal layer is used.

    Exit codes: 0 all well, 1 fewer than half the scans could be placed, 2 not a recording with scans.
    """
    for path in (tum, map_out):
        if path is not None:
            require_place(path)
    if map_out is not None:
        from companion.mapping.export import map_writer

        map_writer(map_out)
    opened = open_scans(file, metadata=metadata, topic=topic)
    found = track(opened.scans, with_map=map_out is not None, with_loops=loops)
    if not found.t_ns:
        lost = ", ".join(f"{n} dropped: {why}" for why, n in opened.dropped.items() if n)
        raise FileFormatError(f"{file}: no whole scan of {opened.sensor} in it{f' ({lost})' if lost else ''}")
    said = summary(file, opened, found)
    if tum is not None:
        _write_text(tum, "".join(found.tum()))
        said["tum"] = str(tum)
    if map_out is not None:
        said["map"] = str(map_out)
        said["map_points"] = write_map(map_out, found)
    typer.echo(json.dumps(said, indent=2) if as_json else describe(said))
    raise typer.Exit(0 if said["placed_ratio"] >= 0.5 else 1)


def summary(file: Path, opened: ScanFile, found: Track) -> dict[str, Any]:
    path = np.array([p[:2] for p in found.poses])
    steps = np.hypot(*np.diff(path, axis=0).T) if len(path) > 1 else np.zeros(0)
    duration_s = (found.t_ns[-1] - found.t_ns[0]) * 1e-9
    return {
        "file": str(file),
        "kind": opened.kind.value,
        "sensor": opened.sensor,
        "scans": len(found.t_ns),
        "placed_ratio": float(np.mean(found.converged)),
        "loops": found.loops,
        "out_of_order": found.out_of_order,
        "dropped": {k: n for k, n in opened.dropped.items() if n},
        "duration_s": duration_s,
        "path_length_m": float(steps.sum()),
        "end_m": [float(v) for v in found.poses[-1]],
        "wall_time_s": found.wall_time_s,
        "real_time_factor": duration_s / found.wall_time_s if found.wall_time_s > 0 else 0.0,
    }


def describe(said: dict[str, Any]) -> str:
    """The same for people."""
    x, y, yaw = said["end_m"]
    lines = [
        f"{said['file']}: {said['kind']}, {said['sensor']}",
        f"{said['scans']} scans over {said['duration_s']:.1f} s, {said['placed_ratio']:.1%} placed, "
        f"in {said['wall_time_s']:.1f} s ({said['real_time_factor']:.0f} times real time)",
        f"path {said['path_length_m']:.2f} m, ends at x {x:.3f} m, y {y:.3f} m, yaw {math.degrees(yaw):.2f} deg",
    ]
    if said["loops"]:
        lines.append(f"{said['loops']} loop closures")
    if said["out_of_order"]:
        lines.append(f"{said['out_of_order']} scans left out: their time is not after the one before")
    lines += [f"dropped {n}: {why}" for why, n in said["dropped"].items()]
    lines += [f"wrote {said[k]}" for k in ("tum", "map") if k in said]
    return "\n".join(lines)


def _write_text(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise FileFormatError(f"{path}: cannot be written: {error.strerror}") from None
