"""The MuJoCo model: what rays see, what the vehicle may touch, and the vehicle itself.

Rays see the walls (one-sided planes; a mesh where they are rough or many), the piles' mesh, floor and ceiling planes and
the obstacles. The vehicle touches the obstacles, plain boxes behind the walls, and one small plane, `ground`, that is
moved under it and tilted like the surface there: MuJoCo would take a mesh's convex hull, and its height fields are slow
for rays.
"""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from simbridge import footprint as fp
from simbridge import meshes
from simbridge.config import VehicleConfig, WorldConfig
from simbridge.sensors import GRAVITY_MPS2
from simbridge.surface import Surface

Array = NDArray[np.float64]

STEP_S = 0.004
SEEN, TOUCHED, BOTH = 0, 1, 2  # geom groups: for rays, for contact, for both
RAY_GROUPS = np.array([1, 0, 1, 0, 0, 0], dtype=np.uint8)
BODY_HALF_M = (0.25, 0.25, 0.05)  # arms with their guards
FOOT_Z_M = -0.12  # lowest point of the landing gear below the centre of mass
FOOT_RADIUS_M = 0.02
WALL_THICKNESS_M = 0.5
MOST_PLANES = 16  # more walls than these a mesh's tree finds faster: a plane is tried for every ray
OVERLAP_M = 0.01  # by which a wall's plane goes on behind its neighbour, so that no ray slips through the corner
SHELL = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL  # open surfaces have no volume to compute inertia from


def build_model(world: WorldConfig, surface: Surface, vehicle: VehicleConfig | None) -> mujoco.MjModel:
    """The compiled store, with a vehicle (body `vehicle`) unless None."""
    spec = mujoco.MjSpec()
    spec.option.timestep = STEP_S / (vehicle.substeps if vehicle else 1)
    spec.option.gravity = [0.0, 0.0, -GRAVITY_MPS2]
    _add_hall(spec, world, surface)
    for obstacle in fp.obstacles(world):
        _add_obstacle(spec, obstacle)
    vertices, faces = surface.triangles()
    if len(faces):
        _add_mesh(spec, "piles", vertices, faces)
    if vehicle is not None:
        _add_ground(spec)
        _add_vehicle(spec, vehicle)
    return spec.compile()


def _add_mesh(spec: Any, name: str, vertices: Array, faces: NDArray[np.int32]) -> None:
    mesh = spec.add_mesh()
    mesh.name = name
    mesh.uservert, mesh.userface, mesh.inertia = vertices.ravel(), faces.ravel(), SHELL
    _add_geom(spec.worldbody, name, mujoco.mjtGeom.mjGEOM_MESH, SEEN).meshname = name


def _add_geom(body: Any, name: str, kind: Any, group: int) -> Any:
    geom = body.add_geom()
    geom.name, geom.type, geom.group = name, kind, group
    geom.contype = geom.conaffinity = 0 if group == SEEN else 1
    return geom


def _add_hall(spec: Any, world: WorldConfig, surface: Surface) -> None:
    corners = fp.corners(world.footprint)
    if fp.signed_area(corners) < 0.0:
        corners = corners[::-1]
    low = float(surface.floor.min()) - 1.0
    top = world.height_m + 0.5
    if world.wall_roughness.rms_m > 0.0 or len(corners) > MOST_PLANES:
        _add_mesh(spec, "walls", *meshes.walls(corners, low, top, world.wall_roughness))
    else:
        _add_wall_planes(spec, corners, low, top)
    middle = fp.outline(world.footprint).centroid
    floor = _add_geom(spec.worldbody, "floor", mujoco.mjtGeom.mjGEOM_PLANE, SEEN)
    floor.size, floor.pos = [0.0, 0.0, 1.0], [middle.x, middle.y, 0.0]
    floor.quat = tilt_wxyz(*world.floor_slope)
    ceiling = _add_geom(spec.worldbody, "ceiling", mujoco.mjtGeom.mjGEOM_PLANE, BOTH)
    ceiling.size, ceiling.pos, ceiling.quat = [0.0, 0.0, 1.0], [0.0, 0.0, world.height_m], [0.0, 1.0, 0.0, 0.0]
    for i, a in enumerate(corners):
        b = corners[(i + 1) % len(corners)]
        wall = _add_geom(spec.worldbody, f"wall {i}", mujoco.mjtGeom.mjGEOM_BOX, TOUCHED)
        yaw, half = math.atan2(b[1] - a[1], b[0] - a[0]), WALL_THICKNESS_M / 2
        middle_xy = (a + b) / 2 + half * np.array([math.sin(yaw), -math.cos(yaw)])
        wall.size = [math.dist(a, b) / 2, half, (world.height_m - low) / 2]
        wall.pos = [middle_xy[0], middle_xy[1], (world.height_m + low) / 2]
        wall.quat = [math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]


def _add_wall_planes(spec: Any, corners: Array, foot_z: float, top_z: float) -> None:
    """A plane for each wall of a counter-clockwise polygon, facing inwards: a third of a mesh's time for each ray.

    At an outer corner a plane goes on a little behind its neighbour; at an inner one that would be inside the hall.
    """
    along = np.roll(corners, -1, axis=0) - corners
    length = np.hypot(along[:, 0], along[:, 1])
    before = np.roll(along, 1, axis=0)
    beyond = np.where(before[:, 0] * along[:, 1] - before[:, 1] * along[:, 0] > 0.0, OVERLAP_M, 0.0)  # at each corner
    for i, a in enumerate(corners):
        first, last = -beyond[i], length[i] + beyond[(i + 1) % len(corners)]
        middle = a + along[i] / length[i] * (first + last) / 2.0
        yaw = math.atan2(along[i, 1], along[i, 0])
        wall = _add_geom(spec.worldbody, f"face {i}", mujoco.mjtGeom.mjGEOM_PLANE, SEEN)
        wall.size = [(last - first) / 2.0, (top_z - foot_z) / 2.0, 1.0]
        wall.pos = [middle[0], middle[1], (foot_z + top_z) / 2.0]
        back, up = yaw + math.pi, math.sqrt(0.5)  # x back along the wall, y up, so z inwards
        wall.quat = [up * math.cos(back / 2), up * math.cos(back / 2), up * math.sin(back / 2), up * math.sin(back / 2)]


def _add_obstacle(spec: Any, obstacle: fp.Obstacle) -> None:
    kind = mujoco.mjtGeom.mjGEOM_CYLINDER if obstacle.is_round else mujoco.mjtGeom.mjGEOM_BOX
    geom = _add_geom(spec.worldbody, obstacle.name, kind, BOTH)
    x, y, z = obstacle.half_m
    geom.size = [x, z, 0.0] if obstacle.is_round else [x, y, z]
    geom.pos = [*obstacle.center, obstacle.foot_z + z]
    geom.quat = [math.cos(obstacle.yaw_rad / 2), 0.0, 0.0, math.sin(obstacle.yaw_rad / 2)]


def _add_ground(spec: Any) -> None:
    body = spec.worldbody.add_body()
    body.name, body.mocap, body.pos = "ground", True, [0.0, 0.0, -100.0]
    geom = _add_geom(body, "ground", mujoco.mjtGeom.mjGEOM_PLANE, TOUCHED)
    geom.size = [0.0, 0.0, 1.0]


def _add_vehicle(spec: Any, vehicle: VehicleConfig) -> None:
    body = spec.worldbody.add_body()
    body.name = "vehicle"
    body.add_freejoint()
    body.explicitinertial = True
    body.mass, body.inertia, body.ipos = vehicle.mass_kg, list(vehicle.inertia_kgm2), [0.0, 0.0, 0.0]
    hull = _add_geom(body, "hull", mujoco.mjtGeom.mjGEOM_BOX, TOUCHED)
    hull.size = list(BODY_HALF_M)
    for i, (x, y) in enumerate(((1, -1), (-1, 1), (1, 1), (-1, -1))):
        foot = _add_geom(body, f"foot {i}", mujoco.mjtGeom.mjGEOM_SPHERE, TOUCHED)
        foot.size, foot.pos = [FOOT_RADIUS_M, 0.0, 0.0], [0.15 * x, 0.15 * y, FOOT_Z_M + FOOT_RADIUS_M]


def tilt_wxyz(slope_x: float, slope_y: float) -> list[float]:
    """Shortest rotation that takes z to the normal of a plane rising by these ratios."""
    length = math.sqrt(slope_x**2 + slope_y**2 + 1.0)
    w, x, y = 1.0 + 1.0 / length, slope_y / length, -slope_x / length
    scale = 1.0 / math.sqrt(w * w + x * x + y * y)
    return [w * scale, x * scale, y * scale, 0.0]
