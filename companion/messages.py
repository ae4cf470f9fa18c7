"""Every message that crosses between stages: what happened, or what is wanted.

Times are integer nanoseconds of the companion's monotonic clock. Frames are right-handed: `map` (z up, origin where
odometry began), `body` (forward, left, up), `lidar` (as the device says). See docs/frames.md.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import Enum, IntEnum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def require_array(name: str, value: NDArray[np.generic], shape: tuple[int | None, ...]) -> None:
    """Raise ValueError unless `value` is an array of that shape (None: any length)."""
    got = getattr(value, "shape", None)
    if got == shape:
        return
    if got is None or len(got) != len(shape) or any(w is not None and w != g for w, g in zip(shape, got, strict=True)):
        want = "(" + ", ".join("N" if s is None else str(s) for s in shape) + ")"
        raise ValueError(f"{name}: expected an array of shape {want}, got {got if got is not None else type(value)}")


class Severity(IntEnum):
    """MAV_SEVERITY (MAVLink common), for events and STATUSTEXT."""

    EMERGENCY = 0
    ALERT = 1
    CRITICAL = 2
    ERROR = 3
    WARNING = 4
    NOTICE = 5
    INFO = 6
    DEBUG = 7


class FlightMode(Enum):
    """The flight controller's mode in words that hold for PX4 and ArduPilot alike."""

    UNKNOWN = "unknown"
    MANUAL = "manual"  # any mode that a pilot flies: the companion must not stream
    OFFBOARD = "offboard"  # PX4 OFFBOARD, ArduPilot GUIDED
    HOLD = "hold"
    TAKEOFF = "takeoff"
    LAND = "land"
    DESCEND = "descend"  # PX4: landing blind
    RETURN = "return"
    MISSION = "mission"


class LandedState(IntEnum):
    """MAV_LANDED_STATE."""

    UNDEFINED = 0
    ON_GROUND = 1
    IN_AIR = 2
    TAKEOFF = 3
    LANDING = 4


@dataclass(frozen=True, slots=True, kw_only=True)
class LidarGeometry:
    """Where each beam points: point_lidar = direction * range + offset. One instance per sensor, shared by its scans.

    directions: (rows, columns, 3) float64, unit. offsets_m: (rows, columns, 3) float64.
    elevation_rad: (rows,), top row first. horizontal_row: the row whose elevation is nearest to 0.
    """

    directions: Array
    offsets_m: Array
    elevation_rad: Array
    horizontal_row: int

    def __post_init__(self) -> None:
        require_array("directions", self.directions, (None, None, 3))
        require_array("offsets_m", self.offsets_m, self.directions.shape)
        require_array("elevation_rad", self.elevation_rad, (self.directions.shape[0],))


@dataclass(frozen=True, slots=True, kw_only=True)
class LidarScan:
    """One full turn of the LiDAR.

    t_ns: companion time of the last column. t_column_ns: (columns,) int64, companion time of each column.
    range_m: (rows, columns) float32, 0 where nothing came back. signal: (rows, columns) float32, sensor's own unit.
    column_valid: (columns,) bool, False for columns whose packet was lost.
    """

    t_ns: int
    frame_id: int
    t_column_ns: NDArray[np.int64]
    range_m: NDArray[np.float32]
    signal: NDArray[np.float32]
    column_valid: NDArray[np.bool_]
    geometry: LidarGeometry

    def __post_init__(self) -> None:
        rows, columns = self.geometry.directions.shape[:2]
        require_array("range_m", self.range_m, (rows, columns))
        require_array("signal", self.signal, (rows, columns))
        require_array("t_column_ns", self.t_column_ns, (columns,))
        require_array("column_valid", self.column_valid, (columns,))


@dataclass(frozen=True, slots=True, kw_only=True)
class AttitudeSample:
    """The flight controller's attitude and turn rate, already in the companion's frames.

    q_ref_body_wxyz: (4,) unit, body (FLU) to a z-up reference whose heading is the flight controller's own.
    rate_body_radps: (3,) FLU.
    """

    t_ns: int
    q_ref_body_wxyz: Array
    rate_body_radps: Array


@dataclass(frozen=True, slots=True, kw_only=True)
class RangefinderSample:
    """Distance straight down the body's -z axis, metres."""

    t_ns: int
    distance_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleState:
    """What the flight controller last said of itself. position and velocity are its own fused ones, in `map`: for
    cross-checks and display, never a prior for registration (that would be a loop that hides drift)."""

    t_ns: int
    t_heartbeat_ns: int
    is_connected: bool
    is_armed: bool
    mode: FlightMode
    is_failsafe: bool
    landed_state: LandedState
    position_map_m: Array | None
    velocity_map_mps: Array | None
    battery_ratio: float | None
    is_position_valid: bool
    is_ready_to_arm: bool
    not_ready_because: tuple[str, ...] = ()
    is_vision_fused: bool = True  # as far as it says; PX4 shows a loss within 0.6 s, ArduPilot after 7 s


@dataclass(frozen=True, slots=True, kw_only=True)
class OdometryEstimate:
    """Pose of the body in `map`, with its quality.

    pose_covariance: (6, 6), order x, y, z, roll, pitch, yaw in map (m, rad). velocity_covariance: (3, 3) body.
    quality: -1 failed, 0 unknown, 1 to 100 (ODOMETRY.quality). t_scan_ns: time of the newest scan within it.
    """

    t_ns: int
    t_scan_ns: int
    position_map_m: Array
    q_map_body_wxyz: Array
    velocity_body_mps: Array
    rate_body_radps: Array
    pose_covariance: Array
    velocity_covariance: Array
    quality: int
    reset_counter: int
    converged: bool
    is_degenerate: bool
    inliers: int
    iterations: int
    keyframe_id: int
    is_keyframe: bool

    def __post_init__(self) -> None:
        require_array("position_map_m", self.position_map_m, (3,))
        require_array("q_map_body_wxyz", self.q_map_body_wxyz, (4,))
        require_array("velocity_body_mps", self.velocity_body_mps, (3,))
        require_array("pose_covariance", self.pose_covariance, (6, 6))
        require_array("velocity_covariance", self.velocity_covariance, (3, 3))


@dataclass(frozen=True, slots=True, kw_only=True)
class LevelledScan:
    """A scan after deskew and levelling, in a z-up frame at the body at t_ns with the body's own heading.

    points_level: (N, 3) float64, finite. range_m: (N,) from the sensor. row: (N,) int, column: (N,) int.
    """

    t_ns: int
    points_level: Array
    range_m: Array
    row: NDArray[np.int64]
    column: NDArray[np.int64]
    origin_level_m: Array = field(default_factory=lambda: np.zeros(3))  # the sensor's place in the same frame


@dataclass(frozen=True, slots=True, kw_only=True)
class WallRanges:
    """What the navigator steers by, from the horizontal layer. None where nothing was seen. Distances from the body's
    centre. front/right: eq. 4 and 5 of the paper (robust over a few neighbouring beams).

    ranges_m: (360,) horizontal distance by bearing in whole degrees, counter-clockwise from forward; inf where unseen
    or beyond range; nearest return of each sector, without near specks that stand alone (odometry/ranges.py). is_seen:
    (360,) bool, True where the sector's columns arrived, even if nothing came back (inf and seen: free as far as the
    sensor reaches; inf and not seen: lost packets, or only specks: nobody knows).
    """

    t_ns: int
    front_m: float | None
    right_m: float | None
    ranges_m: Array
    is_seen: NDArray[np.bool_]

    def __post_init__(self) -> None:
        require_array("ranges_m", self.ranges_m, (360,))
        require_array("is_seen", self.is_seen, (360,))


class SetpointKind(Enum):
    VELOCITY = "velocity"
    SILENT = "silent"  # the guard's last resort: nothing is sent, the flight controller's own failsafe acts


@dataclass(frozen=True, slots=True, kw_only=True)
class Setpoint:
    """What the flight controller shall do: velocity in `map` and yaw rate (about map z, counter-clockwise positive)."""

    t_ns: int
    kind: SetpointKind
    velocity_map_mps: Array
    yaw_rate_radps: float
    reason: str = ""


class RequestKind(Enum):
    """What the companion may ask of the flight controller."""

    ARM = "arm"
    DISARM = "disarm"
    OFFBOARD = "offboard"
    LAND = "land"
    HOLD = "hold"


@dataclass(frozen=True, slots=True, kw_only=True)
class VehicleRequest:
    t_ns: int
    kind: RequestKind


class OperatorCommandKind(Enum):
    ABORT = "abort"  # latched: zero velocity, then land
    HOLD = "hold"
    RESUME = "resume"
    LAND = "land"


@dataclass(frozen=True, slots=True, kw_only=True)
class OperatorCommand:
    t_ns: int
    kind: OperatorCommandKind
    source: str  # "sigterm", "mqtt", "ground station", "cli"


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """Something an operator or a later reader must know. name: snake_case, stable; text: for people."""

    t_ns: int
    severity: Severity
    name: str
    text: str


@dataclass(frozen=True, slots=True, kw_only=True)
class PointMap:
    """The map: points in `map` with the place they were seen from.

    points_map: (N, 3) float64. keyframe_id: (N,) int64. range_m: (N,) float64, distance at which it was measured.
    path_map: (K, 3) float64, the flown path (places known to be free air).
    position_sigma_m, height_sigma_m: typical 1-sigma of the poses that placed the points.
    scan_index: (N,) int64, the row of path_map that each point was seen from; None: not known.
    """

    points_map: Array
    keyframe_id: NDArray[np.int64]
    range_m: Array
    path_map: Array
    position_sigma_m: float = 0.0
    height_sigma_m: float = 0.0
    scan_index: NDArray[np.int64] | None = None

    def only(self, keep: NDArray[np.bool_]) -> PointMap:
        """The same map with some of its points: keep is (N,)."""
        return replace(
            self,
            points_map=self.points_map[keep],
            keyframe_id=self.keyframe_id[keep],
            range_m=self.range_m[keep],
            scan_index=None if self.scan_index is None else self.scan_index[keep],
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class VolumeReport:
    """Volume of material above the floor, with what is known of it.

    interval_m3: (low, high) at interval_level. The ratios are shares of the floor area inside the walls; they sum to 1.
    surface_z_m, floor_z_m: (ny, nx) grids in map, NaN outside the walls; x_m, y_m: cell centres.
    cell_state: (ny, nx) int8: 0 outside, 1 seen, 2 interpolated, 3 unseen.
    warnings: reasons why the number may be worse than its interval says, for people; empty when all is well.
    """

    volume_m3: float
    interval_m3: tuple[float, float]
    interval_level: float
    seen_ratio: float
    interpolated_ratio: float
    unseen_ratio: float
    floor_area_m2: float
    pile_area_m2: float
    x_m: Array
    y_m: Array
    surface_z_m: Array
    floor_z_m: Array
    cell_state: NDArray[np.int8]
    warnings: tuple[str, ...] = ()
    footprint_m: Array = field(default_factory=lambda: np.zeros((0, 2)))  # (V, 2) walls as fitted, or the map's extent
    error_budget_m3: tuple[tuple[str, float], ...] = ()  # 1 sigma of each part of the interval
