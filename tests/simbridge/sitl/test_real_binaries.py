"""The physics side against real autopilots on the ground: boot, lockstep, rates."""

from __future__ import annotations

import socket

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from simbridge.sensors import BaroSample, ImuSample, isa_pressure_hpa
from simbridge.sitl import parameters
from simbridge.sitl.ardupilot import ArduPilotSitl
from simbridge.sitl.ports import arducopter_ports, first_free_instance
from simbridge.sitl.process import start_arducopter, start_px4
from simbridge.sitl.px4 import Px4Sitl
from tests.simbridge.sitl.real_binaries import real_binary
from tests.simbridge.sitl.test_ardupilot import StandingPose

BARO_PERIOD_NS = 20_000_000
START_NS = 1_000_000_000
pytestmark = pytest.mark.timeout(300)


def sensors(rng: np.random.Generator) -> ImuSample:
    """At rest, with noise: without any, PX4 says STALE."""
    return ImuSample(
        accel_frd_mps2=np.array([0.0, 0.0, -9.81]) + rng.normal(0, 0.02, 3), gyro_frd_radps=rng.normal(0, 0.001, 3)
    )


def standing() -> StandingPose:
    return StandingPose(np.zeros(3), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))


def heard(link: socket.socket, reader: mavlink.MAVLink) -> list[mavlink.MAVLink_message]:
    messages = []
    while True:
        try:
            messages += reader.parse_buffer(link.recv(4096)) or []
        except BlockingIOError:
            return messages


@pytest.mark.px4
@pytest.mark.xdist_group("px4")
def test_real_px4_keeps_lockstep_and_its_clock_is_ours() -> None:
    binary, rng = real_binary("px4"), np.random.default_rng(0)
    sitl = Px4Sitl()
    sitl.attach(standing)
    reader, boot_ms, t_ns = mavlink.MAVLink(None), [], START_NS
    reader.robust_parsing = True
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link, start_px4(binary, parameters.PX4) as px4:
        link.bind(("127.0.0.1", 14540))
        link.setblocking(False)
        sitl.process = px4
        steps_before_lockstep = 0
        for _ in range(3000):
            pressure = isa_pressure_hpa(488.0) + float(rng.normal(0, 0.01))
            baro = BaroSample(pressure_hpa=pressure, pressure_altitude_m=488.0, temperature_c=15.0)
            sitl.step(t_ns, sensors(rng), baro if t_ns % BARO_PERIOD_NS == 0 else None, 0.12)
            t_ns += sitl.step_ns
            steps_before_lockstep += not sitl.is_lockstep
            for m in heard(link, reader):
                if m.get_type() == "ATTITUDE":
                    boot_ms.append((t_ns // 1_000_000 - m.time_boot_ms, m))
    sitl.close()
    assert sitl.connections == 1
    assert steps_before_lockstep < 250
    assert len(boot_ms) > 100
    lateness = np.array([late for late, _ in boot_ms])
    assert np.median(np.abs(lateness)) < 100  # its clock is the simulation's, whatever the machine's speed
    last = boot_ms[-1][1]
    assert abs(last.roll) < 0.05
    assert abs(last.pitch) < 0.05


@pytest.mark.ardupilot
def test_real_arducopter_keeps_lockstep_at_800_hz_and_its_clock_is_ours() -> None:
    binary, rng = real_binary("ardupilot"), np.random.default_rng(0)
    sitl = ArduPilotSitl(port=0)
    sitl.attach(standing)
    reader, lateness, t_ns = mavlink.MAVLink(None), [], START_NS
    reader.robust_parsing = True
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind(("127.0.0.1", 0))
        link.setblocking(False)
        ports = {"physics_port": sitl.port, "offboard_port": link.getsockname()[1], "ground_port": 14550}
        instance = first_free_instance(arducopter_ports)  # its third serial port is bound whatever we give
        with start_arducopter(binary, parameters.ARDUPILOT, instance=instance, **ports) as copter:
            sitl.process = copter
            for _ in range(8000):
                motors = sitl.step(t_ns, sensors(rng), None, 0.12)
                t_ns += sitl.step_ns
                for m in heard(link, reader):
                    if m.get_type() == "HEARTBEAT":
                        lateness.append(t_ns)
    sitl.close()
    assert not motors.any()
    assert sitl.restarts == 0
    between_s = np.diff(lateness) / 1e9
    assert len(between_s) >= 6
    assert np.median(between_s) == pytest.approx(1.0, abs=0.02)  # its heartbeat, in our time
