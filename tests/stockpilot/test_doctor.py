"""`stockpilot doctor` through MAVSDK against the emulated flight controller, each gate of fusion broken in turn."""

from __future__ import annotations

import asyncio
import json
import socket
import threading
import time
from typing import Any

import typer
from typer.testing import CliRunner

from companion.mavlink.checks import Verdict, all_checks, is_green
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
    (Probe(), {"EKF2_EV_CTRL": 0}, "switch"),
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
