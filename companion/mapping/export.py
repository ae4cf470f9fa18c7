"""Edge: the map to files and back: PLY (binary, double precision) and LAS/LAZ. Files appear whole or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np

from companion.errors import FileFormatError
from companion.mapping.ply import Columns, read_ply, write_ply
from companion.messages import PointMap

VLR_USER = "stockpilot"
VLR_RECORD = 1
LAS_SCALE_M = 0.0001


def map_writer(path: Path) -> Callable[[PointMap, Path], None]:
    """What writes a map of that name. Raises: FileFormatError: its ending is none of .ply, .las, .laz."""
    writers: dict[str, Callable[[PointMap, Path], None]] = {".ply": _save_ply, ".las": _save_las, ".laz": _save_las}
    writer = writers.get(path.suffix.lower())
    if writer is None:
        raise FileFormatError(f"{path}: a map is written as .ply, .las or .laz, not as '{path.suffix}'")
    return writer


def save_point_map(point_map: PointMap, path: Path) -> None:
    """Write the map as .ply, .las or .laz (by the name's end); path and pose sigma go with it.

    Raises: FileFormatError: another ending. OSError: the disk.
    """
    writer = map_writer(path)
    part = path.with_name(f".{path.name}.part{path.suffix}")
    try:
        writer(point_map, part)
        with part.open("rb") as written:
            os.fsync(written.fileno())
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def load_point_map(path: Path) -> PointMap:
    """Read a point cloud (.ply ascii or binary, .las, .laz, .xyz, .txt, .csv); what it does not tell stays empty.

    Raises: FileFormatError: what was expected, what came, where. OSError: no such file.
    """
    readers: dict[str, Callable[[Path], PointMap]] = {
        ".ply": _load_ply,
        ".las": _load_las,
        ".laz": _load_las,
        ".xyz": _load_text,
        ".txt": _load_text,
        ".csv": _load_text,
        ".pts": _load_text,
    }
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise FileFormatError(
            f"{path}: '{path.suffix}' is not a point cloud that is read here; known: {', '.join(readers)}"
        )
    if path.stat().st_size == 0:
        raise FileFormatError(f"{path}: the file is empty")
    return reader(path)


def _save_ply(point_map: PointMap, path: Path) -> None:
    vertex: Columns = {
        "x": point_map.points_map[:, 0],
        "y": point_map.points_map[:, 1],
        "z": point_map.points_map[:, 2],
        "range": point_map.range_m.astype(np.float32),
        "keyframe": point_map.keyframe_id.astype(np.int32),
    }
    if point_map.scan_index is not None:
        vertex["scan"] = point_map.scan_index.astype(np.int32)
    flown: Columns = {name: point_map.path_map[:, i] for i, name in enumerate("xyz")}
    comments = [
        "stockpilot map, metres, z up",
        f"position_sigma_m {point_map.position_sigma_m!r}",
        f"height_sigma_m {point_map.height_sigma_m!r}",
    ]
    write_ply(path, {"vertex": vertex, "path": flown}, comments)


def _load_ply(path: Path) -> PointMap:
    elements, comments = read_ply(path)
    vertex = elements.get("vertex", {})
    if not {"x", "y", "z"} <= vertex.keys():
        raise FileFormatError(f"{path}: expected an element 'vertex' with x, y and z, found {sorted(vertex) or 'none'}")
    points = np.column_stack([vertex[a] for a in "xyz"]).astype(np.float64)
    told = dict(c.split(" ", 1) for c in comments if " " in c)
    flown = elements.get("path", {})
    return PointMap(
        points_map=points,
        keyframe_id=vertex.get("keyframe", np.zeros(len(points))).astype(np.int64),
        range_m=vertex.get("range", np.zeros(len(points))).astype(np.float64),
        path_map=np.column_stack([flown[a] for a in "xyz"]).astype(np.float64) if flown else np.zeros((0, 3)),
        position_sigma_m=_number(told.get("position_sigma_m")),
        height_sigma_m=_number(told.get("height_sigma_m")),
        scan_index=vertex["scan"].astype(np.int64) if "scan" in vertex else None,
    )


def _number(text: str | None) -> float:
    try:
        return float(text) if text is not None else 0.0
    except ValueError:
        return 0.0


def _save_las(point_map: PointMap, path: Path) -> None:
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, LAS_SCALE_M)
    header.offsets = np.floor(point_map.points_map.min(axis=0)) if len(point_map.points_map) else np.zeros(3)
    kinds = {"range": np.float32, "keyframe": np.int32} | ({} if point_map.scan_index is None else {"scan": np.int32})
    header.add_extra_dims([laspy.ExtraBytesParams(name, kind) for name, kind in kinds.items()])
    told = {
        "path_map": np.round(point_map.path_map, 4).tolist(),
        "position_sigma_m": point_map.position_sigma_m,
        "height_sigma_m": point_map.height_sigma_m,
    }
    # A record holds 65,535 bytes: a long path is told by fewer of its points.
    data = json.dumps(told).encode()
    step = 1
    while len(data) > 65_000:
        step += 1
        data = json.dumps({**told, "path_map": np.round(point_map.path_map[::step], 4).tolist()}).encode()
    header.vlrs.append(laspy.VLR(VLR_USER, VLR_RECORD, "flown path and pose sigma", data))
    las = laspy.LasData(header)
    las.x, las.y, las.z = point_map.points_map.T
    las["range"] = point_map.range_m.astype(np.float32)
    las["keyframe"] = point_map.keyframe_id.astype(np.int32)
    if point_map.scan_index is not None:
        las["scan"] = (point_map.scan_index // step).astype(np.int32)
    las.write(str(path), do_compress=path.suffix.lower() == ".laz")


def _load_las(path: Path) -> PointMap:
    try:
        las = laspy.read(str(path))
        points = np.column_stack([las.x, las.y, las.z]).astype(np.float64)
    except (laspy.errors.LaspyException, ValueError, RuntimeError, EOFError) as error:
        raise FileFormatError(f"{path}: not a LAS or LAZ file that can be read: {error}") from error
    names = set(las.point_format.dimension_names)
    told: dict[str, object] = {}
    for vlr in las.header.vlrs:
        if getattr(vlr, "user_id", "") == VLR_USER and getattr(vlr, "record_id", 0) == VLR_RECORD:
            told = json.loads(bytes(vlr.record_data))
    return PointMap(
        points_map=points,
        keyframe_id=np.asarray(las["keyframe"] if "keyframe" in names else np.zeros(len(points)), dtype=np.int64),
        range_m=np.asarray(las["range"] if "range" in names else np.zeros(len(points)), dtype=np.float64),
        path_map=np.asarray(told.get("path_map", []), dtype=np.float64).reshape(-1, 3),
        position_sigma_m=float(str(told.get("position_sigma_m", 0.0))),
        height_sigma_m=float(str(told.get("height_sigma_m", 0.0))),
        scan_index=np.asarray(las["scan"], dtype=np.int64) if "scan" in names else None,
    )


def _load_text(path: Path) -> PointMap:
    """Columns x, y, z first, parted by blanks, commas or semicolons; a header line and # comments are passed over."""
    with path.open("rb") as file:
        head = file.read(4096)
    if b"\0" in head:
        raise FileFormatError(f"{path}: expected text with x, y, z in each line, found binary data")
    lines = [line for line in head.decode("utf-8", "replace").splitlines() if line.strip()]
    skip = 0
    while skip < min(len(lines), 3) and not _starts_with_numbers(lines[skip]):
        skip += 1
    if skip >= len(lines) or not _starts_with_numbers(lines[skip]):
        raise FileFormatError(f"{path}: expected x, y, z in each line, found '{(lines or [''])[0][:60]}'")
    sample = lines[skip]
    delimiter = next((d for d in (",", ";") if d in sample), None)
    try:
        points = np.loadtxt(
            path, delimiter=delimiter, skiprows=skip, usecols=(0, 1, 2), ndmin=2, comments="#", encoding="latin-1"
        )
    except ValueError as error:
        commas = "; decimal commas are not read, write points" if delimiter == "," and ";" in sample else ""
        raise FileFormatError(f"{path}: expected three numbers in each line: {error}{commas}") from error
    count = len(points)
    return PointMap(
        points_map=points.astype(np.float64),
        keyframe_id=np.zeros(count, dtype=np.int64),
        range_m=np.zeros(count),
        path_map=np.zeros((0, 3)),
    )


def _starts_with_numbers(line: str) -> bool:
    fields = line.replace(",", " ").replace(";", " ").split()
    try:
        return len([float(f) for f in fields[:3]]) == 3
    except ValueError:
        return False
