"""The foot of a column by its returns."""

from __future__ import annotations

import numpy as np
import pytest

from companion.messages import Array
from companion.volume.columns import measure_column


def returns(corners: Array, noise_m: float, *, of_turn: float = 1.0, count: int = 3000, seed: int = 1) -> Array:
    """(N, 2) of a polygon about (0, 0), seen from 8 m on all sides, or from a part of the turn."""
    rng = np.random.default_rng(seed)
    bearing = rng.uniform(0.0, 2.0 * np.pi * of_turn, count)
    place = 8.0 * np.column_stack([np.cos(bearing), np.sin(bearing)])
    target = rng.uniform(-0.6, 0.6, (count, 2))
    beam = (target - place) / np.linalg.norm(target - place, axis=1)[:, None]
    nearest = np.full(count, np.inf)
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        edge = b - a
        across = beam[:, 0] * edge[1] - beam[:, 1] * edge[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = ((a[0] - place[:, 0]) * edge[1] - (a[1] - place[:, 1]) * edge[0]) / across
            u = ((a[0] - place[:, 0]) * beam[:, 1] - (a[1] - place[:, 1]) * beam[:, 0]) / across
        nearest = np.where((u >= 0.0) & (u <= 1.0) & (t > 0.0) & (t < nearest), t, nearest)
    hit = np.isfinite(nearest)
    measured = nearest[hit] + rng.normal(0.0, noise_m, int(hit.sum()))
    return np.asarray(place[hit] + measured[:, None] * beam[hit] + [3.0, -2.0])


def box(length: float, width: float, yaw: float = 0.3) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    corners = 0.5 * np.array([[-length, -width], [length, -width], [length, width], [-length, width]])
    return np.asarray(corners @ np.array([[c, s], [-s, c]]))


ROUND = 0.35 * np.column_stack([np.cos(np.arange(64) * np.pi / 32), np.sin(np.arange(64) * np.pi / 32)])


@pytest.mark.parametrize("noise_m", [0.02, 0.06, 0.12])
@pytest.mark.parametrize(
    ("corners", "area_m2"), [(ROUND, np.pi * 0.35**2), (box(0.6, 0.6), 0.36), (box(0.7, 0.45), 0.315)]
)
def test_its_area_is_known_to_a_few_hundredths_whatever_the_noise(
    corners: Array, area_m2: float, noise_m: float
) -> None:
    seen = returns(corners, noise_m)
    column = measure_column(seen, seen, noise_m)
    assert column is not None
    assert column.area_m2 == pytest.approx(area_m2, rel=0.07)
    assert abs(column.area_m2 - area_m2) < 3.0 * column.sigma_m2 < 0.2 * area_m2
    assert np.allclose(column.outline_m.mean(axis=0), [3.0, -2.0], atol=0.03)
    a, b = column.outline_m, np.roll(column.outline_m, -1, axis=0)
    assert 0.5 * float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])) == pytest.approx(column.area_m2)


def test_what_was_seen_from_one_side_or_is_long_or_hardly_seen_is_not_told() -> None:
    one_side, long_wall, few = (
        returns(ROUND, 0.03, of_turn=0.3), returns(box(1.1, 0.2), 0.03), returns(ROUND, 0.03, count=100)
    )  # fmt: skip
    for seen in (one_side, long_wall, few):
        assert measure_column(seen, seen, 0.03) is None
