"""Compiles every numba kernel of the flight before anything flies: the first time on a computer takes half a minute,
later the compiled code is read from disk. A made-up room is scanned; nothing of it is kept."""

from __future__ import annotations

import math

import numpy as np

from companion.config import CompanionConfig
from companion.flight import Flight
from companion.messages import (
    Array,
    AttitudeSample,
    FlightMode,
    LandedState,
    LidarGeometry,
    LidarScan,
    RangefinderSample,
    VehicleState,
    WallRanges,
)
from companion.navigator import NavigatorInput
from companion.navigator.guard import GuardInput
from companion.navigator.obstacles import Surroundings, allowed_speed
from companion.navigator.scan_view import ScanView
from companion.odometry.relocalise import relocalise

ROOM_M = np.array([8.0, 6.0, 2.0])  # half lengths of the room; its floor is that far below the sensor
SCANS = 60
SCAN_NS = 100_000_000


def warm_up(config: CompanionConfig) -> None:
    """Run all stages once on made-up input of this sensor's shape. Seconds; half a minute the first time."""
    flight = Flight(config=config)
    geometry = flight.decoder.geometry
    rng = np.random.default_rng(0)
    state = _state(0)
    for n in range(SCANS):
        t_ns = (n + 1) * SCAN_NS
        moved_m = max(0.0, 0.04 * (n - 15))
        for k in range(5):
            flight.odometry.on_attitude(_level(t_ns - (4 - k) * SCAN_NS // 5))
        flight.odometry.on_rangefinder(RangefinderSample(t_ns=t_ns, distance_m=0.1 + moved_m))
        result = flight.odometry.on_scan(_scan(geometry, n, t_ns, moved_m, rng))
        if result is None:
            continue
        flight.odometry.predict(t_ns + SCAN_NS // 3)
        flight.mapper.add(result.levelled, result.estimate)
        estimate, walls = result.estimate, result.wall_ranges
        output = flight.navigator.step(t_ns, NavigatorInput(estimate=estimate, walls=walls, vehicle=state))
        flight.session.send_wall_ranges(walls)
        flight.guard.check(output.setpoint, t_ns, GuardInput(estimate=estimate, walls=walls, vehicle=state))
        if n == SCANS - 1:
            layer = result.levelled.points_level[result.levelled.row == geometry.horizontal_row][:, :2]
            relocalise(flight.odometry.walls, np.ascontiguousarray(layer), np.zeros(3), 0.01 * np.eye(3), 0.0, 0.1)
            _look_about(walls)


def _look_about(walls: WallRanges) -> None:
    """What the navigator and the guard ask of a scan only once they fly."""
    view = ScanView.of(walls)
    view.wall(-math.pi, math.pi)
    view.ahead(0.0, 1.0, 1.0)
    surroundings = Surroundings(stop_distance_m=2.0, deceleration_mps2=1.0)
    surroundings.see(walls, 0.0, 0.0, 0.0)
    surroundings.limit(np.array([5.0, 0.0]), 0.0, 0.0, walls.t_ns)
    allowed_speed(1.0, 1.0)


def _scan(geometry: LidarGeometry, n: int, t_ns: int, moved_m: float, rng: np.random.Generator) -> LidarScan:
    """What the sensor would see in a box-shaped room, `moved_m` along x and up from where it stood."""
    rows, columns = geometry.directions.shape[:2]
    here = np.array([moved_m, 0.0, min(moved_m, 1.0)])
    with np.errstate(divide="ignore"):
        to_plane: Array = np.where(
            geometry.directions > 0, (ROOM_M - here) / geometry.directions, (-ROOM_M - here) / geometry.directions
        )
    distance = np.min(np.where(np.isfinite(to_plane), to_plane, np.inf), axis=2) + rng.normal(0, 0.05, (rows, columns))
    return LidarScan(
        t_ns=t_ns,
        frame_id=n,
        t_column_ns=t_ns - (columns - 1 - np.arange(columns, dtype=np.int64)) * (SCAN_NS // columns),
        range_m=distance.astype(np.float32),
        signal=np.full((rows, columns), 100.0, dtype=np.float32),
        column_valid=np.ones(columns, dtype=np.bool_),
        geometry=geometry,
    )


def _level(t_ns: int) -> AttitudeSample:
    return AttitudeSample(t_ns=t_ns, q_ref_body_wxyz=np.array([1.0, 0, 0, 0]), rate_body_radps=np.zeros(3))


def _state(t_ns: int) -> VehicleState:
    return VehicleState(
        t_ns=t_ns, t_heartbeat_ns=t_ns, is_connected=True, is_armed=False, mode=FlightMode.HOLD, is_failsafe=False,
        landed_state=LandedState.ON_GROUND, position_map_m=None, velocity_map_mps=None, battery_ratio=None,
        is_position_valid=False, is_ready_to_arm=False,
    )  # fmt: skip
