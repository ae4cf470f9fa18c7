"""Small systems: solved, weighted against outliers, reduced to the unknowns that are asked for."""

from __future__ import annotations

import math

import numpy as np

from companion.jit import kernel
from companion.messages import Array

TUKEY = 4.685


@kernel
def solve3(a: Array, b: Array) -> Array:
    """Solve a symmetric positive definite (3, 3) system by Cholesky."""
    l00 = math.sqrt(max(a[0, 0], 1e-12))
    l10, l20 = a[1, 0] / l00, a[2, 0] / l00
    l11 = math.sqrt(max(a[1, 1] - l10 * l10, 1e-12))
    l21 = (a[2, 1] - l20 * l10) / l11
    l22 = math.sqrt(max(a[2, 2] - l20 * l20 - l21 * l21, 1e-12))
    y0 = b[0] / l00
    y1 = (b[1] - l10 * y0) / l11
    y2 = (b[2] - l20 * y0 - l21 * y1) / l22
    x = np.empty(3)
    x[2] = y2 / l22
    x[1] = (y1 - l21 * x[2]) / l11
    x[0] = (y0 - l10 * x[1] - l20 * x[2]) / l00
    return x


@kernel
def solve_spd(a: Array, b: Array) -> Array:
    """Solve a small symmetric positive definite system by Cholesky."""
    n = len(b)
    low = np.zeros((n, n))
    y, x = np.zeros(n), np.zeros(n)
    for i in range(n):
        for j in range(i + 1):
            total = a[i, j]
            for k in range(j):
                total -= low[i, k] * low[j, k]
            low[i, j] = math.sqrt(max(total, 1e-12)) if i == j else total / low[j, j]
    for i in range(n):
        y[i] = b[i]
        for k in range(i):
            y[i] -= low[i, k] * y[k]
        y[i] /= low[i, i]
    for i in range(n - 1, -1, -1):
        x[i] = y[i]
        for k in range(i + 1, n):
            x[i] -= low[k, i] * x[k]
        x[i] /= low[i, i]
    return x


@kernel
def solve_robustly(jac: Array, res: Array, var: Array, prior: Array, iterations: int) -> tuple[Array, Array, float]:
    """Tukey-weighted least squares of res + jac x with x about 0; returns x, the points' information and the scale."""
    n, m = jac.shape
    x = np.zeros(m)
    h = np.zeros((m, m))
    u = np.empty(n)
    scale = 1.0
    for _ in range(iterations):
        for i in range(n):
            total = res[i]
            for k in range(m):
                total += jac[i, k] * x[k]
            u[i] = total / math.sqrt(var[i])
        scale = min(max(1.4826 * np.median(np.abs(u)), 0.7), 4.0)
        h[:] = 0.0
        g = prior @ x
        for i in range(n):
            v = u[i] / (TUKEY * scale)
            if abs(v) >= 1.0:
                continue
            w = (1.0 - v * v) ** 2 / (var[i] * scale * scale)
            r = u[i] * math.sqrt(var[i])
            for k in range(m):
                g[k] += w * jac[i, k] * r
                for j in range(m):
                    h[k, j] += w * jac[i, k] * jac[i, j]
        x = x - solve_spd(h + prior, g)
    return x, h, scale


@kernel
def without(h: Array, keep: int) -> Array:
    """Information of the first `keep` unknowns when the others are left free (Schur complement)."""
    n = h.shape[0]
    out = h[:keep, :keep].copy()
    for k in range(keep):
        part = solve_spd(h[keep:, keep:].copy(), h[keep:, k].copy())
        for j in range(keep):
            for m in range(n - keep):
                out[j, k] -= h[j, keep + m] * part[m]
    return out


@kernel
def without_translation(system: Array) -> float:
    """Information about yaw when x and y are left free; at least 0."""
    a, b, c = system[0, 0] + 1e-6, system[0, 1], system[1, 1] + 1e-6
    u, v = system[0, 2], system[1, 2]
    return max(float(system[2, 2] - (c * u * u - 2.0 * b * u * v + a * v * v) / max(a * c - b * b, 1e-12)), 0.0)
