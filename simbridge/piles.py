"""Kinds of stockpile: what a mission file may say, and the height of each.

`top_z(pile, x, y, floor)` gives the height of the pile's surface in `world` metres; where it lies below the floor
there is no material. A cone or ridge stands with its peak `height_m` above the floor under its centre.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import shapely
from numpy.typing import NDArray
from pydantic import Field, field_validator

from simbridge.section import Finite, NonNegative, Point, Positive, Section
from simbridge.streams import stream

Array = NDArray[np.float64]
Floor = Callable[[Array, Array], Array]

FOOT_M = 0.05  # the tail of a gaussian that is lower counts as swept floor
MESH_WANTED = "expected a mesh that trimesh reads (stl, obj, ply, off, glb)"
FUNCTIONS: dict[str, Any] = {
    "abs": np.abs,
    "atan2": np.arctan2,
    "clip": np.clip,
    "cos": np.cos,
    "exp": np.exp,
    "hypot": np.hypot,
    "maximum": np.maximum,
    "minimum": np.minimum,
    "sin": np.sin,
    "sqrt": np.sqrt,
    "tan": np.tan,
    "where": np.where,
}
ALLOWED_NODES = (
    ast.Expression,
    ast.BinOp,
    ast.UnaryOp,
    ast.Call,
    ast.Name,
    ast.Load,
    ast.Constant,
    ast.Compare,
    ast.operator,
    ast.unaryop,
    ast.cmpop,
)


class Waves:
    """Smooth seeded bumps: a sum of plane waves with random directions, RMS 1."""

    COUNT = 24

    def __init__(self, seed: int, shortest_m: float) -> None:
        rng = stream(seed, "pile")
        angle = rng.uniform(0.0, 2.0 * math.pi, self.COUNT)
        length = shortest_m * 4.0 ** rng.random(self.COUNT)
        self._kx = 2.0 * math.pi * np.cos(angle) / length
        self._ky = 2.0 * math.pi * np.sin(angle) / length
        self._phase = rng.uniform(0.0, 2.0 * math.pi, self.COUNT)

    def __call__(self, x: Array, y: Array) -> Array:
        total = np.zeros(np.broadcast(x, y).shape)
        for kx, ky, phase in zip(self._kx, self._ky, self._phase, strict=True):
            total += np.sin(kx * x + ky * y + phase)
        return total * math.sqrt(2.0 / self.COUNT)


class _Pile(Section):
    leaning: bool = Field(False, description="the pile may reach beyond the walls, which then cut it")
    seed: int = Field(0, ge=0, description="of the bumps: the same pile for every seed of the mission")


class _Heap(_Pile):
    """Poured material: flanks at the angle of repose, with seeded bumps."""

    center: Point = Field(description="x, y of the middle, metres")
    height_m: Positive = Field(le=100, description="of the peak above the floor under the centre")
    repose_deg: Finite = Field(34.0, ge=5, le=60, description="slope of the flanks; cement clinker 30 to 37")
    unevenness_m: NonNegative = Field(0.0, le=2, description="RMS of the bumps on the flanks")
    bump_size_m: Positive = Field(3.0, ge=0.5, description="wavelength of the smallest bumps")


class ConePile(_Heap):
    kind: Literal["cone"]


class RidgePile(_Heap):
    kind: Literal["ridge"]
    length_m: Positive = Field(description="of the crest; half a cone stands at each of its ends")
    yaw_deg: Finite = Field(0.0, description="direction of the crest, counter-clockwise from x")


class Hill(Section):
    center: Point
    height_m: Positive = Field(le=100)
    sigma_m: Positive


class GaussiansPile(_Pile):
    """A sum of gaussian hills, cut at `FOOT_M`."""

    kind: Literal["gaussians"]
    hills: tuple[Hill, ...] = Field(min_length=1)


class FunctionPile(_Pile):
    """Height above the floor as an expression of x and y, metres, within a radius around a centre."""

    kind: Literal["function"]
    expression: str = Field(description=f"of x and y; may use {', '.join(sorted(FUNCTIONS))}, pi; below 0: no material")
    center: Point = Field(description="the expression holds around it; x and y stay those of the world")
    radius_m: Positive = Field(description="there is no material beyond")

    @field_validator("expression")
    @classmethod
    def _is_harmless(cls, text: str) -> str:
        compile_expression(text)
        return text


class MeshPile(_Pile):
    """A mesh file (STL, OBJ, PLY, ... in metres, z up); its upper surface counts."""

    kind: Literal["mesh"]
    file: Path = Field(description="path, from the working directory")
    center: Point = Field((0.0, 0.0), description="where the mesh's origin stands")
    scale: Positive = Field(1.0, description="metres per unit of the file")
    yaw_deg: Finite = 0.0

    @field_validator("file")
    @classmethod
    def _can_be_read(cls, path: Path) -> Path:
        if not path.is_file():
            raise ValueError(f"no such file: {path}; {MESH_WANTED}")
        triangles = _mesh_triangles(path)
        if len(triangles) == 0 or not np.all(np.isfinite(triangles)):
            raise ValueError(f"holds no triangles with finite corners; {MESH_WANTED}")
        if float(triangles[:, :, 2].max()) <= 0.0:
            raise ValueError("lies below z = 0 everywhere: the mesh's origin stands on the floor, z up")
        return path


Pile = Annotated[ConePile | RidgePile | GaussiansPile | FunctionPile | MeshPile, Field(discriminator="kind")]


def top_z(pile: Pile, x: Array, y: Array, floor: Floor) -> Array:
    """Height of the pile's surface at each (x, y), `world` metres; below the floor: no material there."""
    match pile:
        case ConePile() | RidgePile():
            return _heap_top_z(pile, x, y, floor)
        case GaussiansPile():
            return floor(x, y) + _hills(pile, x, y)
        case FunctionPile():
            height = np.broadcast_to(compile_expression(pile.expression)(x, y), np.broadcast(x, y).shape)
            inside = np.hypot(x - pile.center[0], y - pile.center[1]) <= pile.radius_m
            return floor(x, y) + np.where(inside & np.isfinite(height), height, -1.0)
        case MeshPile():
            return floor(x, y) + upper_surface(_placed_mesh(pile), x, y)


def outline(pile: Pile) -> Any:
    """Where the pile stands, without its bumps: a shapely polygon."""
    match pile:
        case ConePile() | RidgePile():
            length, yaw = _crest(pile)
            dx, dy = length / 2 * math.cos(yaw), length / 2 * math.sin(yaw)
            x, y = pile.center
            crest = shapely.LineString([(x - dx, y - dy), (x + dx, y + dy)]) if length else shapely.Point(x, y)
            return crest.buffer(pile.height_m / math.tan(math.radians(pile.repose_deg)), quad_segs=32)
        case GaussiansPile():
            return shapely.union_all([shapely.Point(h.center).buffer(_foot_radius_m(h)) for h in pile.hills])
        case FunctionPile():
            return shapely.Point(pile.center).buffer(pile.radius_m)
        case MeshPile():
            return shapely.MultiPoint(_placed_mesh(pile)[:, :, :2].reshape(-1, 2)).convex_hull


def ragged_m(pile: Pile) -> float:
    """How far the foot may lie outside the outline: bumps, and hills that add up."""
    match pile:
        case ConePile() | RidgePile():
            return 3.0 * pile.unevenness_m / math.tan(math.radians(pile.repose_deg))
        case GaussiansPile():
            return 1.0
        case FunctionPile() | MeshPile():
            return 0.0


def _crest(pile: ConePile | RidgePile) -> tuple[float, float]:
    return (pile.length_m, math.radians(pile.yaw_deg)) if isinstance(pile, RidgePile) else (0.0, 0.0)


def _heap_top_z(pile: ConePile | RidgePile, x: Array, y: Array, floor: Floor) -> Array:
    length, yaw = _crest(pile)
    c, s = math.cos(yaw), math.sin(yaw)
    dx, dy = x - pile.center[0], y - pile.center[1]
    from_crest = np.hypot(np.maximum(np.abs(c * dx + s * dy) - length / 2, 0.0), -s * dx + c * dy)
    foot = floor(np.array([pile.center[0]]), np.array([pile.center[1]]))[0]
    top = np.asarray(foot + pile.height_m - math.tan(math.radians(pile.repose_deg)) * from_crest)
    if pile.unevenness_m > 0.0:  # fading out beyond the foot, or bumps would rise from the bare floor far away
        top = top + pile.unevenness_m * Waves(pile.seed, pile.bump_size_m)(x, y) * np.clip(top - foot + 1.0, 0.0, 1.0)
    return top


def _hills(pile: GaussiansPile, x: Array, y: Array) -> Array:
    total = np.full(np.broadcast(x, y).shape, -FOOT_M)
    for hill in pile.hills:
        r2 = (x - hill.center[0]) ** 2 + (y - hill.center[1]) ** 2
        total += hill.height_m * np.exp(-r2 / (2.0 * hill.sigma_m**2))
    return total


def _foot_radius_m(hill: Hill) -> float:
    return hill.sigma_m * math.sqrt(2.0 * math.log(max(hill.height_m / FOOT_M, math.e)))


def compile_expression(text: str) -> Callable[[Array, Array], Array]:
    """A function of x and y from an arithmetic expression; nothing else can be said in it.

    Raises: ValueError: not an expression, or a name or construct that is not allowed.
    """
    try:
        tree = ast.parse(text, mode="eval")
    except SyntaxError as error:
        raise ValueError(f"not an expression: {error.msg}") from None
    except (ValueError, RecursionError, MemoryError) as error:  # a NUL, or brackets thousands deep
        raise ValueError(f"not an expression: {error}") from None
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and node.id not in FUNCTIONS and node.id not in ("x", "y", "pi"):
            raise ValueError(f"unknown name {node.id!r}; allowed are x, y, pi, {', '.join(sorted(FUNCTIONS))}")
        if isinstance(node, ast.Call) and not isinstance(node.func, ast.Name):
            raise ValueError("only the named functions may be called")
        if isinstance(node, ast.Constant) and not isinstance(node.value, int | float):
            raise ValueError(f"only numbers are allowed, not {node.value!r}")
        if not isinstance(node, ALLOWED_NODES):
            raise ValueError(f"{type(node).__name__} is not allowed; allowed is arithmetic and the named functions")
        if isinstance(node, ast.Constant):  # whole numbers of Python grow without end: 9**9**9**9
            node.value = _as_float(node.value)
    code = compile(tree, "<pile>", "eval")
    names = {"__builtins__": {}, "pi": math.pi, **FUNCTIONS}

    def height(x: Array, y: Array) -> Array:
        with np.errstate(all="ignore"):
            return np.asarray(eval(code, names, {"x": x, "y": y}), dtype=np.float64)

    try:
        height(np.array([0.5, 1.5]), np.array([0.5, 1.5])) + np.zeros(2)
    except Exception as error:  # whatever the expression makes numpy raise
        raise ValueError(f"cannot be computed: {error}") from None
    return height


def _as_float(value: object) -> float:
    assert isinstance(value, int | float)
    try:
        return float(value)
    except OverflowError:
        raise ValueError(f"the number is too large: {str(value)[:20]}...") from None


def _placed_mesh(pile: MeshPile) -> Array:
    """(N, 3, 3) triangles of the file in `world`, height above the floor."""
    triangles = _mesh_triangles(pile.file) * pile.scale
    c, s = math.cos(math.radians(pile.yaw_deg)), math.sin(math.radians(pile.yaw_deg))
    turned = triangles @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(turned + np.array([*pile.center, 0.0]))


def _mesh_triangles(path: Path) -> Array:
    """(N, 3, 3) triangles as the file says. Raises: ValueError: not a mesh."""
    import trimesh  # slow to import, and seldom wanted

    try:
        mesh: Any = trimesh.load(path, force="mesh")
    except Exception as error:  # a broken file makes its readers raise whatever they like
        raise ValueError(f"cannot be read as a mesh ({type(error).__name__}: {error}); {MESH_WANTED}") from None
    return np.asarray(mesh.triangles, dtype=np.float64).reshape(-1, 3, 3)


def upper_surface(triangles: Array, x: Array, y: Array) -> Array:
    """Highest point of (N, 3, 3) triangles over each (x, y); -1 where there is none."""
    top = np.full(np.broadcast(x, y).shape, -1.0)
    for a, b, c in triangles:
        det = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
        if abs(det) < 1e-12:
            continue  # a wall of the mesh: its edges belong to its neighbours
        low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
        near = (x >= low[0] - 1e-9) & (x <= high[0] + 1e-9) & (y >= low[1] - 1e-9) & (y <= high[1] + 1e-9)
        px, py = x[near] - a[0], y[near] - a[1]
        v = (px * (c[1] - a[1]) - py * (c[0] - a[0])) / det
        w = (py * (b[0] - a[0]) - px * (b[1] - a[1])) / det
        z = np.where(
            (v >= -1e-9) & (w >= -1e-9) & (v + w <= 1 + 1e-9), a[2] + v * (b[2] - a[2]) + w * (c[2] - a[2]), -1.0
        )
        top[near] = np.maximum(top[near], z)
    return top
