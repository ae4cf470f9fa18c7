"""`stockpilot doctor` through MAVSDK against the emulated flight controller, each gate of fusion broken in turn."""

from __future__ import annotations

import asyncio
import json
import shutil
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import typer
from pymavlink.dialects.v20 import ardupilotmega as m
from typer.testing import CliRunner

from companion.mavlink.checks import Verdict, all_checks, is_green
from companion.mavlink.manifest import PX4_MANIFEST
from simbridge.link_frames import message_id
from stockpilot.doctor import doctor
from stockpilot.doctor_facts import Surroundings, _lasting, gather
from stockpilot.doctor_params import apply_manifest
from stockpilot.doctor_probe import Probe
from stockpilot.vehicle_link import open_vehicle
from tests.stockpilot.emulated import Standing, free_port

# (what is broken in what we send, in the parameters, the gate that must be named)
BROKEN: list[tuple[Probe, dict[str, float], str]] = [
    (Probe(rate_hz=3), {}, "rate"),
    (Probe(frame_id=14), {}, "frame"),
    (Probe(estimator_type=7), {}, "estimator_type"),
    (Probe(quaternion_scale=1.001), {}, "quaternion"),
    (Probe(quality=10), {"EKF2_EV_QMIN": 50}, "quality"),
    (Probe(position_sigma_m=50.0), {}, "covariance"),
    (Probe(jump_m=8.0), {}, "innovation"),
    (Probe(child_frame_id=14), {}, "frame"),
    (Probe(estimator_type=6), {}, "estimator_type"),
    (Probe(is_clock_still=True), {}, "time"),
    (Probe(), {"EKF2_EV_CTRL": 0}, "switch"),
    (Probe(), {"EKF2_SENS_EN": 8183}, "switch"),
]

Facing = Callable[[bytes], bytes | None]


def losing(*names: str) -> Facing:
    """The link loses messages of these names."""
    numbers = {message_number(name) for name in names}
    return lambda frame: None if message_id(frame) in numbers else frame


def message_number(name: str) -> int:
    return int(getattr(m, f"MAVLINK_MSG_ID_{name}"))


def saying(name: str, **fields: int) -> Facing:
    """The autopilot says something else in these fields."""
    number, packer = message_number(name), m.MAVLink(None, srcSystem=1, srcComponent=1)

    def alter(frame: bytes) -> bytes:
        if message_id(frame) != number:
            return frame
        message = m.MAVLink(None).decode(bytearray(frame))
        for key, value in fields.items():
            setattr(message, key, value)
        packer.seq = frame[4]
        return bytes(message.pack(packer))

    return alter


# (what the autopilot says or what is lost on the way, the line that must be red, and no other)
WRONG: list[tuple[Facing, str]] = [
    (losing("TIMESYNC"), "time.sync"),
    (losing("ATTITUDE_QUATERNION"), "stream.ATTITUDE_QUATERNION"),
    (losing("LOCAL_POSITION_NED"), "stream.LOCAL_POSITION_NED"),
    (saying("SYS_STATUS", onboard_control_sensors_health=0x320883F & ~1), "sensor.gyroscope"),
    (saying("SYS_STATUS", onboard_control_sensors_health=0x320883F & ~2), "sensor.accelerometer"),
    (saying("SYS_STATUS", onboard_control_sensors_health=0x320883F & ~8), "sensor.barometer"),
    (saying("SYS_STATUS", battery_remaining=10), "sensor.battery"),
    (saying("GPS_GLOBAL_ORIGIN", altitude=489_399), "origin"),
]


def command(*arguments: str) -> tuple[int, dict[str, Any]]:
    """The command as it is typed, with its exit code and its JSON."""
    app = typer.Typer()
    app.command()(doctor)
    result = CliRunner().invoke(app, [*arguments, "--json"])
    return result.exit_code, json.loads(result.stdout)


async def test_each_gate_broken_in_turn_is_named_alone() -> None:
    """Issue 4: `doctor` run against the emulation with each of its gates broken in turn names that gate."""
    from mavsdk.asyncio.plugins.param import ParamAsync

    named: list[list[str]] = []
    with Standing() as vehicle:
        async with open_vehicle(vehicle.ground_url) as link:
            param = ParamAsync(link.system)
            whole = await gather(link, Surroundings(), probe=Probe(), seconds=0.8)
            assert is_green(all_checks(whole)), [c for c in all_checks(whole) if c.verdict is Verdict.FAIL]
            for probe, parameters, _ in BROKEN:
                before = {name: await param.get_param_int(name) for name in parameters}
                for name, value in parameters.items():
                    await param.set_param_int(name, int(value))
                link.texts.clear()
                facts = await gather(link, Surroundings(), probe=probe, seconds=0.8)
                shut = [c.name for c in all_checks(facts) if c.name.startswith("fusion.")]
                named.append([name.removeprefix("fusion.") for name in shut])
                assert not is_green(all_checks(facts))
                for name, value in before.items():
                    await param.set_param_int(name, value)
    assert named == [[gate] for _, _, gate in BROKEN]


async def test_what_the_autopilot_says_or_the_link_loses_turns_its_own_line_red_alone() -> None:
    """Issue 4: time sync, stream rates, sensors, origin, each broken in turn against the emulation."""
    red: list[list[str]] = []
    with Standing() as vehicle:
        async with open_vehicle(vehicle.ground_url) as link:
            await gather(link, Surroundings(), probe=Probe(), seconds=0.8)  # the origin is set by this
            for alter, _ in WRONG:
                vehicle.alter = alter
                await asyncio.sleep(0.3)
                link.newest.clear()
                await link.wait_for("HEARTBEAT", 3.0)
                facts = await gather(link, Surroundings(), probe=Probe(), seconds=1.2)
                red.append([c.name for c in all_checks(facts) if c.verdict is Verdict.FAIL])
    assert red == [[line] for _, line in WRONG]


async def test_without_a_status_of_the_estimator_fusion_is_red() -> None:
    with Standing() as vehicle:
        vehicle.alter = losing("ESTIMATOR_STATUS")
        async with open_vehicle(vehicle.ground_url) as link:
            facts = await gather(link, Surroundings(), probe=None, seconds=1.2)
    red = [c.name for c in all_checks(facts) if c.verdict is Verdict.FAIL]
    assert red == ["stream.ESTIMATOR_STATUS", "fusion"]


async def test_each_parameter_that_matters_is_named_when_it_is_wrong() -> None:
    """Issue 4: every parameter that matters compared with the manifest: expected, actual, why, how to mend."""
    wrong = {
        "EKF2_EV_CTRL": 0, "EKF2_SENS_EN": 8183, "EKF2_HGT_REF": 1, "EKF2_GPS_CTRL": 7, "SYS_HAS_GPS": 1,
        "EKF2_MAG_TYPE": 0, "COM_ARM_WO_GPS": 0, "COM_OBL_RC_ACT": 3, "COM_OF_LOSS_T": 30.0, "NAV_RCL_ACT": 2,
        "NAV_DLL_ACT": 2, "COM_LOW_BAT_ACT": 0, "RTL_RETURN_ALT": 60.0, "GF_MAX_HOR_DIST": 0.0, "GF_MAX_VER_DIST": 0.0,
        "EKF2_EV_NOISE_MD": 1, "EKF2_EV_QMIN": 90, "EKF2_EV_DELAY": 200.0, "EKF2_NOAID_TOUT": 10_000_000,
        "MAV_FWDEXTSP": 0,
    }  # fmt: skip
    assert set(wrong) == {expected.name for expected in PX4_MANIFEST.parameters}
    with Standing(**wrong) as vehicle:
        async with open_vehicle(vehicle.ground_url) as link:
            facts = await gather(link, Surroundings(), probe=None, seconds=0.8)
            changes = await apply_manifest(link)
            mended = await gather(link, Surroundings(), probe=None, seconds=0.8)
    lines = {c.name.removeprefix("parameter."): c for c in all_checks(facts) if c.name.startswith("parameter.")}
    assert set(lines) == set(wrong)
    must = {expected.name for expected in PX4_MANIFEST.parameters if expected.must}
    assert {name for name, line in lines.items() if line.verdict is Verdict.FAIL} == must
    assert all(line.verdict is not Verdict.OK and line.expected and line.why and line.mend for line in lines.values())
    assert {change.name for change in changes if change.ok} == set(wrong)
    assert not [c for c in all_checks(mended) if c.name.startswith("parameter.") and c.verdict is not Verdict.OK]


async def test_what_this_computer_lacks_turns_its_own_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Issue 4: LiDAR packets arriving, clock, disk."""
    gib, jumped = 1 << 30, iter([0.0])
    real_time = time.time
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(100 * gib, 99 * gib, gib))
    monkeypatch.setattr("stockpilot.doctor_facts.time.time", lambda: real_time() + next(jumped, 3600.0))
    with Standing() as vehicle:
        async with open_vehicle(vehicle.ground_url) as link:
            around = Surroundings(lidar=f"udp://127.0.0.1:{free_port()}", folder=tmp_path)
            facts = await gather(link, around, probe=None, seconds=0.8)
    lines = {c.name: c for c in all_checks(facts)}
    assert lines["lidar"].verdict is Verdict.FAIL
    assert "no packets" in lines["lidar"].actual
    assert lines["computer.disk"].verdict is Verdict.FAIL
    assert lines["computer.clock"].verdict is Verdict.WARN
    assert "stepped 3600000 ms" in lines["computer.clock"].actual
    assert [name for name, line in lines.items() if line.verdict is Verdict.FAIL] == ["lidar", "computer.disk"]


async def test_apply_sets_what_is_wrong_and_reads_it_back() -> None:
    wrong = {"EKF2_EV_CTRL": 0, "COM_OBL_RC_ACT": 0, "RTL_RETURN_ALT": 60, "COM_OF_LOSS_T": 30}
    with Standing(**wrong) as vehicle:
        async with open_vehicle(vehicle.ground_url) as link:
            changes = {change.name: change for change in await apply_manifest(link)}
            again = await apply_manifest(link)
        values = {name: vehicle.autopilot.params.value(name) for name in wrong}
    assert values == {"EKF2_EV_CTRL": 15, "COM_OBL_RC_ACT": 4, "RTL_RETURN_ALT": 5, "COM_OF_LOSS_T": 1}
    assert set(wrong) <= set(changes)
    assert all(change.ok for change in changes.values())
    assert changes["EKF2_EV_CTRL"].before == 0
    assert again == [], "a second time there is nothing to do"


def test_the_command_is_red_on_a_wrong_vehicle_and_says_how_to_mend_it() -> None:
    """FAULTS 26: each line: expected, actual, why, how to mend."""
    with Standing(EKF2_EV_CTRL=0) as vehicle:
        code, result = command("--connect", vehicle.ground_url, "--lidar", "", "--seconds", "1", "--probe", "off")
    assert code == 1
    assert result["green"] is False
    assert result["autopilot"] == "px4"
    assert result["version"] == "1.18.0"
    assert result["shut_gates"] == ["switch"]
    (line,) = [c for c in result["checks"] if c["name"] == "parameter.EKF2_EV_CTRL"]
    assert (line["verdict"], line["actual"], line["expected"]) == ("fail", "0", "bits 9 set")
    assert line["why"]
    assert "Set EKF2_EV_CTRL to 15" in line["mend"]


def test_the_command_is_green_on_a_sound_vehicle_with_a_lidar() -> None:
    port = free_port()
    stop = threading.Event()

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sensor:
            while not stop.is_set():
                sensor.sendto(b"packet", ("127.0.0.1", port))
                time.sleep(0.01)

    sensor = threading.Thread(target=send, daemon=True)
    sensor.start()
    try:
        with Standing() as vehicle:
            code, result = command(
                "--connect", vehicle.ground_url, "--lidar", f"udp://127.0.0.1:{port}", "--seconds", "1.5"
            )
    finally:
        stop.set()
        sensor.join()
    red = [c for c in result["checks"] if c["verdict"] == "fail"]
    assert (code, red) == (0, [])
    verdicts = {c["name"]: c["verdict"] for c in result["checks"]}
    for name in ("lidar", "fusion", "origin", "time.sync", "stream.HEARTBEAT", "computer.disk", "sensor.gyroscope"):
        assert verdicts[name] == "ok"


def test_nobody_there_is_red_and_says_what_was_awaited() -> None:
    code, result = command("--connect", f"udpin://127.0.0.1:{free_port()}", "--timeout", "0.5")
    assert code == 1
    assert "no autopilot's heartbeat within 0.5 s" in result["checks"][0]["actual"]


def test_an_address_that_is_none_is_red_and_says_what_is_allowed() -> None:
    code, result = command("--connect", "carrier-pigeon://loft")
    assert code == 1
    assert "udpin://HOST:PORT" in result["checks"][0]["actual"]


async def test_no_test_pose_is_sent_to_an_armed_vehicle() -> None:
    """The probe is for the ground: never with motors on."""
    from stockpilot.doctor_facts import _may_probe
    from stockpilot.vehicle_link import VehicleLink

    link = VehicleLink(url="", system=None, direct=None, autopilot="px4")
    link.newest["HEARTBEAT"] = {"base_mode": 29}
    assert _may_probe(link, Probe(), fused=False)
    assert not _may_probe(link, Probe(), fused=True), "somebody's vision is fused already"
    link.has_companion = True
    assert not _may_probe(link, Probe(), fused=False)
    assert _may_probe(link, Probe(is_forced=True), fused=False)
    link.newest["EXTENDED_SYS_STATE"] = {"landed_state": 2}
    assert not _may_probe(link, Probe(is_forced=True), fused=False)
    link.newest["EXTENDED_SYS_STATE"] = {"landed_state": 1}
    link.newest["HEARTBEAT"] = {"base_mode": 29 | 128}
    assert not _may_probe(link, Probe(is_forced=True), fused=False)
    await asyncio.sleep(0)


def test_one_high_ratio_at_the_start_is_no_disagreement() -> None:
    """Recorded: 1.65 in the first report of a fusion that then went well."""
    assert _lasting([{"position": v} for v in (1.65, 0.5, 0.2, 0.1)]) == {"position": 0.2}
    assert _lasting([{"position": v} for v in (0.1, 5.0, 6.0, 5.5, 0.2)]) == {"position": 5.0}
    assert _lasting([]) == {}
