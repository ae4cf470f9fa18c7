"""The ArduCopter dialect: LOCAL_FRD vision, GUIDED, EKF origin until it comes back (ARDUPILOT.md)."""

from __future__ import annotations

from companion.mavlink import dialect, wire
from companion.mavlink.dialect import Dialect, ModeReport
from companion.messages import FlightMode

# ArduCopter's Mode::Number
_AUTO, _GUIDED, _LOITER, _RTL, _CIRCLE, _LAND, _BRAKE, _SMART_RTL, _AUTO_RTL = 3, 4, 5, 6, 7, 9, 17, 21, 27
_MODES = {
    _AUTO: FlightMode.MISSION,
    _GUIDED: FlightMode.OFFBOARD,
    _RTL: FlightMode.RETURN,
    _SMART_RTL: FlightMode.RETURN,
    _AUTO_RTL: FlightMode.RETURN,
    _LAND: FlightMode.LAND,
    _BRAKE: FlightMode.HOLD,
}


def decode_mode(report: ModeReport) -> FlightMode:
    """The mode; every mode that a pilot flies, LOITER among them, is MANUAL."""
    return _MODES.get(report.custom_mode, FlightMode.MANUAL)


def is_position_valid(flags: int) -> bool:
    """0x33f is; 0x0a7 (no vision yet) and 0x025 (lost) are not: as recorded. The variances of EKF_STATUS_REPORT stay
    at 0.00 through a loss of vision, so that only the flags tell."""
    needed = dialect.FLAG_VELOCITY_HORIZONTAL | dialect.FLAG_POSITION_RELATIVE
    return flags & needed == needed and not flags & dialect.FLAG_CONSTANT_POSITION


def is_vision_fused(flags: int) -> bool:
    return is_position_valid(flags) and bool(flags & dialect.FLAG_PREDICTED_RELATIVE)


ARDUPILOT = Dialect(
    name="ardupilot",
    odometry_frame=dialect.FRAME_LOCAL_FRD,  # with BODY_FRD the only pair that is not dropped in silence
    estimator_type=dialect.ESTIMATOR_VIO,
    min_odometry_spacing_ns=20_000_000,  # messages closer than 20 ms are dropped
    mode_params={
        FlightMode.OFFBOARD: (1.0, float(_GUIDED), 0.0),
        FlightMode.LAND: (1.0, float(_LAND), 0.0),
        FlightMode.HOLD: (1.0, float(_BRAKE), 0.0),  # LOITER would want a throttle stick in the middle
    },
    streams_hz=(
        (wire.ATTITUDE_QUATERNION, 50.0),
        (wire.LOCAL_POSITION_NED, 10.0),
        (wire.EXTENDED_SYS_STATE, 5.0),
        (wire.EKF_STATUS_REPORT, 2.0),
        (wire.DISTANCE_SENSOR, 10.0),
        (wire.SYS_STATUS, 1.0),
        (wire.BATTERY_STATUS, 1.0),
        (wire.GPS_GLOBAL_ORIGIN, 0.2),
        (wire.GLOBAL_POSITION_INT, 2.0),  # for the .tlog's reader, as with PX4; it has no ALTITUDE
        (wire.VFR_HUD, 2.0),
    ),
    max_round_trip_ns=50_000_000,  # it answers between its tasks: 3 to 21 ms in the recordings; the quickest counts
    timesync_answers=0,  # corrects for jitter itself
    has_bytewise_parameters=False,
    needs_takeoff=True,
    estimator_message=wire.EKF_STATUS_REPORT,
    decode_mode=decode_mode,
    is_vision_fused=is_vision_fused,
    is_position_valid=is_position_valid,
)
