"""The LiDAR's socket: stamps, order, and what gives way when nobody reads."""

from __future__ import annotations

import asyncio
import socket

import pytest

from companion.errors import LinkError
from companion.lidar.udp import LidarSocket, open_lidar, parse_udp_url


async def test_datagrams_arrive_in_order_with_stamps_and_source() -> None:
    lidar = await open_lidar("udp://127.0.0.1:0")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for n in range(5):
            sender.sendto(bytes([n]) * 100, ("127.0.0.1", lidar.port))
        got = []
        async with asyncio.timeout(5):
            while len(got) < 5:
                got += await lidar.take()
        address = sender.getsockname()
    lidar.close()
    await asyncio.sleep(0)  # the transport closes in the next turn of the loop
    assert [d.data[0] for d in got] == [0, 1, 2, 3, 4]
    assert all(d.source[1] == address[1] for d in got)
    assert [d.t_ns for d in got] == sorted(d.t_ns for d in got)


async def test_flood_sheds_the_oldest_and_counts() -> None:
    lidar = LidarSocket(queue_packets=10, now_ns=lambda: 1)
    for n in range(25):
        lidar.datagram_received(bytes([n]), ("127.0.0.1", 1))
    assert [d.data[0] for d in await lidar.take()] == list(range(15, 25))
    assert (lidar.received, lidar.dropped) == (25, 15)


async def test_port_in_use_is_told() -> None:
    first = await open_lidar("udp://127.0.0.1:0")
    with pytest.raises(LinkError, match="cannot listen"):
        await open_lidar(f"udp://127.0.0.1:{first.port}")
    first.close()
    await asyncio.sleep(0)


@pytest.mark.parametrize("url", ["7502", "tcp://:7502", "udp://:99999", "udp://:x", "udp://:7502/path"])
def test_wrong_address_is_told(url: str) -> None:
    with pytest.raises(LinkError, match="udp://"):
        parse_udp_url(url)


@pytest.mark.parametrize(
    ("url", "address"),
    [("udp://:7502", ("0.0.0.0", 7502)), ("udp://", ("0.0.0.0", 7502)), ("udp://127.0.0.1:0", ("127.0.0.1", 0))],
)
def test_address_is_taken_apart(url: str, address: tuple[str, int]) -> None:
    assert parse_udp_url(url) == address
