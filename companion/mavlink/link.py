"""The edge to the autopilot: UDP, TCP or a serial port. Bytes and addresses only; what they mean is the session's.

udpin://0.0.0.0:14540    wait for the autopilot's datagrams, answer to where they come from
udpout://10.0.0.2:14550  send there first
tcpin://0.0.0.0:5760     wait for one connection      tcpout://host:5760  connect
serial:///dev/ttyAMA0:921600
"""

from __future__ import annotations

import asyncio
import os
import termios
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from urllib.parse import urlsplit

from companion.errors import LinkError

Address = tuple[str, int]
_QUEUE = 1024  # datagrams; when nobody takes them, the oldest go (FAULTS 7)
_READ = 4096


@dataclass(frozen=True, slots=True)
class LinkUrl:
    """A link's address, checked."""

    scheme: str
    host: str
    port: int

    @classmethod
    def parse(cls, url: str) -> LinkUrl:
        """Raises LinkError: the text is no link, with what is allowed."""
        allowed = "allowed: udpin://host:port, udpout://host:port, tcpin://, tcpout://, serial:///dev/ttyX:baud"
        try:
            parts = urlsplit(url)
            if parts.scheme == "serial":
                device, _, baud = parts.path.rpartition(":")
                if device and baud.isdigit():
                    return cls("serial", device, int(baud))
            elif parts.scheme in ("udpin", "udpout", "tcpin", "tcpout") and parts.hostname and parts.port:
                return cls(parts.scheme, parts.hostname, parts.port)
        except ValueError as error:
            raise LinkError(f"link {url!r}: {error}; {allowed}") from None
        raise LinkError(f"link {url!r} is not understood; {allowed}")


# Bytes as they came, monotonic time of arrival in ns, and the sender (None where the link has only one end).
Packet = tuple[bytes, int, Address | None]


class MavlinkLink:
    """An open link. `peer` is where `send` goes; it is the first that was heard, unless set."""

    def __init__(self, url: LinkUrl, now_ns: Callable[[], int]) -> None:
        self.url = url
        self.peer: Address | None = None
        self.shed = 0
        self.send_errors = 0
        self.is_open = True
        self._now_ns = now_ns
        self._queue: deque[Packet] = deque()
        self._arrived = asyncio.Event()
        self._write: Callable[[bytes], None] = self._write_nowhere
        self._close: Callable[[], None] = lambda: None

    async def take(self) -> list[Packet]:
        """All that has come, as soon as there is any. Raises LinkError: the other end has closed."""
        while not self._queue:
            if not self.is_open:
                raise LinkError(f"link {self.url.scheme}://{self.url.host}:{self.url.port} was closed by the other end")
            self._arrived.clear()
            await self._arrived.wait()
        packets = list(self._queue)
        self._queue.clear()
        return packets

    def send(self, data: bytes) -> None:
        """Send, or count that it could not be sent; never blocks, never raises."""
        try:
            self._write(data)
        except OSError:
            self.send_errors += 1

    def close(self) -> None:
        self.is_open = False
        self._close()
        self._arrived.set()

    def _write_nowhere(self, data: bytes) -> None:
        raise OSError("nobody is there yet")

    def _arrive(self, data: bytes, source: Address | None) -> None:
        if len(self._queue) >= _QUEUE:
            self._queue.popleft()
            self.shed += 1
        if self.peer is None:
            self.peer = source
        self._queue.append((data, self._now_ns(), source))
        self._arrived.set()

    def _end(self) -> None:
        self.is_open = False
        self._arrived.set()


async def open_link(url: str, *, now_ns: Callable[[], int] = time.monotonic_ns) -> MavlinkLink:
    """Open a link. Raises LinkError: address, reason, how to mend it."""
    address = LinkUrl.parse(url)
    link = MavlinkLink(address, now_ns)
    opener = {"udpin": _open_udp, "udpout": _open_udp, "tcpin": _open_tcp_server, "tcpout": _open_tcp_client}
    try:
        await opener.get(address.scheme, _open_serial)(link)
    except (OSError, termios.error) as error:
        raise LinkError(f"link {url}: cannot be opened: {error}. {_advice(error)}") from None
    return link


def _advice(error: Exception) -> str:
    code = getattr(error, "errno", None)
    if code == 98:
        return "Another program listens there: stop it, or choose another port"
    if code == 13:
        return "No permission: is the user in the group dialout?"
    if code == 111:
        return "Nobody listens there: start the autopilot first"
    return "Check the address"


class _Datagrams(asyncio.DatagramProtocol):
    def __init__(self, link: MavlinkLink) -> None:
        self._link = link

    def datagram_received(self, data: bytes, addr: tuple[str | object, int]) -> None:
        self._link._arrive(data, (str(addr[0]), addr[1]))

    def error_received(self, exc: Exception) -> None:
        self._link.send_errors += 1  # e.g. port unreachable: the autopilot is not up yet


async def _open_udp(link: MavlinkLink) -> None:
    here = (link.url.host, link.url.port)
    is_server = link.url.scheme == "udpin"
    transport, _ = await asyncio.get_running_loop().create_datagram_endpoint(
        lambda: _Datagrams(link), local_addr=here if is_server else ("0.0.0.0", 0)
    )
    if not is_server:
        link.peer = here

    def write(data: bytes) -> None:
        if link.peer is None:
            raise OSError("nobody has been heard yet")
        transport.sendto(data, link.peer)

    link._write, link._close = write, transport.close


class _Stream(asyncio.Protocol):
    def __init__(self, link: MavlinkLink) -> None:
        self._link = link

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        link = self._link
        if link._write != link._write_nowhere:
            transport.close()  # one at a time
            return
        link.is_open = True
        link._write = transport.write

    def data_received(self, data: bytes) -> None:
        self._link._arrive(data, None)

    def connection_lost(self, exc: Exception | None) -> None:
        self._link._write = self._link._write_nowhere
        if self._link.url.scheme == "tcpout":
            self._link._end()


async def _open_tcp_server(link: MavlinkLink) -> None:
    server = await asyncio.get_running_loop().create_server(lambda: _Stream(link), link.url.host, link.url.port)
    link._close = server.close


async def _open_tcp_client(link: MavlinkLink) -> None:
    transport, _ = await asyncio.get_running_loop().create_connection(
        lambda: _Stream(link), link.url.host, link.url.port
    )
    link._close = transport.close


async def _open_serial(link: MavlinkLink) -> None:
    device, baud = link.url.host, link.url.port
    speed = getattr(termios, f"B{baud}", None)
    if speed is None:
        raise LinkError(f"link {device}: baud rate {baud} is unknown; usual are 57600, 115200, 921600")
    handle = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        _set_raw(handle, speed)
    except termios.error:
        os.close(handle)
        raise
    loop = asyncio.get_running_loop()

    def read() -> None:
        try:
            data = os.read(handle, _READ)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            link._arrive(data, None)
        else:
            loop.remove_reader(handle)
            link._end()

    def write(data: bytes) -> None:
        if os.write(handle, data) != len(data):
            link.send_errors += 1  # the port's buffer is full: the rest is dropped, the checksum will tell

    def close() -> None:
        loop.remove_reader(handle)
        os.close(handle)

    loop.add_reader(handle, read)
    link._write, link._close = write, close


def _set_raw(handle: int, speed: int) -> None:
    """8N1, no flow control, no translation."""
    attributes = termios.tcgetattr(handle)
    attributes[0] = attributes[1] = attributes[3] = 0
    attributes[2] = termios.CS8 | termios.CREAD | termios.CLOCAL
    attributes[4] = attributes[5] = speed
    attributes[6][termios.VMIN], attributes[6][termios.VTIME] = 1, 0
    termios.tcsetattr(handle, termios.TCSANOW, attributes)
