"""The odometry stage: scans, attitude and rangefinder in, the pose of the body in `map` out.

Two rates: each scan is registered to the wall map as it stood at the last keyframe; at a keyframe the scans since then
are put into the map, placed by their filtered poses. Seen once is seen for good: the map forgets nothing, so that the
walls of the first keyframe hold the pose for the whole flight.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from companion.config import CompanionConfig
from companion.messages import (
    Array,
    AttitudeSample,
    LevelledScan,
    LidarScan,
    OdometryEstimate,
    RangefinderSample,
    WallRanges,
)
from companion.odometry import filter as kalman
from companion.odometry import weak
from companion.odometry.attitude import AttitudeBuffer, AttitudeHistory
from companion.odometry.degeneracy import Judgement
from companion.odometry.estimate import Snapshot, estimate_at
from companion.odometry.height import HeightTracker
from companion.odometry.keyframes import PlacedScan, WaitingScans
from companion.odometry.level import LOW_M, AllReturns, Leveller, ReturnNoise, block_means, wall_layer
from companion.odometry.placing import FAILED_AFTER, Placing
from companion.odometry.ranges import SCANS, layer_ranges, wall_ranges
from companion.odometry.specks import specks, without_dust
from companion.odometry.standstill import Standstill
from companion.odometry.turned import NOT_KNOWN, TurnedBy
from companion.odometry.wall_map import Registration, WallMap

KEYFRAME_HEIGHT_M = 0.5  # a climb of this much makes a keyframe too
KEYFRAME_HEIGHT_LOW_M = 0.2  # below LOW_M, where nothing yet tells walls from the foot of a pile
MIN_VALID_COLUMNS_RATIO = 0.25
WAIT_FOR_FIRST_SCANS = 5
MIN_VALID_COLUMNS_FIRST_RATIO = 0.75  # the first scan makes the map: one that was joined in mid-turn would ruin it
DUST_SIGMA_M = 0.05  # of x and y, were all returns dust: what is left of it before the walls shrinks the map
DUST_RATE = 0.01


@dataclass(frozen=True, slots=True, kw_only=True)
class ScanResult:
    """What one scan gave. registration and judgement: None for the first scan, which makes the map.

    is_yaw_weak: the walls alone do not tell yaw (a round silo), the gyro carries it.
    """

    estimate: OdometryEstimate
    levelled: LevelledScan
    wall_ranges: WallRanges
    keyframe: bool
    registration: Registration | None
    judgement: Judgement | None
    is_standing: bool
    is_yaw_weak: bool
    tilt_offset_rad: tuple[float, float]
    lidar_turned_by: TurnedBy = NOT_KNOWN


class Odometry:
    """One instance for one flight. on_attitude, on_rangefinder and predict may be called while on_scan runs in another
    thread: what they share is immutable and replaced by single assignments."""

    def __init__(self, cfg: CompanionConfig) -> None:
        self._cfg = cfg
        self._leveller = Leveller(cfg.lidar)
        self._attitude = AttitudeBuffer()
        self._rangefinder: list[RangefinderSample] = []
        self._snapshot: Snapshot | None = None
        self._published: Snapshot | None = None
        self._placing = Placing()
        self.height = HeightTracker(cfg.lidar.mount_position_m[2], 1.0 / cfg.lidar.rate_hz)
        self._standstill = Standstill()
        self._is_released = False  # the filter, from standing at the origin
        self._standing_scans = 0
        self._waiting = WaitingScans()
        self._layers: deque[Array] = deque(maxlen=SCANS)  # of the last scans, newest first
        self._return_noise = ReturnNoise()  # of single returns: the registration's also holds what walls are rough by
        self._dust_ratio = 0.0  # of the returns, lately
        self._keyframe_t_ns = 0
        self._keyframe_z_m = 0.0
        self._base_variance = np.zeros(3)
        self.dropped: dict[str, int] = {"repeated": 0, "no attitude": 0, "too few columns": 0}

    @property
    def walls(self) -> WallMap:
        return self._placing.walls

    @property
    def rejected(self) -> dict[str, int]:
        """Scans whose registration was not believed, by why."""
        return self._placing.rejected

    # -- inputs

    def on_attitude(self, sample: AttitudeSample) -> None:
        self._attitude.add(sample)

    def on_rangefinder(self, sample: RangefinderSample) -> None:
        self._rangefinder.append(sample)
        del self._rangefinder[:-64]  # without scans nobody takes them

    def predict(self, t_ns: int) -> OdometryEstimate | None:
        """The estimate at t_ns (not before the newest scan), or None before the first scan. Cheap; any thread."""
        snapshot, history = self._published, self._attitude.history
        if snapshot is None or history is None:
            return None
        return estimate_at(snapshot, history, max(t_ns, snapshot.t_scan_ns), is_scan=False)

    def begin(self, scan: LidarScan) -> Callable[[], ScanResult | None]:
        """Freeze what is known now and give the heavy step to run: what arrives while it runs counts for the next one,
        so that replay can repeat it to the last bit."""
        samples, self._rangefinder = self._rangefinder, []
        return partial(self._process, scan, self._attitude.history, samples)

    def on_scan(self, scan: LidarScan) -> ScanResult | None:
        """All at once. None when the scan cannot be used at all (counted in `dropped`)."""
        result = self.begin(scan)()
        self.publish()
        return result

    def publish(self) -> None:
        """From now on `predict` starts from the scan last processed: called where its result is taken in, so that the
        moment does not depend on when a thread was done, and replay repeats it."""
        self._published = self._snapshot

    @property
    def t_attitude_ns(self) -> int:
        """Of the newest attitude that came; 0 before the first."""
        return self._attitude.newest_ns

    @property
    def snapshot(self) -> Snapshot | None:
        """The state after the scan last processed."""
        return self._snapshot

    def adopt(self, snapshot: Snapshot | None) -> None:
        """A scan was processed elsewhere, by an odometry that heard the same: its state is ours. Only `publish` and
        `predict` may follow; the map stays there."""
        self._snapshot = snapshot

    def _process(
        self, scan: LidarScan, history: AttitudeHistory | None, samples: list[RangefinderSample]
    ) -> ScanResult | None:
        for sample in samples:
            self.height.on_rangefinder(sample)
            if math.isfinite(sample.distance_m):
                self._standstill.on_rangefinder(sample.distance_m)
        if self._is_unusable(scan, history) or history is None:
            return None
        old = self._snapshot
        planar = kalman.start(scan.t_ns) if old is None else kalman.carry(old.planar, history, scan.t_ns)
        vertical = kalman.start_vertical(scan.t_ns) if old is None else kalman.carry_vertical(old.vertical, scan.t_ns)
        velocity = kalman.velocity_level(planar, vertical)
        levelled, every = self._leveller.level(scan, history, velocity, self.height.tilt_offset_rad)
        row = scan.geometry.horizontal_row
        lone = specks(scan)
        self._return_noise.see(
            scan.range_m[row] if lone is None else np.where(lone[row], np.float32(0.0), scan.range_m[row])
        )
        share = 0.0 if lone is None else float(np.mean(lone))
        self._dust_ratio += DUST_RATE * (share - self._dust_ratio)
        if lone is not None:
            levelled = without_dust(scan, levelled, lone, self._return_noise.sigma_m)
        z_m = float(vertical.x[0])
        layer = wall_layer(
            levelled,
            scan.geometry,
            self.height.floor_below_m(z_m),
            z_m,
            self._return_noise.sigma_m,
            is_climbing=self._is_released,
        )
        near_m = self._cfg.lidar.min_range_m + 4.0 * self._placing.sigma_range_m
        lower = block_means(levelled, row, scan.range_m.shape[1], near_m)
        registration, judgement = None, None
        if old is None:
            snapshot = self._first(scan, planar, vertical)
            ground = self.height.fit(lower, planar, vertical, self.walls, self._placing.sigma_range_m).new_ground
        else:
            planar, registration, judgement, reset = self._placing.place(
                planar, layer, float(vertical.x[0]), old.t_scan_ns,
                is_standing=self._standstill.is_standing, return_sigma_m=self._return_noise.sigma_m,
            )  # fmt: skip
            self.height.is_standing = self._standstill.is_standing
            vertical, fit = self.height.update(
                lower, planar, vertical, history, self.walls, self._placing.sigma_range_m
            )
            ground = fit.new_ground
            if judgement.is_degenerate and self._is_released:
                planar = self._hold_by_ground(planar, vertical, judgement.weak_axis, lower, fit.correction[1:])
            if not self._is_released:
                planar, vertical = self._stand(
                    history, planar, vertical, registration, judgement, fit.correction[0], fit.z_sigma_m
                )
            reset |= self._is_released and self.height.has_jumped
            snapshot = self._after(old, scan, planar, vertical, registration, judgement, reset)
        variance = np.array([planar.p[0, 0], planar.p[1, 1], planar.p[6, 6], vertical.p[0, 0]]) + snapshot.map_variance
        if judgement is None or (judgement.is_accepted and not self._placing.is_lost):
            sensor = levelled.origin_level_m
            pose, z_m = planar.x[kalman.POSE], float(vertical.x[0])
            self._waiting.add(PlacedScan(layer, ground, sensor, pose, z_m, variance))
        if snapshot.is_keyframe:
            self._close_keyframe(scan.t_ns, float(vertical.x[0]), is_first=old is None)
        self._snapshot = snapshot
        return ScanResult(
            estimate=estimate_at(snapshot, history, scan.t_ns, is_scan=True),
            levelled=levelled,
            wall_ranges=self._look_around(scan, every, is_dusty=lone is not None),
            keyframe=snapshot.is_keyframe,
            registration=registration,
            judgement=judgement,
            is_standing=self._standstill.is_standing,
            is_yaw_weak=judgement is not None and judgement.is_yaw_weak,
            tilt_offset_rad=self.height.tilt_offset_rad,
            lidar_turned_by=self.height.lidar_turned_by,
        )

    # -- steps

    def _look_around(self, scan: LidarScan, every: AllReturns, *, is_dusty: bool) -> WallRanges:
        r_body_lidar, least_m = self._leveller.r_body_lidar, self._cfg.lidar.min_range_m
        self._layers.appendleft(layer_ranges(scan))
        return wall_ranges(scan, every, r_body_lidar, least_m, self._layers, is_dusty=is_dusty)

    def _is_unusable(self, scan: LidarScan, history: AttitudeHistory | None) -> bool:
        reason = ""
        if history is None:
            reason = "no attitude"
        elif self._snapshot is not None and scan.t_ns <= self._snapshot.t_scan_ns:
            reason = "repeated"
        elif np.count_nonzero(scan.column_valid) / len(scan.column_valid) < self._least_valid_ratio():
            reason = "too few columns"
        if reason:
            self.dropped[reason] += 1
        return bool(reason)

    def _least_valid_ratio(self) -> float:
        """The first scan is waited for: a fuller one comes at the next turn, unless packets are lost all the time."""
        is_waiting = self._snapshot is None and self.dropped["too few columns"] < WAIT_FOR_FIRST_SCANS
        return MIN_VALID_COLUMNS_FIRST_RATIO if is_waiting else MIN_VALID_COLUMNS_RATIO

    def _first(self, scan: LidarScan, planar: kalman.Planar, vertical: kalman.Vertical) -> Snapshot:
        if (
            self._return_noise.sigma_m > 2.0 * self._placing.sigma_range_m
        ):  # else the second scan would not fit the first
            self._placing.sigma_range_m = self._return_noise.sigma_m
        return Snapshot(
            t_scan_ns=scan.t_ns,
            planar=planar,
            vertical=vertical,
            map_variance=np.zeros(4),
            tilt_offset_rad=(0.0, 0.0),
            drift_variance=0.0,
            quality=50,
            reset_counter=0,
            converged=True,
            is_degenerate=False,
            inliers=0,
            iterations=0,
            keyframe_id=0,
            is_keyframe=True,
        )

    def _hold_by_ground(
        self, planar: kalman.Planar, vertical: kalman.Vertical, axis: Array, lower: Array, tilt: Array
    ) -> kalman.Planar:
        """Where walls do not hold the place along an axis, a pile in sight does. It stays degenerate all the same: nothing
        holds the tilt along that axis, and heights drift."""
        noise = self._placing.sigma_range_m
        moved_m, information = self.height.shift_along(lower, planar, vertical, self.walls, noise, axis, tilt)
        planar = weak.held_by_ground(planar, axis, moved_m, information)
        self._placing.is_lost = weak.sigma_along(planar, axis) > weak.LOST_M
        return planar

    def _stand(
        self,
        history: AttitudeHistory,
        planar: kalman.Planar,
        vertical: kalman.Vertical,
        registration: Registration | None,
        judgement: Judgement | None,
        z_shift: float,
        z_sigma: float,
    ) -> tuple[kalman.Planar, kalman.Vertical]:
        """While nothing moves, the pose is the origin by definition; once it moves, the filter is let go."""
        if registration is None or judgement is None:
            return planar, vertical
        if judgement.weak_ratio < weak.SURE_OF_STANDING_RATIO and not self._standstill.is_on_ground:
            self._standstill.is_standing, self._is_released = False, True
            return weak.in_flight(planar, judgement.weak_axis), kalman.let_go_vertical(vertical, z_shift)
        noise = np.diag(np.linalg.inv(registration.information + np.diag([10.0, 10.0, 100.0])))
        shift = np.append(registration.pose, z_shift)
        if self._standstill.on_scan(history, shift, np.sqrt(np.append(noise, z_sigma**2))):
            self._standing_scans += 1
            return kalman.start(planar.t_ns), kalman.start_vertical(vertical.t_ns)
        self._is_released = True
        self.height.leave_ground()
        self._base_variance = noise / max(1, self._standing_scans)
        self._waiting.drop_moved()
        still = self._standstill
        planar = kalman.let_go(planar, still.gyro_offset_radps, still.stood_s, still.turned_rad)
        return planar, kalman.let_go_vertical(vertical, z_shift)

    def _after(
        self,
        old: Snapshot,
        scan: LidarScan,
        planar: kalman.Planar,
        vertical: kalman.Vertical,
        registration: Registration,
        judgement: Judgement,
        reset: bool,
    ) -> Snapshot:
        accepted = judgement.is_accepted
        period_ns = self._cfg.odometry.keyframe_period_s * 1e9
        scan_ns = 0.5e9 / self._cfg.lidar.rate_hz
        due = scan.t_ns - self._keyframe_t_ns >= period_ns - scan_ns
        z_m = float(vertical.x[0])
        step_m = KEYFRAME_HEIGHT_M if z_m > LOW_M else KEYFRAME_HEIGHT_LOW_M
        climbed = abs(z_m - self._keyframe_z_m) > step_m
        is_keyframe = accepted and not self._placing.is_lost and (due or climbed)
        planar_map = old.map_variance[:3]
        if accepted:
            dust = (DUST_SIGMA_M * self._dust_ratio) ** 2
            planar_map = registration.map_variance + self._base_variance + np.array([dust, dust, 0.0])
            if judgement.is_yaw_weak:
                planar_map += np.append(registration.per_yaw_m**2, 0.0) * planar.p[kalman.YAW, kalman.YAW]
        quality = max(1, min(100, round(100 * registration.matched_ratio))) if accepted else old.quality
        if judgement.is_degenerate:
            quality = weak.quality_at(weak.sigma_along(planar, judgement.weak_axis), quality)
        if self._placing.rejected_in_row >= FAILED_AFTER:
            quality = -1
        return Snapshot(
            t_scan_ns=scan.t_ns,
            planar=planar,
            vertical=vertical,
            map_variance=np.append(planar_map, self.height.map_variance),
            tilt_offset_rad=self.height.tilt_offset_rad,
            drift_variance=self.height.drift_variance(),
            quality=quality,
            reset_counter=(old.reset_counter + 1) % 256 if reset else old.reset_counter,
            converged=registration.converged and accepted,
            is_degenerate=judgement.is_degenerate,
            inliers=registration.inliers,
            iterations=registration.iterations,
            keyframe_id=old.keyframe_id + int(is_keyframe),
            is_keyframe=is_keyframe,
        )

    def _close_keyframe(self, t_ns: int, z_m: float, *, is_first: bool) -> None:
        is_standing = self._standstill.is_standing and not is_first
        self._waiting.put_into(self.walls, self.height.ground, self._return_noise.sigma_m, is_standing=is_standing)
        self._keyframe_t_ns, self._keyframe_z_m = t_ns, z_m
