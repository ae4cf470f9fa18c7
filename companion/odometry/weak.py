"""Where walls do not hold the pose along an axis: what may still be believed there, and how it is found again.

A registration in a long corridor moves along it by chance: noise in the walls' normals looks like information. So the
axis is left out of the update, state and covariance alike, and carried by tilt and velocity only.
Source: Zhang, Kaess, Singh, "On degeneracy of optimization-based state estimation problems", ICRA 2016 (remapping).
"""

from __future__ import annotations

import numpy as np

from companion.messages import Array
from companion.odometry.degeneracy import MIN_EIGENVALUE_RATIO, weak_direction
from companion.odometry.filter import Planar, restart
from companion.odometry.wall_map import Registration, WallMap

SURE_OF_STANDING_RATIO = 0.1  # of eigenvalues: walls that hold less cannot tell at once a slow flight from standing
LOST_M = 0.3  # sigma along the axis above which nothing is put into the map and a search must confirm the pose
MAX_SPEED_MPS = 1.5  # more than the vehicle is ever flown at
VELOCITY_DECAY_S = 10.0  # drag
ACCELERATION_DECAY_S = 5.0  # what tilt does not explain was learned before; it does not last
FLYING_SIGMA_MPS = 1.0  # of a vehicle whose motion cannot be seen
FLYING_SIGMA_M = 0.1  # what it moved meanwhile: from one scan to the next
AXIS_MEMORY = 0.97  # of the information that tells the axis, from scan to scan
AXIS_SIGMA_RAD = 0.01  # of its direction: what is unknown along it is unknown across it by so much
HELD_SIGMA_M = 1e-4
GROUND_SIGMA_M = 0.05  # along the axis, by slopes: the ground's map errs too
GROUND_SIGMA_MOST_M = 0.2
GROUND_SIGMAS = 4.0
MOST_MOVED_M = 0.3
QUALITY_M = 0.1  # sigma up to which quality is not cut
STEP_M = 0.5  # of the search; less than the gate of a registration
MAX_SEARCH_M = 15.0
THINNED_POINTS = 256
MISSING_RATIO = 0.03  # of the layer's points without a wall: below it there is nothing to find
MIN_LEAD_RATIO = 0.03  # of the layer's points that the place found must explain beyond any other
ELSEWHERE_M = 1.0
FOUND_SIGMA_M = 0.1


def widest_axis(state: Planar) -> Array:
    """(2,) the direction in map along which the position is least known."""
    return np.asarray(np.linalg.eigh(state.p[:2, :2])[1][:, 1])


def sigma_along(state: Planar, axis: Array) -> float:
    """Of the position, in m."""
    return float(np.sqrt(axis @ state.p[:2, :2] @ axis))


def held(prior_information: Array, axis: Array) -> Array:
    """The prior of a registration that may not move along the axis."""
    information = prior_information.copy()
    information[:2, :2] += np.outer(axis, axis) / HELD_SIGMA_M**2
    return information


def without_axis(registration: Registration, axis: Array) -> tuple[Array, Array]:
    """Its information, and what it went by, (3, 3) each, as if no point had told of the axis."""
    keep = np.eye(3)
    keep[:2, :2] -= np.outer(axis, axis)
    return keep @ registration.information @ keep, keep @ registration.apparent_information @ keep


def settle(state: Planar, axis: Array, dt_s: float) -> Planar:
    """Unseen along the axis for dt_s: drag slows it, what tilt does not explain fades, and nobody flies that fast.

    With the noise of carry this is bounded: about 1 m/s of velocity unknown in the long run.
    """
    along = np.outer(axis, axis)
    fade = np.eye(8)
    fade[2:4, 2:4] -= (1.0 - np.exp(-dt_s / VELOCITY_DECAY_S)) * along
    fade[4:6, 4:6] -= (1.0 - np.exp(-dt_s / ACCELERATION_DECAY_S)) * along
    x = fade @ state.x
    speed = float(axis @ x[2:4])
    x[2:4] -= (speed - min(max(speed, -MAX_SPEED_MPS), MAX_SPEED_MPS)) * axis
    return Planar(state.t_ns, x, fade @ state.p @ fade.T)


def in_flight(state: Planar, axis: Array) -> Planar:
    """Taken for standing, but flying for all that is known: any velocity along the axis."""
    p = state.p.copy()
    p[:2, :2] += np.outer(axis, axis) * FLYING_SIGMA_M**2
    p[2:4, 2:4] += np.outer(axis, axis) * FLYING_SIGMA_MPS**2
    return Planar(state.t_ns, state.x, p)


def held_by_ground(state: Planar, axis: Array, moved_m: float, information: float) -> Planar:
    """With what the slopes of the ground tell of the place along the axis; as it was where that is little, or not believed."""
    if information < 1.0 / GROUND_SIGMA_MOST_M**2:
        return state
    variance = 1.0 / information + GROUND_SIGMA_M**2
    toward = state.p[:, :2] @ axis
    total = float(axis @ toward[:2]) + variance
    if abs(moved_m) > max(MOST_MOVED_M, GROUND_SIGMAS * np.sqrt(total)):
        return state
    p = state.p - np.outer(toward, toward) / total
    return Planar(state.t_ns, state.x + toward * (moved_m / total), 0.5 * (p + p.T))


def axis_variance(sigma_m: float) -> Array:
    """(3,) by how little x, y, yaw are known across an axis along which sigma_m is unknown: its direction errs."""
    return np.array([1.0, 1.0, 0.0]) * (AXIS_SIGMA_RAD * sigma_m) ** 2


def found_again(state: Planar, pose: Array) -> Planar:
    """There, as fast as was thought."""
    there = restart(state, pose)
    there.x[2:4] = state.x[2:4]
    return there


def quality_at(sigma_m: float, quality: int) -> int:
    """Below 20 where sigma along the axis is above 0.5 m."""
    return max(1, min(quality, int(100.0 * QUALITY_M / max(sigma_m, 1e-6))))


def find_along(
    walls: WallMap, layer: Array, guess: Array, axis: Array, sigma_m: float, z_m: float, sigma_range_m: float
) -> Registration | None:
    """The one place along the axis, within 3 sigma, where clearly more walls fit than anywhere else, and hold the pose.

    None when there is none, or more than one.
    """
    reach = int(np.ceil(min(3.0 * sigma_m, MAX_SEARCH_M) / STEP_M))
    thin = np.ascontiguousarray(layer[:: max(1, len(layer) // THINNED_POINTS)])
    free = np.diag([1.0, 1.0, 100.0])
    trials = []
    for k in range(-reach, reach + 1):
        start = guess + np.append(k * STEP_M * axis, 0.0)
        trials.append(walls.register(thin, start, free, z_m=z_m, sigma_range_m=sigma_range_m, max_iterations=6))
    trials = [t for t in trials if np.isfinite(t.pose).all()]
    if not trials:
        return None
    best = max(trials, key=lambda t: t.inliers)
    place = float(axis @ best.pose[:2])
    others = [t.inliers for t in trials if abs(float(axis @ t.pose[:2]) - place) > ELSEWHERE_M]
    if others and best.inliers - max(others) < MIN_LEAD_RATIO * len(thin):
        return None
    final = walls.register(layer, best.pose, free, z_m=z_m, sigma_range_m=sigma_range_m, max_iterations=20)
    return final if final.converged and _holds(final, axis) else None


def _holds(registration: Registration, axis: Array) -> bool:
    ratio, _ = weak_direction(registration.information)
    along = float(axis @ registration.information[:2, :2] @ axis)
    return ratio >= MIN_EIGENVALUE_RATIO and along > 1.0 / FOUND_SIGMA_M**2
