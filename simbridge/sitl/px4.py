"""Real PX4 as the flight controller of a simulation: the TCP end of its simulator link. An edge: one socket, wall time.

PX4 is the client and tries until somebody accepts. Until its motor output runs (17 to 115 sensor frames) it does not
answer: those frames are paced by wall time. From the first answer on each step waits for its own. When PX4 goes away
(a restart in flight) steps go on at wall time with motors off until it is back.
"""

from __future__ import annotations

import contextlib
import select
import socket
import time
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from simbridge.sensors import BaroSample, ImuSample
from simbridge.sitl import SitlError
from simbridge.sitl.hil import MOTORS, ActuatorControls, HilLink
from simbridge.sitl.truth import PoseSource, magnetic_field_frd_gauss

Array = NDArray[np.float64]

SIMULATOR_PORT = 4560
MAG_NOISE_GAUSS = 0.0005  # without noise PX4 takes the sensor for stale (VEHICLE measurements)
RECEIVE_BYTES = 65536
BOOT_NS = 1_000_000_000  # what a clock begins at: PX4 reads 0 as not set


class Running(Protocol):
    """A process of ours: says how it ended."""

    def check(self) -> None:
        """Raise SitlError with the end of its log if it has ended."""


class Px4Sitl:
    """Steps a simulation in lockstep with PX4. Its MAVLink is not here: PX4 opens its own sockets."""

    step_ns = 4_000_000

    def __init__(
        self,
        *,
        host: str = "127.0.0.1",
        port: int = SIMULATOR_PORT,
        connect_timeout_s: float = 60.0,
        answer_timeout_s: float = 10.0,
        seed: int = 0,
    ) -> None:
        """Listen. Raises: SitlError: the port is taken."""
        self._connect_timeout_s, self._answer_timeout_s = connect_timeout_s, answer_timeout_s
        self.process: Running | None = None  # ours, if we started it: asked when there is silence
        self._truth: PoseSource | None = None
        self._noise = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed, spawn_key=(4560,))))
        self._connection: socket.socket | None = None
        self._link = HilLink()
        self._newest: ActuatorControls | None = None
        self._lost_s: float | None = None  # wall time when PX4 went away
        self._clock_ahead_ns: int | None = None  # simulated time minus PX4's: after a restart its clock begins anew
        self.connections = 0
        try:
            self._listener = socket.create_server((host, port), backlog=1)
        except OSError as e:
            raise SitlError(
                f"cannot listen for PX4 on TCP {host}:{port}: {e.strerror}; is another simulation running?"
            ) from e
        self.port = self._listener.getsockname()[1]

    def attach(self, truth: PoseSource) -> None:
        """Where the magnetic field's direction comes from; without it the vehicle has no magnetometer."""
        self._truth = truth

    @property
    def is_lockstep(self) -> bool:
        """Whether PX4 answers each step by now."""
        return self._newest is not None

    @property
    def is_armed(self) -> bool:
        return self._newest is not None and self._newest.is_armed

    def step(self, t_ns: int, imu: ImuSample, baro: BaroSample | None, rangefinder_m: float | None) -> Array:
        """Send the sensors of one step and return the motor commands for the next: (4,) 0..1, PX4's order.

        Raises: SitlError: PX4 never connected, ended, or fell silent for answer_timeout_s.
        """
        if self._connection is None and not self._accept():
            return np.zeros(MOTORS)
        mag = None
        if self._truth is not None:
            mag = magnetic_field_frd_gauss(self._truth(), self._noise.normal(0.0, MAG_NOISE_GAUSS, 3))
        if self._clock_ahead_ns is None:
            self._clock_ahead_ns = t_ns - BOOT_NS if self.connections > 1 else 0
        t_px4_ns = t_ns - self._clock_ahead_ns
        try:
            self._send(self._link.sensor_frames(t_px4_ns, imu, baro, rangefinder_m, mag))
            self._wait_for_answer(t_px4_ns // 1000)
        except OSError:
            self._disconnect()
        return np.zeros(MOTORS) if self._newest is None else self._newest.motors

    def close(self) -> None:
        self._disconnect()
        self._listener.close()

    def _accept(self) -> bool:
        """Wait for PX4: long the first time; for one step's time once it has been here, since time must go on then."""
        now = time.monotonic()
        deadline = now + (self._connect_timeout_s if self._lost_s is None else self.step_ns * 1e-9)
        while not select.select([self._listener], [], [], min(0.2, max(0.0, deadline - time.monotonic())))[0]:
            if self.process is not None:
                self.process.check()
            if time.monotonic() >= deadline:
                self._give_up_after(now if self._lost_s is None else self._lost_s)
                return False
        connection, _ = self._listener.accept()
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setblocking(False)
        self._connection, self._lost_s = connection, None
        self._link, self._newest, self._clock_ahead_ns = HilLink(), None, None
        self.connections += 1
        return True

    def _give_up_after(self, since_s: float) -> None:
        if time.monotonic() - since_s >= self._connect_timeout_s:
            raise SitlError(
                f"PX4 did not connect to TCP port {self.port} within {self._connect_timeout_s:g} s; start PX4 with "
                "PX4_SIM_MODEL=none_iris, or give --autopilot-binary"
            )

    def _send(self, data: bytes) -> None:
        assert self._connection is not None
        while data:
            try:
                data = data[self._connection.send(data) :]
            except BlockingIOError:
                if not select.select([], [self._connection], [], self._answer_timeout_s)[1]:
                    raise SitlError(f"PX4 has not read its sensors for {self._answer_timeout_s:g} s") from None

    def _wait_for_answer(self, t_us: int) -> None:
        """Read until the answer to the frame of t_us. While PX4 boots: for one step's time at most."""
        is_booting = self._newest is None
        deadline = time.monotonic() + (self.step_ns * 1e-9 if is_booting else self._answer_timeout_s)
        while self._newest is None or self._newest.t_us < t_us:
            assert self._connection is not None
            readable = select.select([self._connection], [], [], max(0.0, deadline - time.monotonic()))[0]
            if readable:
                data = self._connection.recv(RECEIVE_BYTES)
                if not data:
                    raise ConnectionResetError
                for controls in self._link.receive(data):
                    self._newest = controls
            elif time.monotonic() >= deadline:
                if is_booting:
                    return
                if self.process is not None:
                    self.process.check()
                raise SitlError(
                    f"PX4 did not answer the sensors of t = {t_us / 1e6:.3f} s within {self._answer_timeout_s:g} s: it "
                    "hangs, or was not built for lockstep"
                )

    def _disconnect(self) -> None:
        self._newest = None
        if self._connection is not None:
            self._lost_s = time.monotonic()
            with contextlib.suppress(OSError):
                self._connection.close()
            self._connection = None
