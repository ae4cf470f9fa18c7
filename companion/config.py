"""What the companion may be told: the sections of a mission file that fly. Units are in the names; degrees only here."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class Section(BaseModel):
    """A part of a mission file: unknown keys are refused, values cannot be changed after loading."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class LidarConfig(Section):
    """The rotating LiDAR as its data sheet and its mount describe it."""

    rows: Literal[5, 16, 32, 64] = Field(
        5, description="layers, spread evenly from elevation_max_deg down to elevation_min_deg"
    )
    columns: Literal[512, 1024, 2048] = Field(512, description="measurements in a turn")
    rate_hz: Literal[10, 20] = Field(10, description="turns a second")
    elevation_max_deg: float = Field(0.0, ge=-90, le=90)
    elevation_min_deg: float = Field(-45.0, ge=-90, le=90)
    min_range_m: Positive = Field(0.5, description="nearer returns are not used for odometry or the map")
    max_range_m: Positive = Field(50.0, description="range at which the paper's weight reaches 0")
    mount_position_m: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.08), description="of the sensor in body (forward, left, up)"
    )
    mount_rpy_deg: tuple[float, float, float] = Field(
        (0.0, 0.0, 0.0), description="of the sensor in body: roll, pitch, yaw"
    )


class OdometryConfig(Section):
    keyframe_period_s: Positive = Field(4.8, le=60, description="the paper's scan period: 1.6, 3.2, 4.8 or 6.4 s")
    paper_threshold: Positive = Field(2.0, description="algorithm 1: stop when E is at or below it")
    paper_max_iterations: int = Field(50, ge=1, le=1000, description="algorithm 1")


class NavigatorConfig(Section):
    forward_speed_mps: Positive = Field(0.43, le=2.0)
    wall_distance_m: Positive = Field(6.0, ge=2.0, le=30.0, description="the paper's D")
    height_m: Positive = Field(9.0, le=100.0, description="above the place of take-off")
    climb_speed_mps: Positive = Field(0.8, le=2.0)
    turn_rate_dps: Positive = Field(20.0, le=60.0)
    kp_per_m: Positive = Field(0.25, description="heading PD controller on d_r - D: proportional, rad/s per metre")
    kd_per_m: NonNegative = Field(0.9, description="the same: derivative, rad per metre")
    laps: int = Field(1, ge=1, le=10)
    max_flight_time_s: Positive = Field(1800.0)
    max_distance_from_start_m: Positive = Field(500.0)


class GuardConfig(Section):
    """Limits that every setpoint passes. None of them can be switched off."""

    max_speed_mps: Positive = Field(1.0, le=3.0)
    max_climb_speed_mps: Positive = Field(1.0, le=2.0)
    max_yaw_rate_dps: Positive = Field(45.0, le=120.0)
    max_height_m: Positive = Field(14.0, description="above the place of take-off")
    max_distance_m: Positive = Field(500.0, description="horizontal fence: distance from the place of take-off")
    stop_distance_m: Positive = Field(2.0, description="nothing may come nearer than this in the way of motion")
    deceleration_mps2: Positive = Field(0.8, description="what the vehicle is trusted to brake with")
    max_scan_age_s: Positive = Field(0.3, le=2.0)
    silent_after_s: Positive = Field(0.4, le=2.0)
    land_after_s: Positive = Field(2.0, le=10.0)
    max_state_age_s: Positive = Field(1.0, le=3.0)
    max_position_sigma_m: Positive = Field(1.0)


class MappingConfig(Section):
    scan_period_s: Positive = Field(0.5, le=60, description="how often a scan goes into the map between keyframes")
    max_range_m: Positive = Field(40.0)


class VolumeConfig(Section):
    cell_m: Positive = Field(0.25, ge=0.05, le=5.0)
    interval_level: float = Field(0.95, gt=0.5, lt=1.0)
    range_offset_sigma_m: NonNegative = Field(
        0.002, le=1.0, description="1 sigma of what the sensor adds to all its ranges, as left by its calibration"
    )


class MavlinkConfig(Section):
    system_id: int = Field(1, ge=1, le=255, description="of the vehicle: the companion takes the same")
    odometry_rate_hz: float = Field(31.25, ge=10, le=50)
    setpoint_rate_hz: float = Field(20.0, ge=4, le=50)
    origin_latitude_deg: float = Field(
        47.4, ge=-90, le=90, description="an EKF origin is needed where there is no GPS; any place will do"
    )
    origin_longitude_deg: float = Field(8.5, ge=-180, le=180)
    signing_key_file: str | None = Field(None, description="32 bytes, hex; None: unsigned")


class RecordingConfig(Section):
    enabled: bool = True
    reserve_gib: NonNegative = Field(2.0, description="free space kept on the disk")


class TelemetryConfig(Section):
    mqtt_url: str | None = Field(None, description="mqtt://host:port/prefix; None: off")
    rate_hz: Positive = Field(2.0, le=20)


class CompanionConfig(Section):
    """All sections that fly."""

    lidar: LidarConfig = LidarConfig()
    odometry: OdometryConfig = OdometryConfig()
    navigator: NavigatorConfig = NavigatorConfig()
    guard: GuardConfig = GuardConfig()
    mapping: MappingConfig = MappingConfig()
    volume: VolumeConfig = VolumeConfig()
    mavlink: MavlinkConfig = MavlinkConfig()
    recording: RecordingConfig = RecordingConfig()
    telemetry: TelemetryConfig = TelemetryConfig()
