"""World and companion as two programs in real time: they meet only on the wire, and SIGTERM lands the vehicle."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from tests.flights import SMALL_HALL
from tests.simbridge.sitl.real_binaries import BOTH, real_binary

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
    with flying(tmp_path, "emulated") as programs:
        assert programs.said.hears("Takeoff detected", UNTIL_CLIMB_S), programs.said.text()  # late on a busy machine
        time.sleep(3.0)
        programs.companion.send_signal(signal.SIGTERM)
        report = programs.companion_report()
        world_summary = programs.world_summary()
    said = programs.said.text()
    assert report["state"] == "aborted", said
    assert report["scans"] > 100
    assert world_summary["collision"] is False, said
    assert world_summary["sim_time_s"] > 50  # the time sync alone
    assert world_summary["real_time_factor"] == pytest.approx(
        world_summary["sim_time_s"] / world_summary["wall_time_s"], rel=1e-9
    )
    assert 0.3 < world_summary["real_time_factor_in_flight"] < 1.02  # never ahead; behind on a busy machine
    for name in ("recording.mcap", "telemetry.tlog", "report.json", "map.ply"):
        assert (programs.out / name).stat().st_size > 0, name


@pytest.mark.timeout(600)
@pytest.mark.parametrize("kind", ["emulated", *BOTH])
def test_a_companion_stopped_in_flight_comes_down_and_awake_again_stays_there(tmp_path: Path, kind: str) -> None:
    """SIGSTOP, as a computer that hangs: its sockets stay open. SIGCONT once the vehicle stands."""
    with flying(tmp_path, kind) as programs:
        time.sleep(8.0)
        programs.companion.send_signal(signal.SIGSTOP)
        assert seconds_until_disarmed(programs.ground_port, 90.0) < 60.0
        programs.companion.send_signal(signal.SIGCONT)
        report = programs.companion_report()
        world_summary = programs.world_summary()
    assert report["state"] != "completed", programs.said.text()
    if kind != "ardupilot":  # blind for more than 8 s it drifts by metres, onto walls too
        assert world_summary["collision"] is False, programs.said.text()


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


@dataclass
class Programs:
    """The world and the companion, which is in the air."""

    world: subprocess.Popen[str]
    companion: subprocess.Popen[str]
    said: Listener
    ground_port: int
    out: Path

    def companion_report(self) -> dict[str, Any]:
        """Wait for its end."""
        assert self.companion.stdout is not None
        printed = self.companion.stdout.read()
        assert self.companion.wait(UNTIL_LANDED_S) == 1, self.said.text()
        report: dict[str, Any] = json.loads(printed)
        return report

    def world_summary(self) -> dict[str, Any]:
        """End it."""
        self.world.send_signal(signal.SIGTERM)
        summary: dict[str, Any] = json.loads(self.world.communicate(timeout=60)[0])
        return summary


@contextmanager
def flying(tmp_path: Path, kind: str) -> Iterator[Programs]:
    """Both programs, from when the companion climbs. kind: emulated, px4, ardupilot."""
    mission = tmp_path / "small_hall.yaml"
    mission.write_text(yaml.safe_dump(SMALL_HALL), encoding="utf-8")
    lidar, out, metadata = free_port(), tmp_path / "flight", tmp_path / "lidar.json"
    offboard, ground = (free_port(), free_port()) if kind == "emulated" else (14540, 14550)
    real = [] if kind == "emulated" else ["--autopilot", kind, "--autopilot-binary", str(real_binary(kind))]
    world = stockpilot(
        "sim", str(mission), "--offboard", f"udpout://127.0.0.1:{offboard}", "--lidar", f"udp://127.0.0.1:{lidar}",
        "--ground", f"udpout://127.0.0.1:{ground}", "--metadata", str(metadata), "--json", *real,
    )  # fmt: skip
    with world:
        try:
            deadline = time.monotonic() + 60
            while not metadata.exists() and time.monotonic() < deadline and world.poll() is None:
                time.sleep(0.1)
            companion = stockpilot(
                "fly", str(mission), "--connect", f"udpin://127.0.0.1:{offboard}", "--lidar", f"udp://127.0.0.1:{lidar}",
                "--lidar-metadata", str(metadata), "--out", str(out), "--json",
            )  # fmt: skip
            said = Listener(companion)
            try:
                assert said.hears("climb", UNTIL_CLIMB_S), said.text()
                yield Programs(world=world, companion=companion, said=said, ground_port=ground, out=out)
            finally:
                companion.kill()
                companion.wait()
                said.close()
        finally:
            world.kill()


def seconds_until_disarmed(port: int, limit_s: float) -> float:
    """Listens as a ground station does."""
    reader, began = mavlink.MAVLink(None), time.monotonic()
    reader.robust_parsing = True
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind(("127.0.0.1", port))
        link.settimeout(5.0)
        while time.monotonic() < began + limit_s:
            for message in reader.parse_buffer(link.recv(4096)) or ():
                of_the_autopilot = message.get_type() == "HEARTBEAT" and message.get_srcComponent() == 1
                if of_the_autopilot and not message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED:
                    return time.monotonic() - began
    raise AssertionError(f"still armed after {limit_s} s")


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
