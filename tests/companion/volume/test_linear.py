"""Linear interpolation over a triangulation gives what SciPy's `griddata` gives, and does not search for it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import griddata

from companion.volume.linear import linear_on_grid

X = np.arange(-0.5, 10.6, 0.25)
Y = np.arange(-0.25, 6.3, 0.2)


def test_it_is_what_griddata_gives() -> None:
    rng = np.random.default_rng(1)
    nodes = rng.uniform([0, 0], [10, 6], (800, 2))
    nodes = nodes[np.hypot(nodes[:, 0] - 5, nodes[:, 1] - 3) > 1.5]  # a hole that long triangles cross
    z = np.sin(nodes[:, 0]) + 0.3 * nodes[:, 1]
    expected = griddata(nodes, z, tuple(np.meshgrid(X, Y)), method="linear")
    given = linear_on_grid(nodes, z, X, Y)
    assert given.shape == (len(Y), len(X))
    np.testing.assert_array_equal(np.isnan(given), np.isnan(expected))
    assert 0.02 < np.isnan(given).mean() < 0.4
    np.testing.assert_allclose(given, expected, atol=1e-12)


def test_a_centre_on_an_edge_or_a_node_is_not_missed() -> None:
    x, y = np.meshgrid(np.arange(5.0), np.arange(4.0))
    nodes = np.column_stack([x.ravel(), y.ravel()])
    fine = np.arange(0.0, 3.01, 0.5)
    given = linear_on_grid(nodes, 2.0 * nodes[:, 0] - nodes[:, 1], fine, fine)
    np.testing.assert_allclose(given, 2.0 * fine[None, :] - fine[:, None], atol=1e-12)


@pytest.mark.parametrize(
    "nodes", [np.zeros((0, 2)), np.zeros((2, 2)), np.column_stack([np.arange(9.0), np.arange(9.0)])]
)
def test_what_makes_no_triangle_makes_no_surface(nodes: np.ndarray) -> None:
    assert np.isnan(linear_on_grid(nodes, np.ones(len(nodes)), X, Y)).all()


def test_a_strip_seen_of_a_wide_hall_takes_no_longer_than_a_full_one() -> None:
    """Where nine tenths of the grid lie beyond the nodes, a search for each centre took minutes."""
    rng = np.random.default_rng(2)
    nodes = np.concatenate([rng.uniform([0, 0], [60, 0.5], (4000, 2)), rng.uniform([0, 0], [0.5, 60], (4000, 2))])
    wide = np.arange(-40.0, 100.0, 0.25)
    given = linear_on_grid(nodes, nodes[:, 0], wide, wide)
    inside = np.isfinite(given)
    assert 0.02 < inside.mean() < 0.2
    np.testing.assert_allclose(given[inside], np.broadcast_to(wide, given.shape)[inside], atol=1e-6)
