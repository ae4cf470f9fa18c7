"""`stockpilot ground` through MAVSDK against the emulated flight controller."""

from __future__ import annotations

import json
from typing import Any

import pytest
from typer.testing import CliRunner

from stockpilot.ground import ground_app, read_status
from stockpilot.vehicle_link import VehicleLink
from tests.stockpilot.emulated import Standing, free_port


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


def test_logs_that_cannot_be_listed_are_told_not_raised() -> None:
    with Standing() as vehicle:
        code, result = ground("logs", "--connect", vehicle.ground_url)
    assert code == (0 if result["ok"] else 1)
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
