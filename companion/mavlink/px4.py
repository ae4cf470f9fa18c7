"""The PX4 dialect: LOCAL_NED vision of type VIO, OFFBOARD, origin before the first vision sample (PX4.md)."""

from __future__ import annotations

from companion.mavlink import dialect, wire
from companion.mavlink.dialect import Dialect, ModeReport
from companion.messages import FlightMode, LandedState

# custom_mode = main << 16 | sub << 24 (PX4, commander/px4_custom_mode.h)
_MAIN_AUTO = 4
_MAIN_OFFBOARD = 6
_SUB_TAKEOFF, _SUB_LOITER, _SUB_MISSION, _SUB_RTL, _SUB_LAND, _SUB_PRECLAND = 2, 3, 4, 5, 6, 9
_SUB_DESCEND = 20  # PX4 main from August 2026 on; 1.18 says AUTO_LAND
_STANDARD_LAND = 7  # MAV_STANDARD_MODE_LAND
_AUTO_MODES = {
    _SUB_TAKEOFF: FlightMode.TAKEOFF,
    _SUB_LOITER: FlightMode.HOLD,
    _SUB_MISSION: FlightMode.MISSION,
    _SUB_RTL: FlightMode.RETURN,
    _SUB_LAND: FlightMode.LAND,
    _SUB_PRECLAND: FlightMode.LAND,
    _SUB_DESCEND: FlightMode.DESCEND,
}


def decode_mode(report: ModeReport) -> FlightMode:
    """The mode. DESCEND hides behind AUTO_LAND's number: CURRENT_MODE.standard_mode (0, not 7) tells it, and where
    that is not known, a landed state that still says in the air (PX4.md, 7)."""
    main, sub = report.custom_mode >> 16 & 0xFF, report.custom_mode >> 24 & 0xFF
    if main == _MAIN_OFFBOARD:
        return FlightMode.OFFBOARD
    if main != _MAIN_AUTO:
        return FlightMode.MANUAL if main else FlightMode.UNKNOWN
    mode = _AUTO_MODES.get(sub, FlightMode.UNKNOWN)
    if sub == _SUB_LAND and report.standard_mode is not None:
        return FlightMode.LAND if report.standard_mode == _STANDARD_LAND else FlightMode.DESCEND
    if sub == _SUB_LAND and report.landed_state is LandedState.IN_AIR:
        return FlightMode.DESCEND
    return mode


def is_position_valid(flags: int) -> bool:
    """Horizontal position usable. 229 (none fused) and 101 (lost) are not, 511, 383 and 127 (dead reckoning) are: as
    recorded in vision_loss."""
    needed = dialect.FLAG_VELOCITY_HORIZONTAL | dialect.FLAG_POSITION_RELATIVE
    return flags & needed == needed


def is_vision_fused(flags: int) -> bool:
    """PRED_POS_HORIZ_REL falls in the very report after fusion stops (383 -> 127 in vision_loss)."""
    return is_position_valid(flags) and bool(flags & dialect.FLAG_PREDICTED_RELATIVE)


PX4 = Dialect(
    name="px4",
    odometry_frame=dialect.FRAME_LOCAL_NED,  # with LOCAL_FRD no global position is ever published: no Hold (PX4.md, 5)
    estimator_type=dialect.ESTIMATOR_VIO,
    min_odometry_spacing_ns=20_000_000,
    mode_params={
        FlightMode.OFFBOARD: (1.0, float(_MAIN_OFFBOARD), 0.0),
        FlightMode.LAND: (1.0, float(_MAIN_AUTO), float(_SUB_LAND)),
        FlightMode.HOLD: (1.0, float(_MAIN_AUTO), float(_SUB_LOITER)),
    },
    streams_hz=(
        (wire.ATTITUDE_QUATERNION, 50.0),
        (wire.LOCAL_POSITION_NED, 10.0),
        (wire.EXTENDED_SYS_STATE, 5.0),
        (wire.ESTIMATOR_STATUS, 2.0),
        (wire.DISTANCE_SENSOR, 10.0),
        (wire.CURRENT_MODE, 2.0),
        (wire.SYS_STATUS, 1.0),
        (wire.BATTERY_STATUS, 1.0),
        # For the .tlog's reader: QGroundControl draws place, speed and height from these alone. One ALTITUDE makes it
        # deaf to any other height, so that it must not end.
        (wire.GLOBAL_POSITION_INT, 2.0),
        (wire.VFR_HUD, 2.0),
        (wire.ALTITUDE, 2.0),
        # not used: ATTITUDE, SERVO_OUTPUT_RAW, ATTITUDE_TARGET, POSITION_TARGET_LOCAL_NED, HIGHRES_IMU, VIBRATION,
        # ESC_INFO, ESC_STATUS, ODOMETRY
        *((unused, 0.0) for unused in (30, 36, 83, 85, 105, 241, 290, 291, wire.ODOMETRY)),
    ),
    max_round_trip_ns=10_000_000,  # lib/timesync: MAX_RTT_SAMPLE
    timesync_answers=500,  # lib/timesync: CONVERGENCE_WINDOW
    has_bytewise_parameters=True,
    needs_takeoff=False,
    estimator_message=wire.ESTIMATOR_STATUS,
    decode_mode=decode_mode,
    is_vision_fused=is_vision_fused,
    is_position_valid=is_position_valid,
)
