"""Triangles of the store's walls. The rays see these; contact uses plain boxes behind them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from simbridge.config import Roughness
from simbridge.piles import Waves

Array = NDArray[np.float64]
Faces = NDArray[np.int32]

PANEL_M = 0.5  # edge of a rough wall's triangles: an eighth of the default bumps' wavelength would change nothing


def walls(corners: Array, foot_z: float, top_z: float, roughness: Roughness) -> tuple[Array, Faces]:
    """Vertices (N, 3) and faces (M, 3) of the walls along a closed polygon, from below the floor to the ceiling.

    With roughness each wall bulges in and out, fading to none at its ends so that neighbours still meet.
    """
    vertices, faces, count = [], [], 0
    for i, a in enumerate(corners):
        b = corners[(i + 1) % len(corners)]
        panel_vertices, panel_faces = _wall(a, b, foot_z, top_z, roughness, i)
        vertices.append(panel_vertices)
        faces.append(panel_faces + count)
        count += len(panel_vertices)
    return np.concatenate(vertices), np.concatenate(faces).astype(np.int32)


def _wall(a: Array, b: Array, foot_z: float, top_z: float, roughness: Roughness, index: int) -> tuple[Array, Faces]:
    length = math.dist(a, b)
    rough = roughness.rms_m > 0.0
    across = max(math.ceil(length / PANEL_M), 1) if rough else 1
    up = max(math.ceil((top_z - foot_z) / PANEL_M), 1) if rough else 1
    s, z = np.meshgrid(np.linspace(0.0, length, across + 1), np.linspace(foot_z, top_z, up + 1))
    bulge = np.zeros_like(s)
    if rough:
        waves = Waves(roughness.seed * 1000 + index, roughness.bump_size_m)
        bulge = roughness.rms_m * waves(s, z) * np.clip(np.minimum(s, length - s), 0.0, 1.0)
    along = (b - a) / length
    x = a[0] + s * along[0] - bulge * along[1]
    y = a[1] + s * along[1] + bulge * along[0]
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    n = np.arange(vertices.shape[0]).reshape(s.shape)
    p, q, r, t = (part.ravel() for part in (n[:-1, :-1], n[:-1, 1:], n[1:, 1:], n[1:, :-1]))
    faces = np.concatenate([np.stack([p, q, r], axis=1), np.stack([p, r, t], axis=1)])
    return vertices, faces.astype(np.int32)
