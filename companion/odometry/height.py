"""Height of the body above where it stood, and the tilt error, kept from scan to scan."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from companion.messages import Array, RangefinderSample
from companion.odometry import filter as kalman
from companion.odometry.attitude import AttitudeHistory
from companion.odometry.height_map import BEND_SIGMA_RAD, HeightFit, HeightMap
from companion.odometry.tilt import Tilt
from companion.odometry.turned import TurnedBy
from companion.odometry.wall_map import WallMap

BLOCK_SIGMA_RATIO = 0.5  # means of blocks of about four returns
RANGEFINDER_SIGMA_M = 0.03
RANGEFINDER_RADIUS_M = 1.0  # about the start: there the floor below is known from standing on it
Z_FLOOR_SIGMA_M = 0.004
START_RADIUS_M = 2.0  # about the start: ground that a standing LiDAR sees
START_FLAT_M = 0.02  # RMS of the cells there about a plane, above which it is no floor
START_CELLS = 6
GATE_SIGMAS = 5.0
MIN_GATE_M = 0.1
MIN_GROUND_POINTS = 20
SHIFT_SIGMA_M = 0.008  # of x and y beside their covariance: lines are a little off too
MAX_REJECTED = 10
OFF_REJECTED = 2  # in a row: what is accepted then is another height, not a climb
OFF_SCANS = 5  # without a height: what was known of the climb is not carried on
JUMP_M = 0.5  # a height that is found so far off is a restart
CONTRADICTED_M = 0.5  # by which the rangefinder may differ from a height that was refused before (dust)
FRESH_NS = 500_000_000  # age of a reading that still counts
OVER_GROUND_SIGMA_M = 0.15  # of the height by rangefinder and ground map, off the start


@dataclass(frozen=True, slots=True)
class HeightResult:
    """correction: (3,) of z, roll, pitch against the prediction; z_sigma_m of it; ground: points for the map."""

    correction: Array
    z_sigma_m: float
    new_ground: Array
    ground_points: int
    wall_points: int


class HeightTracker:
    """Fits each scan's lower layers to the ground map; near the start the rangefinder helps."""

    def __init__(self, sensor_up_m: float, scan_s: float) -> None:
        self.ground = HeightMap()
        self.is_standing = True
        self.map_variance = 0.0
        self._sensor_up_m = sensor_up_m
        self._middle_ns = round(0.5e9 * scan_s)  # of a scan, before its end
        self._rangefinder: deque[RangefinderSample] = deque(maxlen=64)
        self._rest_m, self._rests = 0.0, 0  # mean reading while standing, and of how many
        self._floor_m: float | None = None  # by the LiDAR, once it has left the ground
        self._tilt = Tilt()
        self._highest_m = 0.0
        self.has_jumped = False  # by the last scan
        self._rejected = 0
        self._unmeasured = 0  # scans without a height
        self._t_ns = 0

    @property
    def tilt_offset_rad(self) -> tuple[float, float]:
        return float(self._tilt.offset[0]), float(self._tilt.offset[1])

    @property
    def lidar_turned_by(self) -> TurnedBy:
        return self._tilt.turned.by

    def drift_variance(self) -> float:
        """Of z where the body is, m2, by the tilt that the ground's map was built with on the way there."""
        return self._tilt.drift_variance()

    @property
    def floor_m(self) -> float | None:
        """Floor under the start, in map: by the ground that the LiDAR saw around it while standing, where that is a plane;
        else by the rangefinder, which on its legs reads near its least range, where only its longer readings come through.
        """
        if self._floor_m is not None:
            return self._floor_m
        return -self._rest_m if self._rests >= 5 else None

    def leave_ground(self) -> None:
        """Standing has ended: what the LiDAR saw of the floor until now is the best that will be known of it there."""
        plane = self.ground.plane_about(0.0, 0.0, START_RADIUS_M)
        if plane is not None and plane.rms_m < START_FLAT_M and plane.cells >= START_CELLS:
            self._floor_m = plane.z_m

    def floor_below_m(self, z_m: float) -> float:
        """Levelled height under which a point of the horizontal layer is the floor, not a wall."""
        floor = self.floor_m
        return -math.inf if floor is None else floor - z_m + 0.1

    def on_rangefinder(self, sample: RangefinderSample) -> None:
        """Not finite, or not positive: nothing below within range."""
        if not (math.isfinite(sample.distance_m) and sample.distance_m > 0.0):
            return
        if self.is_standing:
            self._rests += 1
            self._rest_m += (sample.distance_m - self._rest_m) / self._rests
        self._rangefinder.append(sample)

    def fit(
        self, lower: Array, planar: kalman.Planar, vertical: kalman.Vertical, walls: WallMap, sigma_m: float
    ) -> HeightFit:
        shift = planar.p[:2, :2] + np.eye(2) * SHIFT_SIGMA_M**2
        return self.ground.fit(
            lower,
            planar.x[kalman.POSE],
            float(vertical.x[0]),
            walls,
            sigma_range_m=BLOCK_SIGMA_RATIO * sigma_m,
            gate_m=_ground_gate_m(vertical),
            seen_spread_m=self._highest_m,
            lean=self._tilt.lean,
            tilt_information=self._tilt.information,
            shift_information=np.asarray(np.linalg.inv(shift), np.float64),
        )

    def shift_along(
        self,
        lower: Array,
        planar: kalman.Planar,
        vertical: kalman.Vertical,
        walls: WallMap,
        sigma_m: float,
        axis: Array,
        tilt: Array,
    ) -> tuple[float, float]:
        """How far the body is off along axis, (2,) in map, by the slopes of the ground, and the information about that; after
        `update` of the same scan, which found its tilt (2,)."""
        return self.ground.shift_along(
            lower,
            planar.x[kalman.POSE],
            float(vertical.x[0]),
            walls,
            axis,
            tilt=tilt,
            variances=np.append(vertical.p[0, 0], np.diag(self._tilt.p)[:2] + BEND_SIGMA_RAD**2),
            sigma_range_m=BLOCK_SIGMA_RATIO * sigma_m,
            gate_m=_ground_gate_m(vertical),
            seen_spread_m=self._highest_m,
        )

    def update(
        self,
        lower: Array,
        planar: kalman.Planar,
        vertical: kalman.Vertical,
        history: AttitudeHistory,
        walls: WallMap,
        sigma_m: float,
    ) -> tuple[kalman.Vertical, HeightResult]:
        """Vertical state after this scan. lower: (N, 3) levelled points of the layers below the horizontal one."""
        ranged = self._use_rangefinder(vertical, planar.x[kalman.POSE], history)
        if ranged is not vertical:
            vertical, self._unmeasured = ranged, 0
        dt_s = max(0.0, (vertical.t_ns - self._t_ns) * 1e-9) if self._t_ns else 0.0
        self._t_ns = vertical.t_ns
        self._tilt.carry(dt_s, np.append(planar.x[:2], vertical.x[0]))
        self.has_jumped = False
        is_off = self._rejected >= OFF_REJECTED or self._unmeasured >= OFF_SCANS
        if self._unmeasured >= OFF_SCANS:  # it would fly away with the velocity that it had, and the vehicle after it
            vertical = kalman.stopped_vertical(vertical)
        self._unmeasured += 1
        fit = self.fit(lower, planar, vertical, walls, sigma_m)
        self._highest_m = max(self._highest_m, float(vertical.x[0]))
        sigma_z = math.inf
        if fit.ground_points >= MIN_GROUND_POINTS and math.isfinite(fit.correction[0]):
            sigma_z = math.sqrt(1.0 / (float(fit.information[0, 0]) + 1e-3) + Z_FLOOR_SIGMA_M**2)
            gate = max(MIN_GATE_M, GATE_SIGMAS * math.hypot(math.sqrt(float(vertical.p[0, 0])), sigma_z))
            by_range = self._over_ground(planar.x[kalman.POSE]) if self._rejected >= MAX_REJECTED else None
            refit = float(vertical.x[0] + fit.correction[0])
            if by_range is not None and abs(refit - by_range) > CONTRADICTED_M:
                vertical = kalman.update_vertical(vertical, by_range, OVER_GROUND_SIGMA_M**2)
                self._unmeasured = 0
            elif abs(fit.correction[0]) < gate or self._rejected >= MAX_REJECTED:
                if is_off and abs(fit.correction[0]) > MIN_GATE_M:
                    self.has_jumped = abs(float(fit.correction[0])) > JUMP_M
                    vertical = kalman.found_vertical(vertical, refit, sigma_z**2)
                else:
                    vertical = kalman.update_vertical(vertical, refit, sigma_z**2)
                self._unmeasured = 0
                self.map_variance = fit.map_variance
                self._rejected = 0
            else:
                self._rejected += 1
        roll, pitch = history.at(np.array([vertical.t_ns - self._middle_ns], np.int64))[0, :2]
        self._tilt.take(fit, float(roll), float(pitch), float(vertical.x[1]))
        ground = fit.new_ground
        result = HeightResult(fit.correction[:3], sigma_z, ground, fit.ground_points, fit.wall_points)
        return vertical, result

    def _over_ground(self, pose: Array) -> float | None:
        """Height by the newest reading above the ground that the map has there; None where either is missing or old."""
        known = self.ground.height_at(float(pose[0]), float(pose[1]))
        if known is None or not self._rangefinder or self._t_ns - self._rangefinder[-1].t_ns > FRESH_NS:
            return None
        return known[0] + self._rangefinder[-1].distance_m

    def _use_rangefinder(self, vertical: kalman.Vertical, pose: Array, history: AttitudeHistory) -> kalman.Vertical:
        """Above the start the reading, made plumb, is the height: the floor there is known from standing on it."""
        readings = [s for s in self._rangefinder if self._t_ns < s.t_ns <= vertical.t_ns]
        floor = self.floor_m
        if not readings or floor is None or math.hypot(pose[0], pose[1]) > RANGEFINDER_RADIUS_M:
            return vertical
        newest = readings[-1]
        roll, pitch = history.at(np.array([newest.t_ns], np.int64))[0, :2]
        age_s = (vertical.t_ns - newest.t_ns) * 1e-9
        z = newest.distance_m * math.cos(roll) * math.cos(pitch) + floor + age_s * float(vertical.x[1])
        sigma_z = math.sqrt(float(vertical.p[0, 0]))
        if abs(z - vertical.x[0]) > max(0.3, GATE_SIGMAS * math.hypot(sigma_z, RANGEFINDER_SIGMA_M)):
            return vertical
        variance = RANGEFINDER_SIGMA_M**2 + (0.01 * newest.distance_m) ** 2
        return kalman.update_vertical(vertical, float(z), variance)


def _ground_gate_m(vertical: kalman.Vertical) -> float:
    """How far a point may be off the known ground."""
    return 0.5 + 3.0 * math.sqrt(float(vertical.p[0, 0]))
