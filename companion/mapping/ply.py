"""Edge: PLY, the few rules of it that point clouds use: elements of scalars, ascii or binary, either byte order."""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from companion.errors import FileFormatError

Columns = dict[str, NDArray[np.generic]]
TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
NAMES = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
MAX_HEADER_LINES = 1000


def write_ply(path: Path, elements: dict[str, Columns], comments: list[str]) -> None:
    """Binary, little-endian; each column in its own type (float64 stays double)."""
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {c}" for c in comments)]
    bodies = []
    for name, columns in elements.items():
        kinds = {c: v.dtype.str[1:] for c, v in columns.items()}
        header.append(f"element {name} {len(next(iter(columns.values())))}")
        header += [f"property {NAMES[kind]} {c}" for c, kind in kinds.items()]
        rows = np.empty(len(next(iter(columns.values()))), dtype=[(c, "<" + kind) for c, kind in kinds.items()])
        for c, values in columns.items():
            rows[c] = values
        bodies.append(rows)
    with path.open("wb") as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii"))
        for rows in bodies:
            file.write(rows.tobytes())


def read_ply(path: Path) -> tuple[dict[str, Columns], list[str]]:
    """Elements by name, each a dict of columns, and the comments. Elements after one with lists are not read.

    Raises: FileFormatError: not PLY, cut short, or a type that PLY does not know.
    """
    with path.open("rb") as file:
        order, layout, comments = _header(file, path)
        elements: dict[str, Columns] = {}
        for name, count, kinds in layout:
            if any(kind == "list" for _, kind in kinds):
                break
            read = _ascii if order == "" else _binary
            elements[name] = read(file, path, name, count, kinds, order)
    return elements, comments


def _header(file: BinaryIO, path: Path) -> tuple[str, list[tuple[str, int, list[tuple[str, str]]]], list[str]]:
    if file.readline(80).strip() != b"ply":
        raise FileFormatError(f"{path}: not a PLY file: its first line is not 'ply'")
    order: str | None = None
    layout: list[tuple[str, int, list[tuple[str, str]]]] = []
    comments: list[str] = []
    for number in range(2, MAX_HEADER_LINES):
        raw = file.readline(4096)
        words = raw.decode("ascii", "replace").split()
        try:
            match words:
                case ["end_header"]:
                    if order is None:
                        raise FileFormatError(f"{path}: the PLY header names no format")
                    return order, layout, comments
                case ["format", kind, *_]:
                    order = FORMATS[kind]
                case ["comment" | "obj_info", *text]:
                    comments.append(" ".join(text))
                case ["element", name, count]:
                    layout.append((name, _count(count), []))
                case ["property", "list", _, _, name]:
                    _add_property(layout[-1][2], name, "list")
                case ["property", kind, name]:
                    _add_property(layout[-1][2], name, TYPES[kind])
                case _:
                    raise FileFormatError(f"{path}, line {number}: not a line of a PLY header: {raw[:60]!r}")
        except (KeyError, ValueError, IndexError) as error:
            raise FileFormatError(f"{path}, line {number}: {raw[:60]!r} cannot be read: {error}") from error
    raise FileFormatError(f"{path}: no end_header in the first {MAX_HEADER_LINES} lines")


def _count(text: str) -> int:
    count = int(text)
    if count < 0:
        raise ValueError(f"there cannot be {count} rows")
    return count


def _add_property(kinds: list[tuple[str, str]], name: str, kind: str) -> None:
    if any(name == other for other, _ in kinds):
        raise ValueError(f"there is a property '{name}' already")
    kinds.append((name, kind))


def _binary(file: BinaryIO, path: Path, name: str, count: int, kinds: list[tuple[str, str]], order: str) -> Columns:
    dtype = np.dtype([(c, order + kind) for c, kind in kinds])
    # Looked at before anything is read: a wrong count may ask for more memory than there is.
    left = path.stat().st_size - file.tell()
    if left < dtype.itemsize * count:
        raise FileFormatError(
            f"{path}: cut short: element '{name}' should hold {count} rows of {dtype.itemsize} bytes, "
            f"found {left // max(dtype.itemsize, 1)}"
        )
    rows = np.frombuffer(file.read(dtype.itemsize * count), dtype=dtype)
    return {c: rows[c] for c, _ in kinds}


def _ascii(file: BinaryIO, path: Path, name: str, count: int, kinds: list[tuple[str, str]], order: str) -> Columns:
    try:
        rows = np.loadtxt(file, max_rows=count, ndmin=2) if count else np.zeros((0, len(kinds)))
    except ValueError as error:
        raise FileFormatError(f"{path}: element '{name}': {error}") from error
    if rows.shape != (count, len(kinds)):
        raise FileFormatError(
            f"{path}: element '{name}' should hold {count} rows of {len(kinds)} numbers, found {rows.shape}"
        )
    return {c: rows[:, i].astype(order + kind) for i, (c, kind) in enumerate(kinds)}
