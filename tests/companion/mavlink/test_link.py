"""The edge: UDP, TCP and serial carry bytes and addresses, and say what is wrong."""

from __future__ import annotations

import asyncio
import os
import socket

import pytest

from companion.errors import LinkError
from companion.mavlink.link import LinkUrl, MavlinkLink, open_link


async def wait_for(link: MavlinkLink) -> list[tuple[bytes, int, object]]:
    return list(await asyncio.wait_for(link.take(), 5))


def free_port(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.mark.parametrize(
    "url",
    [
        "",
        "udp",
        "udpin://",
        "udpin://host",
        "http://a:1",
        "serial:///dev/ttyX",
        "udpin://h:notaport",
        "udpin://h:70000",
    ],
)
def test_a_link_that_is_none_is_refused_with_what_is_allowed(url: str) -> None:
    with pytest.raises(LinkError, match="allowed: udpin://host:port"):
        LinkUrl.parse(url)


def test_links_are_understood() -> None:
    assert LinkUrl.parse("udpin://0.0.0.0:14540") == LinkUrl("udpin", "0.0.0.0", 14540)
    assert LinkUrl.parse("serial:///dev/ttyAMA0:921600") == LinkUrl("serial", "/dev/ttyAMA0", 921600)


async def test_udp_answers_to_where_the_first_datagram_came_from() -> None:
    port = free_port(socket.SOCK_DGRAM)
    here = await open_link(f"udpin://127.0.0.1:{port}")
    here.send(b"nobody yet")
    assert here.send_errors == 1
    there = await open_link(f"udpout://127.0.0.1:{port}", now_ns=lambda: 42)
    there.send(b"hello")
    ((data, t_ns, source),) = await wait_for(here)
    assert data == b"hello"
    assert t_ns > 0
    assert here.peer == source
    here.send(b"answer")
    assert [(data, t) for data, t, _ in await wait_for(there)] == [(b"answer", 42)]
    here.close()
    there.close()


async def test_a_flood_sheds_the_oldest_and_counts() -> None:
    """FAULTS 7: bounded queue; shed the oldest."""
    port = free_port(socket.SOCK_DGRAM)
    here = await open_link(f"udpin://127.0.0.1:{port}")
    for number in range(1500):
        here._arrive(str(number).encode(), ("127.0.0.1", 1))
    packets = await wait_for(here)
    assert len(packets) == 1024
    assert packets[-1][0] == b"1499"
    assert here.shed == 1500 - 1024
    here.close()


async def test_tcp_both_ways_and_its_end_is_told() -> None:
    port = free_port(socket.SOCK_STREAM)
    server = await open_link(f"tcpin://127.0.0.1:{port}")
    client = await open_link(f"tcpout://127.0.0.1:{port}")
    client.send(b"to the server")
    assert [data for data, _, _ in await wait_for(server)] == [b"to the server"]
    server.send(b"to the client")
    assert [(data, source) for data, _, source in await wait_for(client)] == [(b"to the client", None)]
    client.close()
    with pytest.raises(LinkError, match="closed"):
        await wait_for(client)
    server.close()


async def test_serial_carries_every_byte_unchanged() -> None:
    master, slave = os.openpty()
    link = await open_link(f"serial://{os.ttyname(slave)}:115200")
    everything = bytes(range(256))
    os.write(master, everything)
    got = b""
    while len(got) < 256:
        got += b"".join(data for data, _, _ in await wait_for(link))
    assert got == everything
    link.send(everything)
    assert os.read(master, 1024) == everything
    link.close()
    os.close(slave)
    os.close(master)


@pytest.mark.parametrize(
    ("url", "why"),
    [
        ("serial:///dev/no_such_port:115200", "No such file"),
        ("serial:///dev/null:115200", "cannot be opened"),
        ("serial:///dev/null:12345", "baud rate 12345 is unknown"),
    ],
)
async def test_a_serial_port_that_cannot_be_opened_is_told(url: str, why: str) -> None:
    with pytest.raises(LinkError, match=why):
        await open_link(url)


async def test_a_port_in_use_is_told_with_what_to_do() -> None:
    port = free_port(socket.SOCK_DGRAM)
    first = await open_link(f"udpin://127.0.0.1:{port}")
    with pytest.raises(LinkError, match="Another program listens there"):
        await open_link(f"udpin://127.0.0.1:{port}")
    first.close()


async def test_nobody_at_the_other_end_is_told() -> None:
    with pytest.raises(LinkError, match="start the autopilot first"):
        await open_link(f"tcpout://127.0.0.1:{free_port(socket.SOCK_STREAM)}")
