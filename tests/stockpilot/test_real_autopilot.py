"""Which ports a real autopilot that we start is given: a stand-in for its binary, nothing that flies."""

from __future__ import annotations

import socket
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import yaml

from companion.errors import LinkError
from simbridge.config import SimConfig
from simbridge.sitl.ports import Port, arducopter_ports, first_free_instance, px4_ports
from stockpilot.mission import load_mission
from stockpilot.real_autopilot import COMPANION_PORT, prepare_real, simulation_for
from tests.flights import SMALL_HALL

pytestmark = pytest.mark.xdist_group("px4")  # its ports are fixed
ITS_PORTS = [port.purpose for port in px4_ports(0)]


@pytest.fixture
def world(tmp_path: Path) -> SimConfig:
    mission = tmp_path / "small_hall.yaml"
    mission.write_text(yaml.safe_dump(SMALL_HALL), encoding="utf-8")
    sim = load_mission(mission).sim
    assert sim is not None
    return sim


@pytest.fixture
def stand_in(tmp_path: Path) -> Path:
    """Starts as PX4 and as ArduCopter do, notes how, and does nothing more."""
    (tmp_path / "etc" / "init.d-posix").mkdir(parents=True)
    path = tmp_path / "bin" / "autopilot"
    path.parent.mkdir()
    path.write_text(f'#!/bin/sh\necho "$@" > {tmp_path / "started_with"}\nexec sleep 60\n', encoding="ascii")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


@contextmanager
def holding(port: Port) -> Iterator[None]:
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM if port.protocol == "TCP" else socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", port.number))
        if port.protocol == "TCP":
            other.listen()
        yield


def started_with(tmp_path: Path) -> list[str]:
    deadline = time.monotonic() + 10.0
    while not (text := _text(tmp_path / "started_with")) and time.monotonic() < deadline:
        time.sleep(0.02)
    return text.split()


def _text(path: Path) -> str:
    return path.read_text(encoding="ascii") if path.exists() else ""


@pytest.mark.parametrize("which", range(len(ITS_PORTS)), ids=ITS_PORTS)
def test_run_gives_px4_an_instance_none_of_whose_ports_another_program_holds(
    which: int, world: SimConfig, stand_in: Path, tmp_path: Path
) -> None:
    """PX4 that cannot bind its own UDP ports says one line in a log that nobody reads, and never gets ready."""
    instance = first_free_instance(px4_ports)
    with holding(px4_ports(instance)[which]):
        _, wire, closing = prepare_real(world, "px4", stand_in)
        with closing:
            taken = wire._link.port - COMPANION_PORT
            arguments = started_with(tmp_path)
    assert taken != instance  # a lower one may have become free since
    assert arguments[arguments.index("-i") + 1] == str(taken)


def test_sim_tells_which_port_of_px4_is_held_and_by_whom(world: SimConfig, stand_in: Path) -> None:
    """It cannot take another: `fly` beside it listens where instance 0 sends."""
    instance = first_free_instance(px4_ports)
    port = next(p for p in px4_ports(instance) if p.number == 18570 + instance)
    with holding(port), pytest.raises(LinkError) as refused:
        simulation_for(world, "px4", stand_in, companion_port=COMPANION_PORT + instance)
    assert f"UDP {port.number} (PX4's link to a ground station) is held by this program" in str(refused.value)
    assert "end that program" in str(refused.value)


def test_arducopter_gets_an_instance_whose_ports_are_free(world: SimConfig, stand_in: Path, tmp_path: Path) -> None:
    """One that cannot listen on its third serial port ends at once."""
    instance = first_free_instance(arducopter_ports)
    with holding(arducopter_ports(instance)[1]):
        _, _, closing = prepare_real(world, "ardupilot", stand_in)
        with closing:
            arguments = started_with(tmp_path)
    taken = int(arguments[arguments.index("--instance") + 1])
    assert taken != instance
    assert arguments[arguments.index("--sim-port-out") + 1] == str(9002 + 10 * taken)


def test_a_companion_that_listens_already_is_told_where_the_autopilot_is_the_users(world: SimConfig) -> None:
    port = Port("UDP", COMPANION_PORT, "where the autopilot sends to the companion")
    if not port.is_free():
        with pytest.raises(LinkError, match=f"UDP {COMPANION_PORT} .* is held by"):
            prepare_real(world, "px4", None)
        return
    with holding(port), pytest.raises(LinkError, match=f"UDP {COMPANION_PORT} .* is held by this program"):
        prepare_real(world, "px4", None)
