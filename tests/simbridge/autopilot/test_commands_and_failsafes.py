"""Arming, modes, setpoints and their loss: PX4.md sections 3, 4 and 6."""

from __future__ import annotations

import math
import struct

import numpy as np
import pytest
from pymavlink.dialects.v20 import development as dialect

from tests.simbridge.autopilot.rig import Rig


def ready(params: dict[str, float] | None = None, seed: int = 5) -> Rig:
    rig = Rig(params, seed)
    rig.fly(5.5)
    return rig


def hovering(params: dict[str, float] | None = None, *, origin: bool = True, frame: int = 1) -> Rig:
    rig = Rig(params, seed=5)
    if not origin:
        rig.origin = None
    rig.vision_edit = lambda f: f.update(frame_id=frame)
    rig.takeoff(2.0)
    return rig


def test_offboard_is_accepted_disarmed_without_stream_and_arming_then_refused() -> None:
    rig = ready()
    assert rig.mode(6) == 0
    assert rig.arm() == 1
    rig.velocity(0.0, 0.0, 0.0)
    rig.fly(0.2)
    assert rig.arm() == 0


def test_offboard_is_refused_armed_without_stream() -> None:
    rig = ready()
    assert rig.arm() == 0
    assert rig.mode(6) == 1
    rig.velocity(0.0, 0.0, 0.0)
    rig.fly(0.2)
    assert rig.mode(6) == 0


def test_arming_without_position_is_refused_for_every_setpoint_that_needs_it() -> None:
    rig = Rig()
    rig.vision = False
    rig.velocity(0.0, 0.0, 0.0)
    rig.fly(3.0)
    assert rig.mode(6) == 0
    assert rig.arm() == 1


def test_hold_needs_a_global_position() -> None:
    rig = Rig()
    rig.origin = None
    rig.fly(6.0)
    assert rig.arm() == 1
    assert rig.autopilot.commander.system_status == 0


LOSSES = [
    ({"COM_OBL_RC_ACT": 4}, True, 1, "LAND"),
    ({"COM_OBL_RC_ACT": 5}, True, 1, "LOITER"),
    ({"COM_OBL_RC_ACT": 5}, False, 1, "LAND"),
    ({"COM_OBL_RC_ACT": 5}, True, 20, "LAND"),  # FRD: no global position
    ({"COM_OBL_RC_ACT": 0, "NAV_RCL_ACT": 2}, False, 1, "LAND"),
    ({"COM_OBL_RC_ACT": 0, "NAV_RCL_ACT": 2}, True, 1, "RTL"),
    ({"COM_OBL_RC_ACT": 0, "NAV_RCL_ACT": 3}, True, 1, "LAND"),
]


@pytest.mark.parametrize(("params", "origin", "frame", "expected"), LOSSES)
def test_lost_setpoints_end_in_the_first_mode_of_the_ladder_that_can_run(
    params: dict[str, float], origin: bool, frame: int, expected: str
) -> None:
    rig = hovering(params, origin=origin, frame=frame)
    rig.stream(None)
    commander = rig.autopilot.commander
    lost = rig.until(lambda: commander.mode.name != "OFFBOARD", 2.0)
    assert commander.mode.name == expected
    assert 0.9 < lost < 1.2  # COM_OF_LOSS_T, seen at 10 Hz; the last setpoint was up to 50 ms before
    assert commander.system_status == 5


def test_setpoints_that_return_give_offboard_back() -> None:
    rig = hovering()
    rig.stream(None)
    rig.until(lambda: rig.autopilot.commander.mode.name == "LAND", 2.0)
    rig.velocity(0.0, 0.0, 0.0)
    rig.until(lambda: rig.autopilot.commander.mode.name == "OFFBOARD", 0.3)


def test_hold_after_loss_keeps_the_place() -> None:
    rig = hovering({"COM_OBL_RC_ACT": 5})
    rig.velocity(0.5, 0.0, 0.0)
    rig.fly(2.0)
    rig.stream(None)
    rig.fly(4.0)
    at = rig.position_ned().copy()
    rig.fly(4.0)
    assert float(np.abs(rig.position_ned() - at).max()) < 0.1


def test_a_body_velocity_goes_where_the_nose_points() -> None:
    rig = hovering()
    rig.goto(0.0, 0.0, -2.0, yaw=math.pi / 2)
    rig.fly(6.0)
    assert abs(rig.yaw() - math.pi / 2) < 0.05
    at = rig.position_ned().copy()
    rig.body_velocity(0.5, 0.0, 0.0, 0.0)
    rig.fly(4.0)
    moved = rig.position_ned() - at
    assert moved[1] > 1.2
    assert abs(moved[0]) < 0.2


def test_a_position_setpoint_is_reached_and_held() -> None:
    rig = hovering()
    rig.goto(2.0, -1.0, -3.0)
    rig.fly(10.0)
    rows = np.array([row for t, row in rig.log if t > rig.t_s - 3.0])
    assert np.allclose(rows[:, :3].mean(axis=0), (2.0, -1.0, -3.0), atol=0.1)
    assert float(np.hypot(*rows[:, :2].std(axis=0))) < 0.03  # recorded 0.9 cm


def test_disarming_in_the_air_needs_force() -> None:
    rig = hovering()
    assert rig.command(400, 0.0) == 1
    assert rig.command(400, 0.0, 21196.0) == 0
    assert not rig.autopilot.commander.is_armed


def test_armed_without_take_off_disarms_by_itself_after_ten_seconds() -> None:
    rig = ready()
    rig.velocity(0.0, 0.0, 0.0)
    rig.fly(0.5)
    rig.mode(6)
    assert rig.arm() == 0
    assert 9.8 < rig.until(lambda: not rig.autopilot.commander.is_armed, 12.0) < 10.3


def test_take_off_by_command_then_hold_then_return_and_land() -> None:
    rig = ready({"RTL_RETURN_ALT": 5.0, "RTL_CONE_ANG": 0, "MIS_TAKEOFF_ALT": 2.0})
    commander = rig.autopilot.commander
    assert rig.arm() == 0
    assert rig.command(22, *[math.nan] * 7) == 0
    rig.until(lambda: commander.mode.name == "LOITER", 15.0)
    assert rig.position_ned()[2] == pytest.approx(-2.0, abs=0.4)
    rig.fly(2.0)
    assert rig.command(20) == 0
    rig.until(lambda: rig.position_ned()[2] < -4.6, 15.0)
    rig.until(lambda: not commander.is_armed, 25.0)
    assert float(np.hypot(*rig.position_ned()[:2])) < 0.3


def test_the_battery_drains_while_armed_and_its_action_lands() -> None:
    rig = hovering({"SIM_BAT_DRAIN": 40.0, "SIM_BAT_MIN_PCT": 0.0, "COM_LOW_BAT_ACT": 2, "COM_FAIL_ACT_T": 1.0})
    percents = [m.battery_remaining for _, m in rig.messages("BATTERY_STATUS")]
    assert percents[0] == 100
    assert percents == sorted(percents, reverse=True)
    rig.until(lambda: rig.autopilot.commander.mode.name == "LAND", 40.0)
    assert rig.autopilot.battery.remaining < 0.07


def test_texts_need_a_ground_station_and_long_ones_come_in_chunks() -> None:
    rig = ready()
    rig.mode(6)
    rig.arm()
    rig.fly(0.5)
    assert rig.messages("STATUSTEXT") == []
    rig.send(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    rig.fly(0.5)
    texts = [(m.text, m.chunk_seq) for _, m in rig.messages("STATUSTEXT")]
    assert ("Arming denied: Resolve system health failures firs", 0) in texts
    assert ("t\t", 1) in texts


def test_a_reboot_starts_time_anew_keeps_parameters_and_never_arms() -> None:
    rig = ready()
    rig.send(dialect.MAVLink_param_set_message(1, 1, b"MPC_XY_CRUISE", 3.0, 9))
    assert rig.command(246, 1.0) == 0
    rig.fly(2.0)
    silent = [t for t, _ in rig.frames if t > rig.t_s - 1.5]
    assert silent == []
    rig.fly(3.0)
    times = [m.time_boot_ms for _, m in rig.messages("LOCAL_POSITION_NED")]
    assert times[-1] < 3000 < max(times)
    assert rig.autopilot.params.real("MPC_XY_CRUISE") == 3.0
    assert not rig.autopilot.commander.is_armed


def test_message_intervals_are_kept_and_told() -> None:
    rig = ready()
    rig.command(511, 32, 200000.0)
    rig.command(511, 30, -1.0)
    begin = rig.t_s
    rig.fly(4.0)
    counts = {n: sum(t > begin for t, _ in rig.messages(n)) for n in ("LOCAL_POSITION_NED", "ATTITUDE")}
    assert counts["LOCAL_POSITION_NED"] == pytest.approx(20, abs=1)
    assert counts["ATTITUDE"] == 0


def test_setpoints_for_another_system_are_ignored() -> None:
    rig = ready()
    message = dialect.MAVLink_set_position_target_local_ned_message(1, 42, 1, 1, 0x9C7, *[0.0] * 11)
    rig.send(message)
    assert not rig.autopilot.commander.signal.ever


def test_a_lost_ground_station_acts_only_where_it_is_asked_to() -> None:
    for action, expected in ((0, "OFFBOARD"), (3, "LAND")):
        rig = hovering({"COM_DL_LOSS_T": 2, "COM_FAIL_ACT_T": 0.5})
        rig.send(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
        rig.send(
            dialect.MAVLink_param_set_message(
                1, 1, b"NAV_DLL_ACT", struct.unpack("<f", struct.pack("<i", action))[0], 6
            )
        )
        rig.fly(3.5)
        assert rig.autopilot.commander.mode.name == expected


def test_a_companion_alone_hears_of_its_failsafe_by_event() -> None:
    rig = hovering()
    rig.stream(None)
    rig.fly(1.5)
    events = [struct.unpack_from("<I", f[10:])[0] for _, f in rig.frames if f[7:10] == (410).to_bytes(3, "little")]
    assert 28241790 in events  # "No offboard signal"
    assert events[-1] == 31382480  # "Failsafe activated", both recorded
