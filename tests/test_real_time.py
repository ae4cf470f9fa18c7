"""World and companion as two programs in real time: they meet only on the wire, and SIGTERM lands the vehicle."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import yaml

from tests.flights import SMALL_HALL

UNTIL_CLIMB_S = 200  # 50 s of time sync, and whatever a busy machine adds
UNTIL_LANDED_S = 120

pytestmark = pytest.mark.xdist_group("real time")


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def stockpilot(*arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "stockpilot.cli", *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.timeout(400)
def test_two_programs_fly_and_sigterm_lands_with_everything_recorded(tmp_path: Path) -> None:
    mission = tmp_path / "small_hall.yaml"
    mission.write_text(yaml.safe_dump(SMALL_HALL), encoding="utf-8")
    mavlink, lidar, ground, out = free_port(), free_port(), free_port(), tmp_path / "flight"
    world = stockpilot(
        "sim", str(mission), "--offboard", f"udpout://127.0.0.1:{mavlink}", "--lidar", f"udp://127.0.0.1:{lidar}",
        "--ground", f"udpout://127.0.0.1:{ground}", "--metadata", str(tmp_path / "lidar.json"), "--json",
    )  # fmt: skip
    try:
        deadline = time.monotonic() + 60
        while not (tmp_path / "lidar.json").exists() and time.monotonic() < deadline and world.poll() is None:
            time.sleep(0.1)
        companion = stockpilot(
            "fly", str(mission), "--connect", f"udpin://127.0.0.1:{mavlink}", "--lidar", f"udp://127.0.0.1:{lidar}",
            "--lidar-metadata", str(tmp_path / "lidar.json"), "--out", str(out), "--json",
        )  # fmt: skip
        said = Listener(companion)
        try:
            assert said.hears("climb", UNTIL_CLIMB_S), said.text()
            time.sleep(3.0)
            companion.send_signal(signal.SIGTERM)
            assert companion.stdout is not None
            printed = companion.stdout.read()
            assert companion.wait(UNTIL_LANDED_S) == 1, said.text()
        finally:
            companion.kill()
            companion.wait()
            said.close()
    finally:
        world.send_signal(signal.SIGTERM)
        world_said, world_errors = world.communicate(timeout=60)
    report = json.loads(printed)
    assert report["state"] == "aborted", said.text()
    assert report["scans"] > 100
    world_summary = json.loads(world_said)
    assert world_summary["collision"] is False, world_errors
    assert world_summary["sim_time_s"] > 50  # the time sync alone
    assert world_summary["real_time_factor"] == pytest.approx(
        world_summary["sim_time_s"] / world_summary["wall_time_s"], rel=1e-9
    )
    assert 0.3 < world_summary["real_time_factor_in_flight"] < 1.02  # never ahead; behind on a busy machine
    for name in ("recording.mcap", "telemetry.tlog", "report.json", "map.ply"):
        assert (out / name).stat().st_size > 0, name


@pytest.mark.parametrize("speed", [1.0, 0.5])
def test_sim_says_how_well_it_kept_its_pace(tmp_path: Path, speed: float) -> None:
    mission = tmp_path / "small_hall.yaml"
    mission.write_text(yaml.safe_dump(SMALL_HALL), encoding="utf-8")
    command = [
        "sim", str(mission), "--offboard", f"udpout://127.0.0.1:{free_port()}", "--lidar", f"udp://127.0.0.1:{free_port()}",
        "--ground", f"udpout://127.0.0.1:{free_port()}", "--speed", str(speed), "--duration", "2", "--json",
    ]  # fmt: skip
    with stockpilot(*command) as world:
        try:
            said, errors = world.communicate(timeout=100)
        finally:
            world.kill()
    summary = json.loads(said)
    assert summary["sim_time_s"] == pytest.approx(2.0, abs=0.05), errors
    assert summary["real_time_factor"] <= speed * 1.001
    assert summary["wall_time_s"] * summary["real_time_factor"] == pytest.approx(summary["sim_time_s"])
    assert summary["late_ticks"] >= 0
    assert summary["real_time_factor_in_flight"] is None  # it never left the ground


class Listener:
    """Reads a program's stderr as it comes."""

    def __init__(self, program: subprocess.Popen[str]) -> None:
        self._program = program
        self._lines: list[str] = []
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def hears(self, word: str, within_s: float) -> bool:
        deadline = time.monotonic() + within_s
        while time.monotonic() < deadline:
            if any(word in line for line in self._lines):
                return True
            if self._program.poll() is not None:
                return False
            time.sleep(0.1)
        return False

    def close(self) -> None:
        """Once the program has ended: nothing stays open."""
        self._thread.join()
        for pipe in (self._program.stdout, self._program.stderr):
            if pipe is not None:
                pipe.close()

    def text(self) -> str:
        return "".join(self._lines)

    def _read(self) -> None:
        assert self._program.stderr is not None
        for line in self._program.stderr:
            self._lines.append(line)
