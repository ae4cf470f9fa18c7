"""Texts of the PX4 events (MAVLink EVENT, 410) that matter to a companion, by id.

An id is 1 << 24 (component autopilot) plus the low 24 bits of FNV-1a of the event's name, as PX4's libevents make it.
The names were found to match the ids in the recorded conversations.
"""

from __future__ import annotations


def event_id(name: str) -> int:
    """The id of a PX4 event by its name."""
    value = 0x811C9DC5
    for byte in name.encode():
        value = (value ^ byte) * 0x01000193 & 0xFFFFFFFF
    return 1 << 24 | value & 0xFFFFFF


_TEXTS = {
    "check_estimator_hor_pos_not_stable": "Not ready: horizontal position not stable",
    "check_modes_attitude": "Not ready: no attitude estimate",
    "check_modes_global_pos": "Not ready: no global position (needs the origin and fused vision)",
    "check_modes_home_position": "Not ready: no home position",
    "check_modes_local_pos": "Not ready: no local position (vision not fused)",
    "check_modes_manual_control": "Not ready: no manual control input",
    "check_modes_mission": "No mission loaded",
    "check_modes_offboard_no_local_velocity": "Not ready: no local velocity (vision not fused)",
    "check_modes_offboard_signal_lost": "Not ready: no offboard setpoint stream",
    "check_rc_dl_no_dllink": "No ground station connected",
    "commander_arm_denied_resolve_failures": "Arming denied: its own checks fail",
    "commander_armed_by": "Armed",
    "commander_disarm_denied_not_landed": "Disarming denied: not landed",
    "commander_disarmed_by": "Disarmed",
    "commander_failsafe_enter": "Failsafe activated",
    "commander_failsafe_enter_autopilot_disengaged": "Failsafe activated: autopilot disengaged, descending blind",
    "commander_failsafe_enter_crit_bat_warn": "Battery critical: land now",
    "commander_failsafe_enter_crit_low_bat_warn": "Battery at emergency level: land at once",
    "commander_failsafe_enter_generic": "Failsafe activated",
    "commander_failsafe_enter_generic_hold": "Failsafe activated: holding first",
    "commander_failsafe_enter_generic_warn": "Failsafe warning",
    "commander_failsafe_enter_hold": "Failsafe activated: holding first",
    "commander_failsafe_enter_low_bat": "Battery low: return advised",
    "commander_failsafe_enter_warn": "Failsafe warning",
    "commander_landing_detected": "Landing detected",
    "commander_takeoff_detected": "Takeoff detected",
    "commander_mission_comp_lost": "Connection to the companion lost",
    "commander_unsupported_main_mode": "Mode asked for is not supported",
    "logger_open_file_time": "Its own log file opened",
    "mavlink_rcv_odom_unsup_estimator_type": "ODOMETRY refused: its estimator type is not supported",
}
EVENT_TEXTS = {event_id(name): text for name, text in _TEXTS.items()}
# That one took over: known before the heartbeat, which comes once a second, says CRITICAL.
FAILSAFE_EVENTS = frozenset(event_id(name) for name, text in _TEXTS.items() if text.startswith("Failsafe activated"))
