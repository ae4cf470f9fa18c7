"""Poses in the plane and what is known between them, brought into one picture by robust least squares.

Grisetti et al., A Tutorial on Graph-Based SLAM, 2010. Loop closures are weighted down the more they contradict the rest
(Agarwal et al., Robust Map Optimization using Dynamic Covariance Scaling, 2013), so that a wrong one bends nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from companion.messages import Array

Nodes = NDArray[np.int64]

SCALING = 30.0  # Phi of dynamic covariance scaling: chi2 up to which a loop closure keeps its full weight
SLIP = 3.0  # sigma beyond which a step of the odometry counts as a slip and its weight falls (Huber)
MAX_ITERATIONS = 15
SMALL = 1e-4  # m, rad: no pose moves by more: done
FIRM = 1e9  # information that holds the first pose


@dataclass(frozen=True, slots=True)
class Constraint:
    """Pose of node `until` in the frame of node `since` (x, y, yaw), and its (3, 3) information in that frame."""

    since: int
    until: int
    pose: Array
    information: Array
    is_loop: bool


def wrapped(angle: Array) -> Array:
    """To -pi ... pi."""
    inside: Array = (angle + np.pi) % (2.0 * np.pi) - np.pi
    return inside


def relative(since: Array, until: Array) -> Array:
    """Poses (..., 3) of until in the frames of since."""
    c, s = np.cos(since[..., 2]), np.sin(since[..., 2])
    d = until - since
    return np.stack([c * d[..., 0] + s * d[..., 1], -s * d[..., 0] + c * d[..., 1], wrapped(d[..., 2])], axis=-1)


def composed(pose: Array, step: Array) -> Array:
    """Poses (..., 3): step, told in the frame of pose, put after it."""
    c, s = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x = pose[..., 0] + c * step[..., 0] - s * step[..., 1]
    y = pose[..., 1] + s * step[..., 0] + c * step[..., 1]
    return np.stack([x, y, wrapped(pose[..., 2] + step[..., 2])], axis=-1)


def optimised(poses: Array, constraints: list[Constraint]) -> Array:
    """The (N, 3) poses that agree best with the constraints; the first one stays where it is."""
    found = poses.copy()
    if not constraints:
        return found
    since = np.array([c.since for c in constraints])
    until = np.array([c.until for c in constraints])
    measured = np.stack([c.pose for c in constraints])
    information = np.stack([c.information for c in constraints])
    is_loop = np.array([c.is_loop for c in constraints])
    for _ in range(MAX_ITERATIONS):
        error, a, b = _linearised(found[since], found[until], measured)
        chi2 = np.einsum("ni,nij,nj->n", error, information, error)
        held = np.minimum(1.0, 2.0 * SCALING / (SCALING + chi2)) ** 2
        slipped = np.minimum(1.0, SLIP / np.sqrt(np.maximum(chi2, 1e-12)))
        weight = information * np.where(is_loop, held, slipped)[:, None, None]
        step = _solved(len(found), since, until, error, a, b, weight)
        found = found + step
        found[:, 2] = wrapped(found[:, 2])
        if float(np.abs(step).max()) < SMALL:
            break
    return found


def _linearised(since: Array, until: Array, measured: Array) -> tuple[Array, Array, Array]:
    """Errors (N, 3) in the frame of since, and their derivatives (N, 3, 3) by the one pose and by the other."""
    c, s = np.cos(since[:, 2]), np.sin(since[:, 2])
    d = until - since
    now = relative(since, until)
    error = now - measured
    error[:, 2] = wrapped(error[:, 2])
    b = np.zeros((len(since), 3, 3))
    b[:, 0, 0], b[:, 0, 1], b[:, 1, 0], b[:, 1, 1], b[:, 2, 2] = c, s, -s, c, 1.0
    a = -b
    a[:, 0, 2] = -s * d[:, 0] + c * d[:, 1]
    a[:, 1, 2] = -c * d[:, 0] - s * d[:, 1]
    return error, a, b


def _solved(count: int, since: Nodes, until: Nodes, error: Array, a: Array, b: Array, weight: Array) -> Array:
    """One step of Gauss and Newton, (count, 3)."""
    rows, columns, values = [], [], []
    right = np.zeros((count, 3))
    for i, ji in ((since, a), (until, b)):
        np.add.at(right, i, np.einsum("nki,nkl,nl->ni", ji, weight, error))
        for k, jk in ((since, a), (until, b)):
            block = np.einsum("nki,nkl,nlj->nij", ji, weight, jk)
            rows.append(np.broadcast_to((3 * i)[:, None, None] + np.arange(3)[None, :, None], block.shape).ravel())
            columns.append(np.broadcast_to((3 * k)[:, None, None] + np.arange(3)[None, None, :], block.shape).ravel())
            values.append(block.ravel())
    first = np.arange(3)
    system = csc_matrix(
        (
            np.concatenate([*values, np.full(3, FIRM)]),
            (np.concatenate([*rows, first]), np.concatenate([*columns, first])),
        ),
        shape=(3 * count, 3 * count),
    )
    step: Array = splu(system).solve(-right.ravel()).reshape(count, 3)
    step[0] = 0.0  # to the last bit
    return step
