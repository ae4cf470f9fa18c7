"""A run that was altered is refused, and what was altered is shown."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.errors import FileFormatError
from companion.recording.manifest import MANIFEST_NAME, compare, require_unaltered, write_manifest


@pytest.fixture
def run(tmp_path: Path) -> Path:
    (tmp_path / "report.json").write_text("{}")
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "map.ply").write_bytes(bytes(1000))
    write_manifest(tmp_path)
    return tmp_path


def test_untouched_run_passes(run: Path) -> None:
    require_unaltered(run)
    (run / "notes.txt").write_text("a new file alters nothing")
    assert compare(run) == []


def test_flipped_bit_is_refused_and_named(run: Path) -> None:
    data = bytearray(1000)
    data[500] = 1
    (run / "sub" / "map.ply").write_bytes(data)
    with pytest.raises(FileFormatError, match=r"sub/map\.ply: altered: sha256"):
        require_unaltered(run)
    require_unaltered(run, ["report.json"])


def test_shortened_and_missing_files_are_named(run: Path) -> None:
    (run / "report.json").unlink()
    (run / "sub" / "map.ply").write_bytes(bytes(999))
    assert {m.name: m.what.split(":")[0] for m in compare(run)} == {"report.json": "missing", "sub/map.ply": "altered"}


def test_run_without_manifest_passes(tmp_path: Path) -> None:
    require_unaltered(tmp_path)


@pytest.mark.parametrize("content", ["", "[]", '{"files": {"a": {}}}', "{"])
def test_broken_manifest_is_told(tmp_path: Path, content: str) -> None:
    (tmp_path / MANIFEST_NAME).write_text(content)
    with pytest.raises(FileFormatError, match=MANIFEST_NAME):
        require_unaltered(tmp_path)
