"""Maps to files and back."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest

from companion.errors import FileFormatError
from companion.mapping.export import load_point_map, save_point_map
from companion.messages import PointMap


@pytest.fixture
def point_map() -> PointMap:
    rng = np.random.default_rng(0)
    return PointMap(
        points_map=rng.uniform(-50, 50, (500, 3)) + np.pi * 1e-9,
        keyframe_id=rng.integers(0, 60, 500),
        range_m=rng.uniform(1, 40, 500).astype(np.float32).astype(np.float64),
        path_map=rng.uniform(-20, 20, (40, 3)),
        position_sigma_m=0.0173,
        height_sigma_m=0.008,
        scan_index=rng.integers(0, 40, 500),
    )


def test_ply_comes_back_to_the_last_bit(point_map: PointMap, tmp_path: Path) -> None:
    save_point_map(point_map, tmp_path / "map.ply")
    back = load_point_map(tmp_path / "map.ply")
    assert back.points_map.tobytes() == point_map.points_map.tobytes()
    assert back.path_map.tobytes() == point_map.path_map.tobytes()
    assert (back.keyframe_id == point_map.keyframe_id).all()
    assert back.scan_index is not None
    assert (back.scan_index == point_map.scan_index).all()
    assert (back.range_m == point_map.range_m).all()
    assert (back.position_sigma_m, back.height_sigma_m) == (0.0173, 0.008)


@pytest.mark.parametrize("name", ["map.las", "map.laz"])
def test_las_comes_back_to_a_tenth_of_a_millimetre(point_map: PointMap, tmp_path: Path, name: str) -> None:
    save_point_map(point_map, tmp_path / name)
    back = load_point_map(tmp_path / name)
    assert np.abs(back.points_map - point_map.points_map).max() <= 0.5e-4 + 1e-9
    assert np.abs(back.path_map - point_map.path_map).max() <= 0.5e-4 + 1e-9
    assert (back.keyframe_id == point_map.keyframe_id).all()
    assert back.scan_index is not None
    assert (back.scan_index == point_map.scan_index).all()
    assert back.position_sigma_m == 0.0173


def test_long_path_fits_into_a_las_record(point_map: PointMap, tmp_path: Path) -> None:
    long = PointMap(
        points_map=point_map.points_map,
        keyframe_id=point_map.keyframe_id,
        range_m=point_map.range_m,
        path_map=np.cumsum(np.random.default_rng(1).uniform(-0.01, 0.01, (20_000, 3)), axis=0),
        scan_index=np.linspace(0, 19_999, 500).astype(np.int64),
    )
    save_point_map(long, tmp_path / "map.las")
    back = load_point_map(tmp_path / "map.las")
    assert 1000 < len(back.path_map) < 20_000
    assert back.scan_index is not None
    seen_from = back.path_map[back.scan_index] - long.path_map[np.linspace(0, 19_999, 500).astype(np.int64)]
    assert np.abs(seen_from).max() < 0.5


def test_empty_map_is_written_and_read(tmp_path: Path) -> None:
    nothing = PointMap(
        points_map=np.zeros((0, 3)),
        keyframe_id=np.zeros(0, dtype=np.int64),
        range_m=np.zeros(0),
        path_map=np.zeros((0, 3)),
    )
    for name in ("map.ply", "map.las"):
        save_point_map(nothing, tmp_path / name)
        assert load_point_map(tmp_path / name).points_map.shape == (0, 3)


def test_failed_write_leaves_the_old_file_whole(
    point_map: PointMap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "map.ply"
    save_point_map(point_map, target)
    before = target.read_bytes()

    def fails(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("companion.mapping.export.write_ply", fails)
    with pytest.raises(OSError, match="disk full"):
        save_point_map(point_map, target)
    assert target.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["map.ply"]


def test_unknown_ending_is_refused(point_map: PointMap, tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"\.ply, \.las or \.laz"):
        save_point_map(point_map, tmp_path / "map.stl")


HEADER = "ply\nformat {} 1.0\ncomment by hand\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
XYZ = np.array([[0, 0, 1], [2, 0, 1.5], [0, 2, -3]], dtype=np.float32)


@pytest.mark.parametrize(("name", "order"), [("binary_little_endian", "<f4"), ("binary_big_endian", ">f4")])
def test_foreign_binary_ply_is_read(tmp_path: Path, name: str, order: str) -> None:
    body = XYZ.astype(order).tobytes()
    (tmp_path / "a.ply").write_bytes((HEADER.format(name) + "end_header\n").encode() + body)
    assert (load_point_map(tmp_path / "a.ply").points_map == XYZ).all()


def test_ascii_ply_with_faces_and_colours_is_read(tmp_path: Path) -> None:
    text = (
        HEADER.format("ascii")
        + "property uchar red\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    text += "0 0 1 255\n2 0 1.5 7\n0 2 -3 0\n3 0 1 2\n"
    (tmp_path / "a.ply").write_text(text)
    assert (load_point_map(tmp_path / "a.ply").points_map == XYZ).all()


@pytest.mark.parametrize(
    "text",
    [
        "0 0 1\n2 0 1.5\n0 2 -3\n",
        "x,y,z\n0,0,1\n2,0,1.5\n0,2,-3\n",
        "0;0;1;9\n2;0;1.5;9\n0;2;-3;9\n",
        "# H\xf6he\n0 0 1\n2 0 1.5\n0 2 -3\n",
    ],
)
def test_text_clouds_are_read(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.xyz").write_text(text, encoding="latin-1")
    assert (load_point_map(tmp_path / "a.xyz").points_map == XYZ).all()


def test_las_of_another_program_is_read(tmp_path: Path) -> None:
    las = laspy.create(point_format=3, file_version="1.2")
    las.header.scales = [0.001] * 3
    las.x, las.y, las.z = XYZ.T.astype(float)
    las.write(str(tmp_path / "a.las"))
    assert load_point_map(tmp_path / "a.las").points_map == pytest.approx(XYZ)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.ply", b"", "empty"),
        ("a.ply", b"solid cube\n", "first line"),
        ("a.ply", b"ply\nformat binary_middle_endian 1.0\nend_header\n", "line 2"),
        ("a.ply", b"ply\nelement vertex 1\nproperty float x\nend_header\n0\n", "names no format"),
        ("a.ply", (HEADER.format("binary_little_endian") + "end_header\n").encode() + b"\0" * 20, "cut short"),
        ("a.ply", (HEADER.format("ascii") + "end_header\n0 0 1\n").encode(), "3 rows"),
        ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n", "x, y and z"),
        ("a.ply", HEADER.format("ascii").replace("vertex 3", "vertex -3").encode() + b"end_header\n", "-3 rows"),
        ("a.ply", (HEADER.format("ascii") + "property float x\nend_header\n").encode(), "line 8.*'x' already"),
        (
            "a.ply",
            (HEADER.replace("3\n", "9999999999999\n").format("binary_little_endian") + "end_header\n").encode(),
            "cut",
        ),
        ("a.csv", b"x;y;z\n1,5;2,5;3,5\n", "decimal commas"),
        ("a.las", b"LASFgarbage", "LAS"),
        ("a.laz", b"nothing of the kind", "LAS"),
        ("a.xyz", b"hello world\n", "x, y, z"),
        ("a.xyz", b"\0\1\2\3", "binary"),
        ("a.pdf", b"%PDF", "not a point cloud"),
    ],
)
def test_bad_file_is_refused_and_says_why(tmp_path: Path, name: str, content: bytes, says: str) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FileFormatError, match=says) as raised:
        load_point_map(tmp_path / name)
    assert name in str(raised.value)
