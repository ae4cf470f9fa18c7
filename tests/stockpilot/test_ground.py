"""`stockpilot ground` through MAVSDK against the emulated flight controller."""

from __future__ import annotations

import json
import random
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from stockpilot.ground import ground_app, read_status
from stockpilot.vehicle_link import VehicleLink
from tests.stockpilot.emulated import Standing, free_port
from tests.stockpilot.log_keeper import LogKeeper


def ground(*arguments: str) -> tuple[int, dict[str, Any]]:
    result = CliRunner().invoke(ground_app, [*arguments, "--json"])
    return result.exit_code, json.loads(result.stdout)


def test_status_tells_mode_landed_and_armed() -> None:
    with Standing() as vehicle:
        code, status = ground("status", "--connect", vehicle.ground_url)
    assert code == 0
    assert (status["autopilot"], status["mode"], status["armed"]) == ("px4", "hold", False)
    assert status["landed_state"] == "on_ground"
    assert status["vision_fused"] is False
    assert status["position_valid"] is False
    assert status["failsafe"] is False


def test_abort_answers_also_on_the_ground_and_may_be_repeated() -> None:
    """FAULTS 28: abort always wins, is idempotent, acknowledged."""
    with Standing() as vehicle:
        for name in ("abort", "abort"):
            code, result = ground(name, "--connect", vehicle.ground_url)
            assert (code, result["ok"], result["asked"]) == (0, True, name), result


def test_a_hold_that_cannot_be_is_refused_with_the_reason() -> None:
    """PX4.md 4: "AUTO_LOITER(Hold), MISSION, RTL need *global* position on rotary wing": without vision there is none."""
    with Standing() as vehicle:
        vehicle.autopilot.commander.is_armed = True  # as if it had lost its vision in the air
        code, result = ground("hold", "--connect", vehicle.ground_url)
    assert (code, result["ok"], result["asked"]) == (1, False, "hold")
    assert "DENIED" in result["error"], result


def test_a_vehicle_without_logs_has_an_empty_list() -> None:
    with Standing() as vehicle:
        code, result = ground("logs", "--connect", vehicle.ground_url)
    assert (code, result["ok"], result["logs"]) == (0, True, [])


@pytest.mark.parametrize("lost_every", [0, 37])
def test_the_newest_logs_are_downloaded_to_the_byte(tmp_path: Path, lost_every: int) -> None:
    logs = {n: random.Random(n).randbytes(20_000 + n) for n in (1, 2, 3)}
    with LogKeeper(logs, lost_every=lost_every) as vehicle:
        code, result = ground("logs", "--connect", vehicle.ground_url, "--out", str(tmp_path / "logs"), "--newest", "2")
        assert bool(vehicle.lost) is bool(lost_every)
    assert (code, result["ok"]) == (0, True), result
    assert [(log["id"], log["bytes"]) for log in result["logs"]] == [(n, len(logs[n])) for n in (1, 2, 3)]
    files = sorted((tmp_path / "logs").iterdir())
    assert [str(path) for path in files] == result["saved"]
    assert [path.name.split("_")[0] for path in files] == ["log002", "log003"]
    assert [path.read_bytes() for path in files] == [logs[2], logs[3]]


def test_logs_that_nobody_lists_are_told_not_raised() -> None:
    with LogKeeper({}) as vehicle:
        code, result = ground("logs", "--connect", vehicle.ground_url)
    assert code == 1
    assert "list of logs was not given" in result["error"]
    assert result["logs"] == []


@pytest.mark.parametrize("name", ["status", "hold", "land", "abort", "logs"])
def test_nobody_there_is_exit_code_1_with_the_reason(name: str) -> None:
    code, result = ground(name, "--connect", f"udpin://127.0.0.1:{free_port()}", "--timeout", "0.5")
    assert code == 1
    assert "no autopilot's heartbeat" in result["error"]


@pytest.mark.parametrize(
    ("autopilot", "heartbeat", "current", "mode"),
    [
        ("px4", 6 << 16, None, "offboard"),
        ("px4", 4 << 16 | 6 << 24, 0, "descend"),
        ("px4", 4 << 16 | 6 << 24, 7, "land"),
        ("ardupilot", 4, None, "offboard"),
        ("ardupilot", 9, None, "land"),
    ],
)
def test_status_reads_the_mode_as_the_companion_does(
    autopilot: str, heartbeat: int, current: int | None, mode: str
) -> None:
    link = VehicleLink(url="", system=None, direct=None, autopilot=autopilot)
    link.newest["HEARTBEAT"] = {"base_mode": 29 | 128, "custom_mode": heartbeat, "system_status": 4}
    if current is not None:
        link.newest["CURRENT_MODE"] = {"custom_mode": heartbeat, "standard_mode": current}
    status = read_status(link)
    assert status["mode"] == mode
    assert status["armed"] is True
