"""The socket end for PX4, against a peer that answers with what the real PX4 of hil_lockstep answered."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from simbridge.sensors import BaroSample, ImuSample
from simbridge.sitl import SitlError
from simbridge.sitl.px4 import Px4Sitl
from tests.simbridge.sitl.recordings import decode, tlog_frames

REST = ImuSample(accel_frd_mps2=np.array([0.0, 0.0, -9.81]), gyro_frd_radps=np.zeros(3))
BARO = BaroSample(pressure_hpa=955.98, pressure_altitude_m=488.0, temperature_c=15.0)
FIRST_NS = 1_004_000_000
STEP_NS = Px4Sitl.step_ns


class RecordedPx4(threading.Thread):
    """Connects, says what PX4 said on connecting, then answers each HIL_SENSOR as PX4 did at that time."""

    def __init__(self, port: int, *, silent_after_us: int | None = None, leaves_after_us: int | None = None) -> None:
        super().__init__(daemon=True)
        frames = [f for _, f in tlog_frames("autopilots", "px4", "hil_lockstep.from_fc.tlog")]
        self._greeting = frames[:2]
        self._answers = {decode(f).time_usec: f for f in frames[2:]}
        self._silent_after_us, self._leaves_after_us = silent_after_us, leaves_after_us
        self._port = port
        self.heard: list[mavlink.MAVLink_message] = []

    def run(self) -> None:
        reader = mavlink.MAVLink(None)
        with socket.create_connection(("127.0.0.1", self._port)) as connection:
            connection.sendall(b"".join(self._greeting))
            while data := connection.recv(65536):
                for message in reader.parse_buffer(data) or ():
                    self.heard.append(message)
                    if message.get_type() != "HIL_SENSOR":
                        continue
                    t_us = message.time_usec
                    if self._leaves_after_us is not None and t_us > self._leaves_after_us:
                        return
                    if t_us in self._answers and not (self._silent_after_us and t_us > self._silent_after_us):
                        connection.sendall(self._answers[t_us])


@pytest.fixture
def sitl() -> Iterator[Px4Sitl]:
    backend = Px4Sitl(port=0, connect_timeout_s=5.0, answer_timeout_s=0.3)
    yield backend
    backend.close()


def step(sitl: Px4Sitl, i: int) -> np.ndarray:
    return sitl.step(FIRST_NS + i * STEP_NS, REST, BARO if (i + 1) % 5 == 0 else None, 1.0)


def test_steps_do_not_wait_while_px4_boots_then_go_in_lockstep(sitl: Px4Sitl) -> None:
    """PX4.md: "During boot, keep sending HIL_SENSOR without waiting"."""
    peer = RecordedPx4(sitl.port)
    peer.start()
    lockstep = []
    for i in range(60):
        step(sitl, i)
        lockstep.append(sitl.is_lockstep)
    assert lockstep.index(True) == 27  # the recorded PX4 answered the 28th frame first, at 1.112 s
    assert all(lockstep[27:])


def test_each_step_returns_the_answer_to_its_own_sensors(sitl: Px4Sitl) -> None:
    """PX4.md: "PX4 answers each HIL_SENSOR with exactly one HIL_ACTUATOR_CONTROLS"."""
    RecordedPx4(sitl.port).start()
    answers = {
        decode(f).time_usec: decode(f).controls[:4]
        for _, f in list(tlog_frames("autopilots", "px4", "hil_lockstep.from_fc.tlog"))[2:]
    }
    for i in range(3200):  # over arming and the ramp of the motors
        motors = step(sitl, i)
        if sitl.is_lockstep:
            assert motors == pytest.approx(answers[(FIRST_NS + i * STEP_NS) // 1000])
    assert sitl.is_armed
    assert motors.min() > 0.1


def test_px4_hears_what_the_recorded_px4_heard(sitl: Px4Sitl) -> None:
    peer = RecordedPx4(sitl.port)
    peer.start()
    for i in range(100):
        step(sitl, i)
    recorded = [decode(f) for _, f in list(tlog_frames("autopilots", "px4", "hil_lockstep.to_fc.tlog"))[:100]]
    expected = [m.time_usec for m in recorded if m.get_type() == "HIL_SENSOR"]
    heard = [m.time_usec for m in peer.heard if m.get_type() == "HIL_SENSOR"]
    assert heard[: len(expected)] == expected


def test_a_px4_that_falls_silent_is_told_with_its_time(sitl: Px4Sitl) -> None:
    """PX4.md: "If HIL_SENSOR stops, PX4 freezes"."""
    RecordedPx4(sitl.port, silent_after_us=1_200_000).start()
    for i in range(50):  # up to 1.2 s
        step(sitl, i)
    with pytest.raises(SitlError, match=r"t = 1\.204 s within 0\.3 s"):
        step(sitl, 50)


def test_px4_gone_means_motors_off_and_back_means_lockstep_again(sitl: Px4Sitl) -> None:
    """PX4.md: "PX4 is the TCP client (4560 + instance) and tries until a simulator accepts"."""
    RecordedPx4(sitl.port, leaves_after_us=13_000_000).start()  # armed, motors turning
    i = 0
    while i < 3100 and sitl.connections < 2 and (i < 200 or sitl.is_lockstep):
        step(sitl, i)
        i += 1
    assert i * STEP_NS + FIRST_NS > 12_900_000_000
    assert not step(sitl, i).any()
    again = RecordedPx4(sitl.port)
    again.start()
    while not sitl.is_lockstep:
        i += 1
        step(sitl, i)
    assert sitl.connections == 2
    times = [m.time_usec for m in again.heard if m.get_type() == "HIL_SENSOR"]
    assert times[0] == 1_000_000  # a PX4 that has restarted is given a clock that has, too
    assert times[1] == 1_004_000


def test_no_px4_is_told_with_what_to_do() -> None:
    """PX4.md: "PX4 is the TCP client (4560 + instance) and tries until a simulator accepts"."""
    backend = Px4Sitl(port=0, connect_timeout_s=0.1)
    with pytest.raises(SitlError, match=r"did not connect to TCP port .* --autopilot-binary"):
        step(backend, 0)
    backend.close()


def test_a_taken_port_is_told() -> None:
    first = Px4Sitl(port=0)
    with pytest.raises(SitlError, match="another simulation"):
        Px4Sitl(port=first.port)
    first.close()
