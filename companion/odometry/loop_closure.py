"""Drift taken out of a planar trajectory: places seen before are recognised, and a pose graph is bent until all agree.

In come scans with their poses in `odom`; out come poses in `map`, which may jump whenever a loop is closed. Keyframes are
gathered into places, each a piece of the way with the walls seen from it. A keyframe that comes near an older place is
registered to its walls; what the walls leave open (the way along a bare corridor) stays open, since the constraint's
information is the registration's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from companion.geometry import rotation2
from companion.messages import Array
from companion.odometry.likelihood import LikelihoodGrid, thinned
from companion.odometry.pose_graph import Constraint, composed, optimised, relative
from companion.odometry.wall_map import Registration, WallMap

KEYFRAME_M = 0.3
KEYFRAME_RAD = math.radians(15.0)
PLACE_KEYFRAMES = 16  # to a place; its walls are seen from half as many more on both sides
NEAR_M = 4.0  # to the nearest keyframe of a place, for which it is looked at
PLACES_AT_ONCE = 3
SEARCH_M, SEARCH_RAD = 3.0, math.radians(25.0)  # about where the graph has it, when it does not fit as it is
SEARCH_EVERY = 3  # keyframes; between, only what already fits is registered
GOOD_RATIO = 0.75  # share of the points on walls that is believed as it is
FOUND_RATIO = 0.6  # and after a search
FOUND_SCORE = 0.55
CELL_M = 0.1
SIGMA_RANGE_M = 0.03
GATE_M = 0.3
PRIOR = np.diag([1 / 0.3**2, 1 / 0.3**2, 1 / 0.1**2])  # holds a registration where the walls do not; not believed after
STEP_SIGMA = np.array([0.05, 0.05, 0.01])  # m, m, rad: of one step of the odometry where it sees enough
BLIND_SIGMA = np.array([0.15, 0.15, 0.05])  # where it sees nothing
LOST_SIGMA = np.array([1.0, 1.0, 0.5])  # where a scan was not placed
LOOP_SIGMA = np.array([0.03, 0.03, 0.008])  # of a loop closure at best: places bend within
DEGENERATE_RATIO = 0.03  # of what walls say of the one direction to the other, below which it is noise
OPTIMISE_EVERY = 20  # loop closures
SETTLE_ROUNDS = 2  # at the end all loops are closed anew, from where the graph has come to rest


@dataclass(frozen=True, slots=True)
class _Scan:
    keyframe: int
    step: Array  # pose in the keyframe's frame


@dataclass(slots=True)
class _Place:
    """Keyframes [first, last); walls in the frame of the anchor keyframe."""

    first: int
    last: int
    anchor: int
    walls: WallMap
    grid: LikelihoodGrid


@dataclass(slots=True)
class LoopCloser:
    """Feed it every scan in order with `add`; `poses` gives them all in map. loops: how many were closed."""

    _odom: list[Array] = field(default_factory=list)  # of keyframes
    _map: list[Array] = field(default_factory=list)
    _points: list[Array] = field(default_factory=list)
    _scans: list[_Scan] = field(default_factory=list)
    _places: list[_Place] = field(default_factory=list)
    _constraints: list[Constraint] = field(default_factory=list)
    _unlocked: float = 0.0
    _since_optimised: int = 0
    _is_lost: bool = False

    @property
    def loops(self) -> int:
        return sum(c.is_loop for c in self._constraints)

    def add(self, points: Array, pose_odom: Array, information: Array, *, converged: bool) -> None:
        """points: (N, 2) of one scan; its pose (x, y, yaw) in odom and the (3, 3) information of it, as odometry gave them."""
        self._is_lost = self._is_lost or not converged
        if not self._odom:
            self._keyframe(points, pose_odom)
        elif converged:
            step = relative(self._odom[-1], pose_odom)
            if math.hypot(step[0], step[1]) > KEYFRAME_M or abs(step[2]) > KEYFRAME_RAD:
                known = _step_information(information, is_lost=self._is_lost)
                self._is_lost = False
                self._constraints.append(Constraint(len(self._odom) - 1, len(self._odom), step, known, False))
                self._keyframe(points, pose_odom)
                self._close(len(self._odom) - 1, may_search=len(self._odom) % SEARCH_EVERY == 0)
                if self._since_optimised >= OPTIMISE_EVERY:
                    self._optimise()
        self._scans.append(_Scan(len(self._odom) - 1, relative(self._odom[-1], pose_odom)))

    def poses(self) -> Array:
        """(N, 3) of all scans that came, in map."""
        if not self._scans:
            return np.zeros((0, 3))
        for _ in range(SETTLE_ROUNDS):
            self._optimise()
            self._constraints = [c for c in self._constraints if not c.is_loop]
            for keyframe in range(len(self._odom)):
                self._close(keyframe, may_search=False)
        self._optimise()
        keyframes = np.stack(self._map)[[s.keyframe for s in self._scans]]
        return composed(keyframes, np.stack([s.step for s in self._scans]))

    # ---- keyframes and places ----------------------------------------------------------------------------------------

    def _keyframe(self, points: Array, pose_odom: Array) -> None:
        if self._odom:
            pose_map = composed(self._map[-1], relative(self._odom[-1], pose_odom))
        else:
            pose_map = pose_odom
        self._odom.append(pose_odom.copy())
        self._map.append(pose_map)
        self._points.append(points)
        first = len(self._places) * PLACE_KEYFRAMES
        if len(self._odom) >= first + PLACE_KEYFRAMES * 3 // 2:
            self._places.append(self._place(first, first + PLACE_KEYFRAMES))

    def _place(self, first: int, last: int) -> _Place:
        anchor = (first + last) // 2
        around = range(max(0, first - PLACE_KEYFRAMES // 2), last + PLACE_KEYFRAMES // 2)
        seen = [_moved(self._points[k], relative(self._odom[anchor], self._odom[k])) for k in around]
        walls = WallMap(CELL_M)
        for points in seen:
            walls.insert(points, 0.0, np.zeros(3))
        return _Place(first, last, anchor, walls, LikelihoodGrid(np.concatenate(seen)))

    # ---- loops -------------------------------------------------------------------------------------------------------

    def _close(self, keyframe: int, *, may_search: bool) -> None:
        """Register a new keyframe to the nearest places of old."""
        near: list[tuple[float, int]] = []
        for index, place in enumerate(self._places):
            if place.last + PLACE_KEYFRAMES > keyframe:
                break
            away = np.stack(self._map[place.first : place.last])[:, :2] - self._map[keyframe][:2]
            distance = float(np.hypot(away[:, 0], away[:, 1]).min())
            if distance < NEAR_M:
                near.append((distance, index))
        for _, index in sorted(near)[:PLACES_AT_ONCE]:
            place = self._places[index]
            guess = relative(self._map[place.anchor], self._map[keyframe])
            found = self._recognise(place, self._points[keyframe], guess, may_search=may_search)
            if found is not None:
                self._constraints.append(Constraint(place.anchor, keyframe, found.pose, _loop_information(found), True))
                self._since_optimised += 1

    def _recognise(self, place: _Place, points: Array, guess: Array, *, may_search: bool) -> Registration | None:
        found = _register(place, points, guess)
        if found.inliers >= GOOD_RATIO * len(points):
            return found
        if not may_search:
            return None
        fit = place.grid.search(thinned(points), guess, window_m=SEARCH_M, window_rad=SEARCH_RAD)
        if fit.score < FOUND_SCORE:
            return None
        found = _register(place, points, fit.pose)
        return found if found.inliers >= FOUND_RATIO * len(points) else None

    def _optimise(self) -> None:
        self._since_optimised = 0
        self._map = list(optimised(np.stack(self._map), self._constraints))


def _register(place: _Place, points: Array, guess: Array) -> Registration:
    return place.walls.register(points, guess, PRIOR, sigma_range_m=SIGMA_RANGE_M, gate_m=GATE_M, max_iterations=20)


def _moved(points: Array, pose: Array) -> Array:
    placed: Array = points @ rotation2(float(pose[2])).T + pose[:2]
    return placed


def _step_information(information: Array, *, is_lost: bool) -> Array:
    """Of a step of the odometry: no more than STEP_SIGMA allows, no less than BLIND_SIGMA."""
    if is_lost:
        return np.diag(1.0 / LOST_SIGMA**2)
    return np.linalg.inv(np.linalg.inv(information + np.diag(1.0 / BLIND_SIGMA**2)) + np.diag(STEP_SIGMA**2))


def _loop_information(found: Registration) -> Array:
    """Of a loop closure, in the frame of the place: what the walls say and no prior, at most what LOOP_SIGMA allows.

    Along a bare corridor the noise of its lines' normals alone says a little, the same with each scan; that is left out
    (Zhang, Kaess and Singh, On Degeneracy of Optimization-based State Estimation Problems, ICRA 2016).
    """
    known = found.information
    strength, directions = np.linalg.eigh(known[:2, :2])
    if strength[0] < DEGENERATE_RATIO * strength[1]:
        across = np.eye(3)
        across[:2, :2] -= np.outer(directions[:, 0], directions[:, 0])
        known = across @ known @ across
    nothing = np.diag([1e-2, 1e-2, 1e-1])
    return np.linalg.inv(np.linalg.inv(known + nothing) + np.diag(LOOP_SIGMA**2))
