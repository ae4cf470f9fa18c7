"""A flight controller that keeps logs, made by pymavlink, on a real UDP port: heartbeats and the log protocol as PX4
serves it (LOG_REQUEST_LIST, LOG_REQUEST_DATA in pieces of 90 bytes), on a link that loses some of them."""

from __future__ import annotations

import socket
import time
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as m

from tests.stockpilot.background import Background
from tests.stockpilot.emulated import free_port

PIECE = 90
BURST = 50  # pieces between two looks at what was asked


class LogKeeper(Background):
    """A context. logs: content by number. lost_every: each so many pieces of data one is lost, once."""

    def __init__(self, logs: dict[int, bytes], *, lost_every: int = 0) -> None:
        super().__init__()
        self.logs, self.lost_every = logs, lost_every
        self.port = free_port()
        self.ground_url = f"udpin://127.0.0.1:{self.port}"
        self.lost = 0
        self._sent = 0
        self._mav: Any = m.MAVLink(None, srcSystem=1, srcComponent=1)
        self._reader: Any = m.MAVLink(None)
        self._reader.robust_parsing = True
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.02)

    def _close(self) -> None:
        self._socket.close()

    def _say(self, message: Any) -> None:
        try:
            self._socket.sendto(bytes(message.pack(self._mav)), ("127.0.0.1", self.port))
        except OSError:  # nobody listens yet
            return
        self._mav.seq = (self._mav.seq + 1) % 256

    def _run(self) -> None:
        due = 0.0
        while not self._stop.is_set():
            if time.monotonic() >= due:
                due = time.monotonic() + 0.5
                self._say(m.MAVLink_heartbeat_message(2, 12, 29, 4 << 16 | 3 << 24, 3, 3))
            try:
                data = self._socket.recv(65536)
            except OSError:
                continue
            for message in self._reader.parse_buffer(bytearray(data)) or []:
                self._answer(message)

    def _answer(self, message: Any) -> None:
        if message.get_type() == "LOG_REQUEST_LIST":
            for number, content in self.logs.items():
                utc = 1_795_000_000 + number
                self._say(m.MAVLink_log_entry_message(number, len(self.logs), max(self.logs), utc, len(content)))
        elif message.get_type() == "LOG_REQUEST_DATA" and message.id in self.logs:
            self._send_data(message.id, message.ofs, message.count)

    def _send_data(self, number: int, begin: int, count: int) -> None:
        content = self.logs[number][: begin + count]
        for n, at in enumerate(range(begin, len(content), PIECE)):
            piece = content[at : at + PIECE]
            self._sent += 1
            if self.lost_every and self._sent % self.lost_every == 0:
                self.lost += 1
                continue
            self._say(m.MAVLink_log_data_message(number, at, len(piece), list(piece.ljust(PIECE, b"\0"))))
            if n % BURST == BURST - 1:
                time.sleep(0.005)  # as fast as a link carries it, not as a buffer overflows
