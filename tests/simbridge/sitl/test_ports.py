"""Ports are looked at before an autopilot is started: one that cannot bind says nothing."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Iterator

import pytest

from simbridge.sitl import SitlError, ports
from simbridge.sitl.ports import Port, first_free_instance, require_free

HOLD = """
import socket, sys
with socket.socket(socket.AF_INET, getattr(socket, sys.argv[1])) as s:
    s.bind(("127.0.0.1", 0))
    if sys.argv[1] == "SOCK_STREAM":
        s.listen()
    print(s.getsockname()[1], flush=True)
    sys.stdin.read()
"""


@pytest.fixture(params=["TCP", "UDP"])
def held(request: pytest.FixtureRequest) -> Iterator[tuple[Port, int]]:
    """A port that another program holds, and that program's number."""
    kind = {"TCP": "SOCK_STREAM", "UDP": "SOCK_DGRAM"}[request.param]
    command = [sys.executable, "-c", HOLD, kind]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        yield Port(request.param, int(program.stdout.readline()), "a test"), program.pid
        program.kill()


def test_a_held_port_is_told_with_its_holder_and_what_to_do(held: tuple[Port, int]) -> None:
    port, process = held
    assert not port.is_free()
    with pytest.raises(SitlError) as refused:
        require_free([port])
    said = str(refused.value)
    assert f"{port.protocol} {port.number} (a test) is held by python" in said
    assert f"(process {process})" in said
    assert "end that program" in said


def test_the_first_instance_with_all_ports_free_is_taken(held: tuple[Port, int]) -> None:
    port, _ = held
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        free = Port("UDP", probe.getsockname()[1], "a test")
    assert first_free_instance(lambda i: (free, port) if i < 2 else (free,)) == 2


def test_where_no_instance_is_free_each_ones_holder_is_told(
    held: tuple[Port, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    port, process = held
    monkeypatch.setattr(ports, "INSTANCES", range(2))
    with pytest.raises(SitlError) as refused:
        first_free_instance(lambda _: (port,))
    lines = str(refused.value).splitlines()
    assert [line.split(":")[0].strip() for line in lines[1:]] == ["instance 0", "instance 1"]
    assert all(f"(process {process})" in line for line in lines[1:])


def test_a_connection_that_lingers_after_a_flight_holds_nothing() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        number = server.getsockname()[1]
        with socket.create_connection(("127.0.0.1", number)):
            server.accept()[0].close()  # the side that closes first waits
    assert Port("TCP", number, "a test").is_free()


@pytest.mark.parametrize("ports_of", [ports.px4_ports, ports.arducopter_ports])
def test_no_two_instances_share_a_port(ports_of: object) -> None:
    assert callable(ports_of)
    numbers = [(port.protocol, port.number) for instance in ports.INSTANCES for port in ports_of(instance)]
    assert len(set(numbers)) == len(numbers)
