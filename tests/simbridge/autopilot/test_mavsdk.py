"""MAVSDK, a client that neither side of this project wrote, flies the emulated autopilot over UDP."""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress

import pytest
from mavsdk.asyncio import Configuration, Mavsdk
from mavsdk.asyncio.plugins.action import ActionAsync, ActionError
from mavsdk.asyncio.plugins.offboard import OffboardAsync, OffboardError, VelocityNedYaw
from mavsdk.asyncio.plugins.param import ParamAsync
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.logging import log_subscribe

from tests.simbridge.autopilot.rig import Rig

SPEED = 3.0  # times real time: MAVSDK's own time-outs run on the wall clock


class Pump:
    """Carries the ground station's link over UDP on this host and steps the vehicle at SPEED."""

    def __init__(self, rig: Rig, port: int) -> None:
        self.rig = rig
        self._to = ("127.0.0.1", port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.setblocking(False)
        rig.on_output = self._send

    def _send(self, link: str, frame: bytes) -> None:
        if link == "gcs":
            self._socket.sendto(frame, self._to)

    async def run(self) -> None:
        """Until cancelled."""
        begin, from_s = time.monotonic(), self.rig.t_s
        try:
            while True:
                for _ in range(25):  # a busy machine falls behind rather than starve the client
                    if self.rig.t_s - from_s >= (time.monotonic() - begin) * SPEED:
                        break
                    with suppress(BlockingIOError):
                        while True:
                            self.rig.autopilot.receive("gcs", self._socket.recv(65536), self.rig.t_ns)
                    self.rig.step()
                await asyncio.sleep(0.002)
        finally:
            self._socket.close()


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@asynccontextmanager
async def connected() -> AsyncIterator[tuple[Rig, object]]:
    log_subscribe(lambda *_: True)
    rig, port = Rig(links=("offboard", "gcs")), _free_port()
    async with Mavsdk(Configuration.create_manual(245, 190, True)) as mavsdk:
        await mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
        pump = asyncio.create_task(Pump(rig, port).run())
        try:
            system = await mavsdk.first_autopilot(timeout_s=10.0)
            assert system is not None
            yield rig, system
        finally:
            pump.cancel()
            await asyncio.gather(pump, return_exceptions=True)


async def _until(condition: object, timeout_s: float = 15.0) -> None:
    end = time.monotonic() + timeout_s
    while not condition():  # type: ignore[operator]
        assert time.monotonic() < end
        await asyncio.sleep(0.05)


@pytest.mark.timeout(90)
async def test_mavsdk_reads_arms_takes_off_flies_offboard_and_lands() -> None:
    """AUTOPILOTS.md: "is the independent client that simbridge is tested with"."""
    async with connected() as (rig, system):
        action, param = ActionAsync(system), ParamAsync(system)
        telemetry, offboard = TelemetryAsync(system), OffboardAsync(system)

        assert await param.get_param_int("EKF2_EV_CTRL") == 15
        assert await param.get_param_float("MIS_TAKEOFF_ALT") == 2.5
        await param.set_param_float("MIS_TAKEOFF_ALT", 2.0)
        assert rig.autopilot.params.real("MIS_TAKEOFF_ALT") == 2.0
        everything = await param.get_all_params()
        assert len(everything.int_params) + len(everything.float_params) >= 150

        async for health in telemetry.subscribe_health():
            # its position flags stay false with real PX4 too: they want GPS in SYS_STATUS, which names none (recorded)
            if health.is_armable and health.is_home_position_ok:
                break

        await action.arm()
        assert rig.autopilot.commander.is_armed
        await action.takeoff()
        await _until(lambda: rig.position_ned()[2] < -1.7)
        await _until(lambda: rig.autopilot.commander.mode.name == "LOITER")

        with pytest.raises(OffboardError):
            await offboard.start()  # no setpoint yet: MAVSDK itself refuses
        await offboard.set_velocity_ned(VelocityNedYaw(0.5, 0.0, 0.0, 0.0))
        await offboard.start()
        assert await offboard.is_active()
        start = rig.position_ned()[0]
        await _until(lambda: rig.position_ned()[0] - start > 1.0)
        with pytest.raises(ActionError):
            await action.disarm()  # in the air
        await action.land()
        async for armed in telemetry.subscribe_armed():
            if not armed:
                break
        assert abs(rig.position_ned()[2]) < 0.1
