"""sha256 of every file of a run: what was altered later is refused, and shown."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from companion.errors import FileFormatError

MANIFEST_NAME = "manifest.json"
_VERSION = 1


@dataclass(frozen=True, slots=True)
class Mismatch:
    """what: missing, altered or shortened; for people."""

    name: str
    what: str


def sha256_of(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_manifest(folder: Path) -> Path:
    """List every file of a run's folder with its size and sha256. Call it last; returns the manifest's path."""
    files = {
        path.relative_to(folder).as_posix(): {"bytes": path.stat().st_size, "sha256": sha256_of(path)}
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != MANIFEST_NAME
    }
    manifest = folder / MANIFEST_NAME
    temporary = folder / (MANIFEST_NAME + ".part")
    with temporary.open("w", encoding="utf-8") as file:
        json.dump({"version": _VERSION, "files": files}, file, indent=1)
        file.write("\n")
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(manifest)
    return manifest


def read_manifest(folder: Path) -> dict[str, dict[str, object]] | None:
    """Files by name; None where there is no manifest. Raises: FileFormatError: it is none of ours."""
    path = folder / MANIFEST_NAME
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        files = content["files"]
        if not all(isinstance(f["sha256"], str) and isinstance(f["bytes"], int) for f in files.values()):
            raise ValueError("an entry lacks sha256 or bytes")
    except FileNotFoundError:
        return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise FileFormatError(f"{path}: expected the manifest of a run (version {_VERSION}): {error}") from None
    return dict(files)


def compare(folder: Path, names: Iterable[str] | None = None) -> list[Mismatch]:
    """What differs from the manifest: all its files, or only `names`. Empty: all is as it was, or there is none."""
    files = read_manifest(folder)
    if files is None:
        return []
    wanted = sorted(files) if names is None else [n for n in names if n in files]
    found: list[Mismatch] = []
    for name in wanted:
        path = folder / name
        expected = files[name]
        if not path.is_file():
            found.append(Mismatch(name, "missing"))
        elif path.stat().st_size != expected["bytes"]:
            found.append(
                Mismatch(name, f"altered: {path.stat().st_size} bytes, {expected['bytes']} when the run ended")
            )
        elif (digest := sha256_of(path)) != expected["sha256"]:
            found.append(
                Mismatch(name, f"altered: sha256 {digest[:16]}..., {str(expected['sha256'])[:16]}... expected")
            )
    return found


def require_unaltered(folder: Path, names: Iterable[str] | None = None) -> None:
    """Raises: FileFormatError: a file is not what it was when the run ended; each is named."""
    found = compare(folder, names)
    if found:
        lines = [f"{folder / m.name}: {m.what}" for m in found]
        raise FileFormatError("\n".join([f"{folder / MANIFEST_NAME}: the run was altered; it is not read", *lines]))


def require_unaltered_file(path: Path) -> None:
    """The same for any file that a command is given: a manifest beside it that is none of ours says nothing of it.

    Raises: FileFormatError: it lies in a run's folder and is not what it was when the run ended.
    """
    try:
        found = compare(path.parent, [path.name])
    except FileFormatError:
        return
    if found:
        raise FileFormatError(
            f"{path}: {found[0].what} ({MANIFEST_NAME} of the run): it is not read; copied out of the run's folder it is"
        )
