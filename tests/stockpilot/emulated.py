"""An emulated flight controller standing on the ground, on real UDP ports and in real time: no world around it."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable

import numpy as np

from simbridge.autopilot import Autopilot
from simbridge.sensors import BaroSample, ImuSample
from simbridge.sitl.parameters import PX4_VISION
from tests.stockpilot.background import Background

STEP_NS = 4_000_000
MAX_BEHIND_S = 0.5


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class Standing(Background):
    """A context: inside it, the autopilot sends to `ground_url` as PX4 does to 14550. alter: what becomes of each frame
    on its way to the ground; None: lost."""

    def __init__(self, **params: float) -> None:
        super().__init__()
        self.autopilot = Autopilot({**PX4_VISION, **params})
        self.port = free_port()
        self.ground_url = f"udpin://127.0.0.1:{self.port}"
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        self.alter: Callable[[bytes], bytes | None] = lambda frame: frame

    def _close(self) -> None:
        self._socket.close()

    def _run(self) -> None:
        rest = ImuSample(accel_frd_mps2=np.array([0.0, 0.0, -9.81]), gyro_frd_radps=np.zeros(3))
        baro = BaroSample(pressure_hpa=1013.25, pressure_altitude_m=0.0, temperature_c=20.0)
        t_ns, due = 1_000_000_000, time.monotonic()
        while not self._stop.is_set():
            t_ns += STEP_NS
            self.autopilot.step(t_ns, rest, baro if t_ns % (5 * STEP_NS) == 0 else None, 0.1)
            self._carry(t_ns)
            due += STEP_NS * 1e-9
            wait = due - time.monotonic()
            if wait > 0:
                time.sleep(wait)
            elif wait < -MAX_BEHIND_S:
                due = time.monotonic()  # a busy machine: go on from here, without a rush

    def _carry(self, t_ns: int) -> None:
        while True:
            try:
                data = self._socket.recv(65536)
            except OSError:  # nothing there, or nobody listens yet
                break
            self.autopilot.receive("gcs", data, t_ns)
        for link, frame in self.autopilot.take_output():
            altered = self.alter(frame) if link == "gcs" else None
            if altered is not None:
                try:
                    self._socket.sendto(altered, ("127.0.0.1", self.port))
                except OSError:
                    return
