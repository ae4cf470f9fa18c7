"""What differs between the autopilots, as data and two small functions each; told apart by HEARTBEAT.autopilot before
anything is commanded: PX4's mode numbers are accepted by ArduPilot and mean something else (ARDUPILOT.md)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from companion.messages import FlightMode, LandedState

FRAME_LOCAL_NED = 1
FRAME_BODY_FRD = 12
FRAME_LOCAL_FRD = 20
ESTIMATOR_VIO = 3

# ESTIMATOR_STATUS_FLAGS of common.xml; EKF_STATUS_FLAGS of ardupilotmega.xml has the same bits.
FLAG_VELOCITY_HORIZONTAL = 2
FLAG_POSITION_RELATIVE = 8
FLAG_POSITION_ABSOLUTE = 16
FLAG_CONSTANT_POSITION = 128
FLAG_PREDICTED_RELATIVE = 256
FLAG_PREDICTED_ABSOLUTE = 512


@dataclass(frozen=True, slots=True, kw_only=True)
class ModeReport:
    """All that tells the mode. standard_mode: MAV_STANDARD_MODE of CURRENT_MODE for this custom mode, else None."""

    custom_mode: int
    landed_state: LandedState
    standard_mode: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Dialect:
    """One kind of autopilot.

    odometry_frame: MAV_FRAME of the pose. min_odometry_spacing_ns: nearer samples would be dropped by the autopilot.
    mode_params: param1 to 3 of DO_SET_MODE by mode. streams_hz: message id -> rate asked for; 0 switches it off.
    timesync_answers: how many of its TIMESYNC questions must be answered before it believes our time stamps.
    decode_mode: the mode in our words. is_vision_fused, is_position_valid: from the estimator's flags.
    has_bytewise_parameters: integers lie in the bytes of PARAM_VALUE's float.
    max_round_trip_ns: slower TIMESYNC exchanges are not used.
    needs_takeoff: leaves the ground only by NAV_TAKEOFF, not by a velocity setpoint.
    """

    name: str
    odometry_frame: int
    estimator_type: int
    min_odometry_spacing_ns: int
    mode_params: Mapping[FlightMode, tuple[float, float, float]]
    streams_hz: tuple[tuple[int, float], ...]
    timesync_answers: int
    max_round_trip_ns: int
    has_bytewise_parameters: bool
    needs_takeoff: bool
    estimator_message: int
    decode_mode: Callable[[ModeReport], FlightMode]
    is_vision_fused: Callable[[int], bool]
    is_position_valid: Callable[[int], bool]
