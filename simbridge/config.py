"""What a mission file may say of the emulated side: world, vehicle, LiDAR, flight controller, faults.

Lengths in metres, angles in degrees (only here). A mission's `lidar` section is read twice: the companion takes the
data-sheet values, this side those and the rest (noise, drop-outs, mount error).
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import Discriminator, Field, Tag, ValidationError, model_validator

from simbridge import footprint as fp
from simbridge.piles import Pile
from simbridge.section import Finite, NonNegative, Point, Positive, Ratio, Section, Vector, refuse

SEEDS_APART = 1000  # of the bumps of one mission's seed and the next
MIN_THRUST_TO_WEIGHT = 1.3  # less does not climb and steer at once


class Circle(Section):
    center: Point
    radius_m: Positive


class RoundFootprint(Section):
    """A silo: a regular polygon of many sides."""

    circle: Circle
    sides: int = Field(64, ge=8, le=256)


def _kind_of_footprint(value: Any) -> str | None:
    if isinstance(value, dict | RoundFootprint):
        return "round"
    return "polygon" if isinstance(value, list | tuple) else None


Footprint = Annotated[
    Annotated[RoundFootprint, Tag("round")] | Annotated[tuple[Point, ...], Field(min_length=3), Tag("polygon")],
    Discriminator(
        _kind_of_footprint,
        custom_error_type="footprint",
        custom_error_message="must be corners [[x, y], ...] in order along the wall, or {circle: {center: [x, y], radius_m: r}}",
    ),
]


class Pilasters(Section):
    """Half columns along a wall, each standing out by depth_m."""

    wall: int | Literal["all"] = Field(
        "all", description="edge of the footprint, 0 is from the first to the second point"
    )
    spacing_m: Positive = Field(5.0, ge=0.5)
    width_m: Positive = Field(0.5, le=5)
    depth_m: Positive = Field(0.3, le=3)


class Column(Section):
    center: Point
    radius_m: Positive | None = Field(None, description="round; or give size_m")
    size_m: Point | None = Field(None, description="rectangular: along x and y")
    yaw_deg: Finite = 0.0
    height_m: Positive | None = Field(None, description="none: up to the ceiling")

    @model_validator(mode="after")
    def _has_one_shape(self) -> Self:
        if (self.radius_m is None) == (self.size_m is None):
            raise ValueError("give either radius_m (round) or size_m (rectangular)")
        if self.size_m is not None and min(self.size_m) <= 0:
            raise ValueError(f"size_m: both must be > 0, got {self.size_m}")
        return self


class Box(Section):
    """A machine, a bin: stands on the floor."""

    center: Point
    size_m: tuple[Positive, Positive, Positive] = Field(description="along x, y, z before turning")
    yaw_deg: Finite = 0.0


class Roughness(Section):
    """Bumps of the walls."""

    rms_m: NonNegative = Field(0.0, le=0.5)
    bump_size_m: Positive = Field(2.0, ge=1.0, description="wavelength of the smallest bumps")
    seed: int = Field(0, ge=0)


Breeze = Annotated[float, Field(ge=-15, le=15, allow_inf_nan=False)]


class Wind(Section):
    """Draught through the store: a mean and gusts (first-order Gauss-Markov in each axis)."""

    mean_mps: tuple[Breeze, Breeze, Breeze] = Field((0.0, 0.0, 0.0), description="world axes")
    gust_mps: NonNegative = Field(
        0.0, le=10, description="standard deviation of each horizontal axis; half of it upwards"
    )
    gust_time_s: Positive = Field(2.0, description="correlation time")


class WorldConfig(Section):
    footprint: Footprint = Field(description="corners x, y in order, or {circle: {center, radius_m}}")
    height_m: Positive = Field(ge=2, le=100, description="of the ceiling above z = 0")
    floor_slope: Point = Field(
        (0.0, 0.0), description="rise per metre along x and y; z = 0 at the footprint's centroid"
    )
    pilasters: tuple[Pilasters, ...] = ()
    columns: tuple[Column, ...] = ()
    boxes: tuple[Box, ...] = ()
    wall_roughness: Roughness = Roughness()
    piles: tuple[Pile, ...] = ()
    pile_cell_m: Positive = Field(0.2, ge=0.05, le=1.0, description="edge of the piles' triangles")
    bumps_by_seed: bool = Field(
        False, description="the mission's seed draws the bumps of piles and walls too: another store for each seed"
    )
    wind: Wind = Wind()

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        fp.check_world(self)
        return self

    def of_seed(self, seed: int) -> WorldConfig:
        """The store that a mission of this seed flies in: itself, unless its bumps are drawn by the seed."""
        if not self.bumps_by_seed:
            return self
        drawn, rough = (seed + 1) * SEEDS_APART, self.wall_roughness
        return self.model_copy(
            update={
                "piles": tuple(pile.model_copy(update={"seed": pile.seed + drawn}) for pile in self.piles),
                "wall_roughness": rough.model_copy(update={"seed": rough.seed + drawn}),
                "bumps_by_seed": False,
            }
        )


class StartCircle(Section):
    """A start drawn by the mission's seed; the heading too, unless given."""

    circle: Circle
    yaw_deg: Finite | None = None


def _kind_of_start(value: Any) -> str | None:
    if isinstance(value, dict | StartCircle):
        return "seeded"
    if isinstance(value, list | tuple):
        return {2: "place", 3: "pose"}.get(len(value))
    return None


Start = Annotated[
    Annotated[StartCircle, Tag("seeded")] | Annotated[Point, Tag("place")] | Annotated[Vector, Tag("pose")],
    Discriminator(
        _kind_of_start,
        custom_error_type="start",
        custom_error_message="must be [x, y], [x, y, yaw_deg] or {circle: {center: [x, y], radius_m: r}, yaw_deg: optional}",
    ),
]


class ImuConfig(Section):
    part: Literal["icm-42688-p", "bmi088", "ideal"] = Field("icm-42688-p", description="whose data-sheet noise is used")
    accel_bias_mps2: NonNegative = Field(0.02, le=2, description="1 sigma of what calibration left, each axis, by seed")
    gyro_bias_dps: NonNegative = Field(0.05, le=5, description="the same for the gyro")
    misalignment_rpy_deg: Vector = Field(
        (0.0, 0.0, 0.0), description="of the sensor in the airframe: becomes an error of the attitude"
    )
    vibration_mps2: NonNegative = Field(
        0.0, le=50, description="RMS of the accelerometer's shaking at the rotors' speed, at full thrust"
    )
    vibration_dps: NonNegative = Field(0.0, le=200, description="the same on the gyro")


class BarometerConfig(Section):
    noise_hpa: NonNegative = Field(0.01, le=1)
    drift_hpa: NonNegative = Field(0.05, le=5, description="1 sigma of the slow wander; 0.1 hPa is 0.9 m")
    drift_time_s: Positive = Field(600.0, description="correlation time of the wander")
    rate_hz: Literal[10, 25, 50] = 50
    site_altitude_m: Finite = Field(488.0, ge=-400, le=5000)
    temperature_c: Finite = 20.0


class RangefinderConfig(Section):
    enabled: bool = True
    noise_m: NonNegative = Field(0.03, le=1)
    min_range_m: NonNegative = 0.05
    max_range_m: Positive = 40.0
    rate_hz: Literal[10, 25, 50] = 50


class VehicleConfig(Section):
    """The 3 kg quadrotor that real PX4 and ArduCopter fly with stock gains."""

    start: Start = Field(description="[x, y], [x, y, yaw_deg] or {circle: {center: [x, y], radius_m: r}, yaw_deg: 90}")
    mass_kg: Positive = Field(3.0, ge=1, le=20)
    inertia_kgm2: tuple[Positive, Positive, Positive] = (0.06, 0.06, 0.10)
    arm_m: Positive = Field(0.20, le=1, description="rotors stand at x, y = +-arm_m")
    max_thrust_n: Positive = Field(20.6, description="of one rotor")
    thrust_curve: Ratio = Field(0.65, description="T = Tmax ((1 - c) u + c u^2)")
    rotor_lag_s: Positive = Field(0.03, ge=0.005, le=0.3)
    reaction_torque_m: NonNegative = Field(0.05, description="torque per thrust")
    drag_nspm: NonNegative = Field(0.3, description="linear drag, N s/m")
    substeps: Literal[1, 2, 4] = Field(1, description="physics steps in each 4 ms")
    imu: ImuConfig = ImuConfig()
    barometer: BarometerConfig = BarometerConfig()
    rangefinder: RangefinderConfig = RangefinderConfig()

    @model_validator(mode="after")
    def _can_fly(self) -> Self:
        lightest = MIN_THRUST_TO_WEIGHT * 9.81 * self.mass_kg / 4.0
        if self.max_thrust_n < lightest:
            reason = f"must be at least {lightest:.1f} for a vehicle of {self.mass_kg:g} kg"
            refuse(("max_thrust_n",), self.max_thrust_n, f"{reason}: {MIN_THRUST_TO_WEIGHT:g} times its weight")
        return self


class Dust(Section):
    """Beer-Lambert: a beam of r metres comes through with probability exp(-r / visibility_m)."""

    visibility_m: Positive | None = Field(None, description="mean free path; none: clean air")
    lost_ratio: Ratio = Field(0.3, description="share of the caught beams that return nothing; the others return early")


class LidarSimConfig(Section):
    """An Ouster OS0 "below horizon"; the first ten keys are the companion's too."""

    rows: Literal[5, 16, 32, 64] = Field(5, description="layers, spread evenly over the elevations")
    columns: Literal[512, 1024, 2048] = Field(512, description="measurements in a turn")
    rate_hz: Literal[10, 20] = Field(10, description="turns a second")
    elevation_max_deg: Finite = Field(0.0, ge=-90, le=90)
    elevation_min_deg: Finite = Field(-45.0, ge=-90, le=90)
    min_range_m: Positive = 0.5
    max_range_m: Positive = Field(50.0, le=500)
    mount_position_m: Vector = Field((0.0, 0.0, 0.08), description="of the sensor in body (forward, left, up)")
    mount_rpy_deg: Vector = Field((0.0, 0.0, 0.0), description="of the sensor in body: roll, pitch, yaw")
    noise_m: NonNegative = Field(0.12, le=5, description="1 sigma of the range")
    offset_sigma_m: NonNegative = Field(
        0.002, le=1, description="1 sigma of what a unit adds to all its ranges; how much this one does, the seed says"
    )
    rows_off: tuple[int, ...] = Field((), description="beams switched off, 0 is the highest: they return nothing")
    mount_error_rpy_deg: Vector = Field((0.0, 0.0, 0.0), description="true mount minus mount_rpy_deg")
    mount_error_position_m: Vector = Field((0.0, 0.0, 0.0), description="true mount minus mount_position_m")
    grazing_deg: Finite = Field(75.0, ge=0, lt=90, description="from this angle of incidence on returns get lost")
    dropout_ratio: Ratio = Field(0.0, description="returns lost whatever the angle")
    dust: Dust = Dust()
    packet_loss_ratio: Ratio = 0.0
    clock_offset_s: NonNegative = Field(1000.0, description="the sensor's clock minus simulated time")

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if self.elevation_min_deg >= self.elevation_max_deg:
            reason = f"must be below elevation_max_deg, {self.elevation_max_deg:g}"
            refuse(("elevation_min_deg",), self.elevation_min_deg, reason)
        if self.min_range_m >= self.max_range_m:
            refuse(("min_range_m",), self.min_range_m, f"must be below max_range_m, {self.max_range_m:g}")
        if not all(0 <= row < self.rows for row in self.rows_off):
            refuse(("rows_off",), self.rows_off, f"there are {self.rows} rows; allowed are 0 to {self.rows - 1}")
        return self


class AutopilotConfig(Section):
    kind: Literal["emulated", "px4", "ardupilot"] = Field(
        "emulated", description="which flight controller flies, unless --autopilot says another"
    )
    params: dict[str, float] = Field(default_factory=dict, description="PX4 parameters by name")


class FaultConfig(Section):
    """Something that goes wrong for a while, in PX4's words."""

    target: Literal["lidar", "imu", "baro", "rangefinder", "vision", "setpoint", "to_autopilot", "from_autopilot"] = (
        Field(description="vision, setpoint: those messages of the companion; to_/from_autopilot: all of MAVLink")
    )
    kind: Literal["off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent"]
    at_s: NonNegative = Field(description="start, in seconds from `since`")
    duration_s: Positive | None = Field(None, description="none: for good")
    since: Literal["boot", "liftoff"] = "boot"
    wrong_by: Finite = Field(
        1.0,
        description="wrong: m (LiDAR, rangefinder, x of vision), m/s (x of setpoints), m/s2 (x of the IMU), hPa",
    )
    delay_s: Positive = Field(0.5, le=30, description="delayed: how late")
    slow_ratio: Annotated[float, Field(gt=0, lt=1)] = Field(0.5, description="slow: share that still comes, evenly")
    loss_ratio: Ratio = Field(0.5, description="intermittent: share of the half seconds without anything")


class SimConfig(Section):
    """All that simbridge needs of a mission."""

    world: WorldConfig
    vehicle: VehicleConfig
    lidar: LidarSimConfig = LidarSimConfig()
    autopilot: AutopilotConfig = AutopilotConfig()
    faults: tuple[FaultConfig, ...] = ()
    seed: int = Field(0, ge=0)

    @model_validator(mode="after")
    def _fits_the_store(self) -> Self:
        if self.world.bumps_by_seed:
            try:
                fp.check_world(self.store)
            except ValidationError as error:
                first = error.errors()[0]
                refuse(("world", *first["loc"]), first["input"], f"{first['msg']} (bumps drawn by seed {self.seed})")
        fp.check_start(self.store, self.vehicle.start)
        return self

    @property
    def store(self) -> WorldConfig:
        """The world, with the bumps that this seed draws where it is asked to."""
        return self.world.of_seed(self.seed)
