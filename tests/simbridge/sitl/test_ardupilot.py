"""The socket end for ArduCopter, against a peer that asks as the recorded ArduCopter asked."""

from __future__ import annotations

import json
import math
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest

from simbridge.sensors import ImuSample
from simbridge.sitl import SitlError, ardupilot
from simbridge.sitl.ardupilot import ArduPilotSitl
from simbridge.sitl.json_physics import SERVO_PACKET
from tests.simbridge.sitl.recordings import json_physics

REST = ImuSample(accel_frd_mps2=np.array([0.0, 0.0, -9.81]), gyro_frd_radps=np.zeros(3))
STEP_NS = ArduPilotSitl.step_ns


@dataclass
class StandingPose:
    position_world_m: np.ndarray
    velocity_world_mps: np.ndarray
    q_world_body_wxyz: np.ndarray


class AskingArduCopter(threading.Thread):
    """Sends its requests one by one, each after an answer; the same once more only after again_s, as ArduCopter does."""

    def __init__(self, port: int, requests: list[bytes], again_s: float = 0.0) -> None:
        super().__init__(daemon=True)
        self._requests, self._port, self._again_s = requests, port, again_s
        self.answers: list[dict[str, object]] = []

    def run(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
            s.settimeout(3.0)
            for before, request in zip([b"", *self._requests], self._requests, strict=False):
                if request == before:
                    time.sleep(self._again_s)
                s.sendto(request, ("127.0.0.1", self._port))
                try:
                    self.answers.append(json.loads(s.recv(2048)))
                except TimeoutError:
                    return


def recorded_requests(part: str, count: int) -> list[bytes]:
    return [d.data for d in json_physics(part) if d.is_from_fc][:count]


@pytest.fixture
def pose() -> StandingPose:
    yaw = math.radians(30.0)  # counter-clockwise in world
    return StandingPose(
        np.array([10.0, 20.0, 0.5]), np.array([0.1, 0.2, 0.3]), np.array([math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)])
    )


@pytest.fixture
def sitl(pose: StandingPose) -> Iterator[ArduPilotSitl]:
    backend = ArduPilotSitl(port=0, connect_timeout_s=2.0)
    backend.attach(lambda: pose)
    yield backend
    backend.close()


def test_the_falling_rate_is_answered_before_the_simulation_moves(sitl: ArduPilotSitl) -> None:
    requests = recorded_requests("start", 600)
    rates = [SERVO_PACKET.unpack(r)[1] for r in requests]
    peer = AskingArduCopter(sitl.port, requests)
    peer.start()
    sitl.step(1_000_000_000, REST, None, None)
    stamps = np.array([a["timestamp"] for a in peer.answers])
    falling = rates.index(800)
    assert len(stamps) >= falling
    assert np.diff(stamps)[: falling - 2] == pytest.approx(1.0 / np.array(rates[1 : falling - 1]), abs=1.1e-6)


def test_from_then_on_each_step_answers_one_request(sitl: ArduPilotSitl) -> None:
    requests = recorded_requests("start", 600)
    first_800 = [SERVO_PACKET.unpack(r)[1] for r in requests].index(800)
    peer = AskingArduCopter(sitl.port, requests)
    peer.start()
    for i in range(100):
        sitl.step(1_000_000_000 + i * STEP_NS, REST, None, None)
    peer_answers = peer.answers[: first_800 + 100]
    assert len(peer_answers) == first_800 + 100
    steps = np.diff([a["timestamp"] for a in peer_answers])[first_800:]
    assert steps == pytest.approx(np.full(99, 0.00125), abs=1.1e-6)


def test_the_pose_is_ned_from_the_start_and_the_body_frd(sitl: ArduPilotSitl, pose: StandingPose) -> None:
    peer = AskingArduCopter(sitl.port, recorded_requests("armed", 40))
    peer.start()
    sitl.step(1_000_000_000, REST, None, 2.5)
    pose.position_world_m = np.array([11.0, 22.0, 3.5])  # 1 north, 2 west, 3 up
    sitl.step(1_000_000_000 + STEP_NS, REST, None, None)
    at_start, moved = peer.answers[0], peer.answers[1]
    assert at_start["position"] == [0.0, 0.0, 0.0]
    assert moved["position"] == [1.0, -2.0, -3.0]
    assert moved["velocity"] == [0.1, -0.2, -0.3]
    yaw = math.radians(-30.0)  # NED: clockwise positive
    assert moved["quaternion"] == pytest.approx([math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)], abs=1e-6)
    assert moved["imu"] == {"gyro": [0.0, 0.0, 0.0], "accel_body": [0.0, 0.0, -9.81]}
    assert moved["rng_1"] == 2.5  # held between its own measurements


def test_motors_turn_as_the_recorded_flight_asked(sitl: ArduPilotSitl) -> None:
    requests = recorded_requests("armed", 700)
    AskingArduCopter(sitl.port, requests).start()
    got = [sitl.step(1_000_000_000 + i * STEP_NS, REST, None, None) for i in range(600)]
    expected = [(np.array(SERVO_PACKET.unpack(r)[3:7]) - 1000) / 1000 for r in requests[1:601]]
    assert np.array(got) == pytest.approx(np.array(expected))
    assert np.max(got) > 0.4


def test_a_request_that_comes_again_is_answered_again_without_a_step(
    sitl: ArduPilotSitl, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ardupilot, "LOST_ANSWER_S", 0.1)
    requests = recorded_requests("armed", 10)
    peer = AskingArduCopter(sitl.port, [requests[0], requests[1], requests[1], requests[2], requests[3]], 0.2)
    peer.start()
    for i in range(3):
        sitl.step(1_000_000_000 + i * STEP_NS, REST, None, None)
    peer.join(5.0)
    stamps = [a["timestamp"] for a in peer.answers]
    assert stamps == [0.00125, 0.0025, 0.0025, 0.00375]


def test_copies_that_piled_up_while_we_were_held_up_are_answered_once(sitl: ArduPilotSitl) -> None:
    """Each answer too many would be a frame of delay for good."""
    first, second, third = recorded_requests("armed", 3)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as copter:
        copter.settimeout(1.0)
        for _ in range(5):
            copter.sendto(first, ("127.0.0.1", sitl.port))
        copter.sendto(second, ("127.0.0.1", sitl.port))
        copter.sendto(third, ("127.0.0.1", sitl.port))
        sitl.step(1_000_000_000, REST, None, None)
        sitl.step(1_000_000_000 + STEP_NS, REST, None, None)
        stamps = [json.loads(copter.recv(2048))["timestamp"] for _ in range(2)]
        copter.settimeout(0.1)
        with pytest.raises(TimeoutError):
            copter.recv(2048)
    assert stamps == [0.00125, 0.0025]


def test_silence_in_flight_is_motors_off_and_a_restart_goes_on(
    sitl: ArduPilotSitl, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ardupilot, "SILENCE_S", 0.1)
    AskingArduCopter(sitl.port, recorded_requests("armed", 600)[500:]).start()
    for i in range(120):
        motors = sitl.step(1_000_000_000 + i * STEP_NS, REST, None, None)
    assert not motors.any()
    AskingArduCopter(sitl.port, recorded_requests("start", 50)).start()
    for i in range(120, 400):
        sitl.step(1_000_000_000 + i * STEP_NS, REST, None, None)
        if sitl.restarts:
            break
    assert sitl.restarts == 1


def test_no_arducopter_is_told_with_what_to_do(pose: StandingPose) -> None:
    backend = ArduPilotSitl(port=0, connect_timeout_s=0.1)
    backend.attach(lambda: pose)
    with pytest.raises(SitlError, match=r"did not speak to UDP port .* --autopilot-binary"):
        backend.step(1_000_000_000, REST, None, None)
    backend.close()


def test_without_a_pose_the_mistake_is_told() -> None:
    backend = ArduPilotSitl(port=0)
    with pytest.raises(SitlError, match="attach"):
        backend.step(1_000_000_000, REST, None, None)
    backend.close()
