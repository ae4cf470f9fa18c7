"""Real ArduCopter as the flight controller of a simulation: the UDP end of its JSON physics. An edge: one socket.

ArduCopter asks, we answer; it asks at 1200 Hz first and comes down by 1 Hz a frame to the rate it was started with.
Those first frames are answered with the vehicle at rest, each 1/rate after the one before, before the simulation's own
time moves; from then on each step answers one request.
"""

from __future__ import annotations

import contextlib
import socket
import time

import numpy as np
from numpy.typing import NDArray

from simbridge.sensors import BaroSample, ImuSample
from simbridge.sitl import SitlError
from simbridge.sitl.json_physics import MOTORS, JsonPhysics, PhysicsState, ServoPacket
from simbridge.sitl.px4 import Running
from simbridge.sitl.rates import HeldRange
from simbridge.sitl.truth import WORLD_TO_NED, Pose, PoseSource, q_ned_frd_wxyz

Array = NDArray[np.float64]

PHYSICS_PORT = 9002
STEADY_FRAMES = 20  # the same rate so many times: it falls no more
SILENCE_S = 2.5  # ArduCopter asks again after 1.1 s without an answer
LOST_ANSWER_S = 0.5
RECEIVE_BYTES = 2048


class ArduPilotSitl:
    """Steps a simulation in lockstep with ArduCopter, 800 times a second (arming wants more than 720)."""

    step_ns = 1_250_000

    def __init__(
        self,
        *,
        host: str = "127.0.0.1",
        port: int = PHYSICS_PORT,
        connect_timeout_s: float = 60.0,
    ) -> None:
        """Listen. Raises: SitlError: the port is taken."""
        self._connect_timeout_s = connect_timeout_s
        self.process: Running | None = None  # ours, if we started it: asked when there is silence
        self._truth: PoseSource | None = None
        self._start_m: Array | None = None
        self._physics = JsonPhysics()
        self._rangefinder = HeldRange()
        self._request: ServoPacket | None = None
        self._peer: tuple[str, int] | None = None
        self._was_connected = False
        self._replied_s = 0.0  # wall time
        self._lost_s: float | None = None  # wall time when ArduCopter fell silent
        self.restarts = 0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host, port))
        except OSError as e:
            self._socket.close()
            raise SitlError(
                f"cannot listen for ArduCopter on UDP {host}:{port}: {e.strerror}; is another simulation running?"
            ) from e
        self.port = self._socket.getsockname()[1]

    def attach(self, truth: PoseSource) -> None:
        """Where the pose comes from that the protocol asks for. Must be called before the first step."""
        self._truth = truth

    def step(self, t_ns: int, imu: ImuSample, baro: BaroSample | None, rangefinder_m: float | None) -> Array:
        """Answer one request and return the motor commands of the next: (4,) 0..1, ArduPilot's X order.

        baro is not used: the protocol has none, ArduPilot makes its own from the height.
        Raises: SitlError: ArduCopter never spoke, or has ended or been silent for connect_timeout_s.
        """
        state = self._state(imu, self._rangefinder.update(t_ns, rangefinder_m))
        if self._request is None and not self._connect(state):
            return np.zeros(MOTORS)
        self._reply(self._physics.reply(state, self.step_ns * 1e-9))
        self._request = self._next_request()
        return np.zeros(MOTORS) if self._request is None else self._request.controls()

    def close(self) -> None:
        self._socket.close()

    def _state(self, imu: ImuSample, rangefinder_m: float | None) -> PhysicsState:
        if self._truth is None:
            raise SitlError("ArduPilotSitl: attach() the pose before the first step")
        pose: Pose = self._truth()
        if self._start_m is None:
            self._start_m = pose.position_world_m.copy()
        return PhysicsState(
            gyro_radps=imu.gyro_frd_radps,
            accel_mps2=imu.accel_frd_mps2,
            position_m=(pose.position_world_m - self._start_m) * WORLD_TO_NED,
            q_ned_frd_wxyz=q_ned_frd_wxyz(pose.q_world_body_wxyz),
            velocity_mps=pose.velocity_world_mps * WORLD_TO_NED,
            rangefinder_m=rangefinder_m,
        )

    def _connect(self, state: PhysicsState) -> bool:
        """Wait for the first request and answer until its rate has settled, the vehicle standing still.

        After a restart in flight nothing stands still: steps go on at wall time, motors off, until it asks again.
        """
        if self._was_connected:
            request = self._receive(self.step_ns * 1e-9)
            if request is None:
                self._check_silence()
            else:
                self._take(request)
            return request is not None
        self._request = self._first_request()
        self._was_connected = True
        steady = 0
        while self._request.rate_hz > 1e9 / self.step_ns and steady < STEADY_FRAMES:
            before = self._request.rate_hz
            self._reply(self._physics.reply(state, 1.0 / before))
            self._request = self._next_request()
            if self._request is None:
                return False
            steady = steady + 1 if self._request.rate_hz == before else 0
        return True

    def _first_request(self) -> ServoPacket:
        deadline = time.monotonic() + self._connect_timeout_s
        while time.monotonic() < deadline:
            request = self._receive(0.2)
            if request is not None:
                return request
            if self.process is not None:
                self.process.check()
        raise SitlError(
            f"ArduCopter did not speak to UDP port {self.port} within {self._connect_timeout_s:g} s; start it with "
            "--model JSON:127.0.0.1, or give --autopilot-binary"
        )

    def _next_request(self) -> ServoPacket | None:
        """The next new request. None: silence, it has ended or restarts.

        One that was answered before is answered again where the answer must have been lost; copies that ArduCopter sent
        while we were held up come right after the answer and are passed over, or each would add a frame of delay.
        """
        deadline = time.monotonic() + SILENCE_S
        while (request := self._receive(deadline - time.monotonic())) is not None:
            if not request.is_repeat:
                return self._take(request)
            if time.monotonic() - self._replied_s > LOST_ANSWER_S:
                self._reply(self._physics.repeated_reply())
        self._lost_s = time.monotonic()
        return None

    def _take(self, request: ServoPacket) -> ServoPacket:
        self.restarts += request.is_restart
        self._request, self._lost_s = request, None
        return request

    def _check_silence(self) -> None:
        if self.process is not None:
            self.process.check()
        if self._lost_s is not None and time.monotonic() - self._lost_s > self._connect_timeout_s:
            raise SitlError(f"ArduCopter has not asked for physics for {self._connect_timeout_s:g} s: it has ended")

    def _receive(self, timeout_s: float) -> ServoPacket | None:
        """The next request; None after timeout_s without one."""
        deadline = time.monotonic() + timeout_s
        while (left_s := deadline - time.monotonic()) > 0:
            self._socket.settimeout(left_s)
            try:
                data, self._peer = self._socket.recvfrom(RECEIVE_BYTES)
            except TimeoutError:
                return None
            except OSError:  # an answer bounced: ArduCopter was just ending
                continue
            request = self._physics.receive(data)
            if request is not None:
                return request
        return None

    def _reply(self, line: bytes) -> None:
        assert self._peer is not None
        self._replied_s = time.monotonic()
        with contextlib.suppress(OSError):  # it has ended: the wait for its next request says so
            self._socket.sendto(line, self._peer)
