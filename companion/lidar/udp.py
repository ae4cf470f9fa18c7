"""LiDAR packets off the network: an edge. Stamps each datagram when it is read and queues it; the oldest gives way."""

from __future__ import annotations

import asyncio
import socket
import time
from collections import deque
from collections.abc import Callable
from typing import NamedTuple, cast
from urllib.parse import urlsplit

from companion.errors import LinkError

RECEIVE_BUFFER_BYTES = (
    8 << 20
)  # half a second of the largest Ouster stream; the kernel grants what net.core.rmem_max allows
QUEUE_PACKETS = 1024
DEFAULT_PORT = 7502  # Ouster's default for LiDAR data


class Datagram(NamedTuple):
    data: bytes
    t_ns: int
    source: tuple[str, int]


class LidarSocket(asyncio.DatagramProtocol):
    """Datagrams in order of arrival, at most `queue_packets` of them: on overflow the oldest is dropped and counted."""

    def __init__(self, *, queue_packets: int = QUEUE_PACKETS, now_ns: Callable[[], int] = time.monotonic_ns) -> None:
        self.received = 0
        self.dropped = 0
        self.errors = 0
        self._now_ns = now_ns
        self._queue: deque[Datagram] = deque()
        self._limit = queue_packets
        self._arrived = asyncio.Event()
        self._transport: asyncio.DatagramTransport | None = None

    @property
    def port(self) -> int:
        """The port listened on (useful after binding to port 0); 0 before it is open."""
        return 0 if self._transport is None else int(self._transport.get_extra_info("sockname")[1])

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.DatagramTransport, transport)  # CPython's own is no subclass of it

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        self.received += 1
        if len(self._queue) >= self._limit:
            self._queue.popleft()
            self.dropped += 1
        self._queue.append(Datagram(data, self._now_ns(), (addr[0], addr[1])))
        self._arrived.set()

    def error_received(self, exc: Exception) -> None:
        """ICMP errors and the like: nothing to do but to count them."""
        self.errors += 1

    async def take(self) -> list[Datagram]:
        """All that has come since the last call, oldest first; waits for the first."""
        while not self._queue:
            self._arrived.clear()
            await self._arrived.wait()
        taken = list(self._queue)
        self._queue.clear()
        return taken

    def close(self) -> None:
        if self._transport is not None:
            self._transport.close()


async def open_lidar(url: str, *, queue_packets: int = QUEUE_PACKETS) -> LidarSocket:
    """Listen for LiDAR packets at `udp://[HOST]:PORT`.

    Raises: LinkError: not such an address, or it cannot be bound.
    """
    host, port = parse_udp_url(url)
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        sock.setblocking(False)
        sock.bind((host, port))
        loop = asyncio.get_running_loop()
        _, protocol = await loop.create_datagram_endpoint(lambda: LidarSocket(queue_packets=queue_packets), sock=sock)
    except OSError as error:
        sock.close()
        raise LinkError(
            f"LiDAR {url}: cannot listen ({error.strerror or error}); is another program using it?"
        ) from error
    return protocol


def parse_udp_url(url: str) -> tuple[str, int]:
    """(host to listen on, port) of `udp://[HOST]:PORT`; all interfaces where the host is left out."""
    try:
        parts = urlsplit(url)
        port = DEFAULT_PORT if parts.port is None else parts.port
    except ValueError as error:
        raise LinkError(f"LiDAR {url}: expected udp://[HOST]:PORT with a port from 0 to 65535 ({error})") from None
    if parts.scheme != "udp" or parts.path not in ("", "/"):
        raise LinkError(f"LiDAR {url}: expected udp://[HOST]:PORT, for example udp://:{DEFAULT_PORT}")
    return parts.hostname or "0.0.0.0", port
