"""The emulated flight controller: PX4 1.18 as seen from its sensors, its motors and its MAVLink links.

It flies on what the companion sends, never on ground truth. One object, no clock, no sockets: the simulation steps it at
250 Hz and carries its bytes.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from simbridge.autopilot import control_kernels, kernels
from simbridge.autopilot.battery import Battery
from simbridge.autopilot.commander import Commander
from simbridge.autopilot.controller import Controller, Takeoff
from simbridge.autopilot.estimator import Estimator
from simbridge.autopilot.events import Event
from simbridge.autopilot.inbox import Inbox
from simbridge.autopilot.landing import LandDetector
from simbridge.autopilot.missions import Missions
from simbridge.autopilot.modes import Mode
from simbridge.autopilot.parameter_service import ParameterService
from simbridge.autopilot.params import ParamStore
from simbridge.autopilot.server import Link, ground_link, onboard_link
from simbridge.autopilot.tasks import Tasks
from simbridge.autopilot.wire import Encoder
from simbridge.sensors import BaroSample, ImuSample

STEP_S = 0.004
DETECT_NS = 20_000_000
REST_NS = 5_000_000_000  # disarmed this long, it counts as standing still (recorded: not yet 2.5 s after disarming)
RANGE_STALE_NS = 500_000_000
REBOOT_NS = 3_000_000_000  # silence while it starts again
BOOT_PARAMS_NS = 250_000_000
IN_AIR, ON_GROUND, LANDING, TAKING_OFF = 2, 1, 4, 3  # MAV_LANDED_STATE
_UNIX_EPOCH_US = 1_795_316_000_000_000  # a label only: what SYSTEM_TIME calls the moment of boot


@functools.cache
def warm_up() -> None:
    """Compile, or load from the cache, every compiled loop, so that none does it in flight."""
    x, P, o, acc = np.zeros(16), np.eye(15), np.zeros(25), np.zeros(8)
    x[0] = o[0] = 1.0
    ring_imu, ring_out = np.zeros((kernels.RING, 7)), np.zeros((kernels.RING, 10))
    ring_imu[:, 6] = 0.008
    ring_out[:, 0] = 1.0
    rest, still, ones = np.array([0.0, 0.0, -9.81]), np.zeros(3), np.ones(6)
    for _ in range(2):
        kernels.imu_step(x, P, o, acc, ring_imu, ring_out, 0, rest, still, STEP_S, ones)
    kernels.fuse_state(x, P, 3, 0.0, 1.0)
    for count in (1, 2, 3):
        kernels.gate_and_fuse(x, P, 3, (0.0,) * count, (1.0,) * count, 1.0, True)
    kernels.fuse_yaw(x, P, 0.0, kernels.yaw_variance(x, P))
    kernels.reset_block(P, 6, 1, 1.0)
    kernels.shift_output(o, ring_out, np.zeros(6))
    kernels.turn_output(o, ring_out, kernels.yaw_of(x) + kernels.yaw_of(o))
    kernels.turn_ned(x[0:4], 0.0, 0.0, 0.0)
    kernels.to_ned(x, 0.0, 0.0, 0.0)
    memory, gains = np.zeros(control_kernels.MEMORY), np.ones(control_kernels.GAINS)
    memory[control_kernels.Q_SP] = memory[control_kernels.HOVER] = 1.0
    control_kernels.control_step(o, np.full(11, np.nan), memory, gains, np.zeros(4), STEP_S, 2 * STEP_S)


class Autopilot:
    """PX4, emulated. Links are "offboard" (UDP 14540, mode Onboard) and "gcs" (14550, mode Normal)."""

    def __init__(self, params: Mapping[str, float], seed: int = 0, links: Sequence[str] = ("offboard", "gcs")) -> None:
        """params: what the vehicle sets over PX4's defaults. seed: kept for the interface; nothing here is random.

        Raises: ValueError: an unknown parameter or link.
        """
        unknown = set(links) - {"offboard", "gcs"}
        if unknown:
            raise ValueError(f"links: expected offboard and gcs, got {sorted(unknown)}")
        warm_up()
        self._link_names = tuple(links)
        self.params = ParamStore(params)
        self.seed = seed
        self._zero_ns: int | None = None
        self._silent_until_ns = -1
        self._build()

    def _build(self) -> None:
        """What a boot makes anew; parameters stay."""
        params = self.params
        self.now_ns = self.boot_ns = 0
        self.unix_us = _UNIX_EPOCH_US
        self.system = params.integer("MAV_SYS_ID")
        self.ekf = Estimator(params)
        self.controller = Controller(params)
        self.takeoff = Takeoff(params)
        self.land = LandDetector(params)
        self.battery = Battery(params)
        self.commander = Commander(params, self.ekf, self.land, self.battery, self.tell)
        self.tasks = Tasks(params, self.ekf, self.controller)
        self.missions = Missions()
        self.links: dict[str, Link] = {}
        self.parameters = ParameterService(params, [])
        self._inbox = Inbox(self)
        self.imu: ImuSample | None = None
        self.baro: BaroSample | None = None
        self.distance_bottom_m: float | None = None
        self._range_ns = -(10**18)
        self.home_set = False
        self.home_us = 0
        self._mode_flown: Mode | None = None
        self._down_mps = math.nan
        self._next_detect_ns = self._rest_ns = 0
        self._told_boot_params = False
        self._event_sequence = 0
        self._reboot_wanted = False
        self._out: list[tuple[str, bytes]] = []

    # what the simulation calls

    def step(
        self, t_ns: int, imu: ImuSample, baro: BaroSample | None, rangefinder_m: float | None
    ) -> NDArray[np.float64]:
        """4 ms of flight. Returns the motor commands, (4,) in 0..1, front right, rear left, front left, rear right."""
        if self._zero_ns is None:
            self._start(t_ns)
        if t_ns < self._silent_until_ns:
            return self.controller.motors
        self.now_ns, self.boot_ns = t_ns, t_ns - (self._zero_ns or 0)
        if self.imu is not None and not math.isfinite(
            sum(imu.accel_frd_mps2.tolist()) + sum(imu.gyro_frd_radps.tolist())
        ):
            imu = self.imu  # a broken sample is not taken
        self.imu = imu
        if baro is not None:
            self.baro = baro
            self.ekf.add_baro(self.boot_ns, baro)
        self._take_range(rangefinder_m)
        moved = self.ekf.step(self.boot_ns, imu, STEP_S)
        if self.commander.step(self.boot_ns):
            self.battery.step(0.1, self.commander.is_armed)
            self._keep_home()
        self._fly(moved)
        self._serve()
        return self.controller.motors

    def receive(self, link: str, data: bytes, t_ns: int) -> None:
        """Bytes that arrived on a link. Never raises: what is not a whole, known message is dropped and counted."""
        if self._zero_ns is None or t_ns < self._silent_until_ns or link not in self.links:
            return
        self.boot_ns = max(self.boot_ns, t_ns - self._zero_ns)
        target = self.links[link]
        for frame in target.decoder.receive(data):
            self._inbox.take(frame, target, self.boot_ns)
        self._collect()

    def take_output(self) -> list[tuple[str, bytes]]:
        """Frames to send since the last call: (link, bytes), one frame each, in order."""
        out, self._out = self._out, []
        return out

    def reboot(self, t_ns: int) -> None:
        """Power cycle: motors stop, silence, then everything but the parameters starts again from time 0."""
        self._build()
        self._zero_ns = None
        self._silent_until_ns = t_ns + REBOOT_NS

    def request_reboot(self) -> None:
        """PREFLIGHT_REBOOT_SHUTDOWN: after the answer has left."""
        self._reboot_wanted = True

    def tell(self, severity: int, text: str, event: Event | None = None) -> None:
        """A STATUSTEXT for every link with a ground station, and an EVENT for every link."""
        if event is not None:
            self._event_sequence = (self._event_sequence + 1) & 0xFFFF
        for link in self.links.values():
            link.text(severity, text, self.boot_ns)
            if event is not None:
                link.event(event, self.boot_ns // 1_000_000, self._event_sequence)

    @property
    def landed_state(self) -> int:
        """EXTENDED_SYS_STATE: LANDING only in AUTO.LAND; DESCEND stays IN_AIR."""
        if self.land.is_landed:
            return ON_GROUND
        mode = self.commander.mode
        if mode is Mode.LAND:
            return LANDING
        return TAKING_OFF if mode is Mode.TAKEOFF else IN_AIR

    # parts of a step

    def _start(self, t_ns: int) -> None:
        """First sample: the clock since boot follows the simulation's, from its first second on; a reboot starts at 0."""
        rebooted = self._silent_until_ns >= 0
        if rebooted and t_ns < self._silent_until_ns:
            return
        self._zero_ns = t_ns if rebooted else 0
        start = t_ns - self._zero_ns
        makers = {"offboard": onboard_link, "gcs": ground_link}
        for name in self._link_names:
            self.links[name] = makers[name](Encoder(self.system, 1), start)
        self.parameters = ParameterService(self.params, list(self.links.values()))
        self._boot_params_ns = start + BOOT_PARAMS_NS

    def _take_range(self, rangefinder_m: float | None) -> None:
        if rangefinder_m is not None and math.isfinite(rangefinder_m) and rangefinder_m > 0.0:
            self.distance_bottom_m, self._range_ns = rangefinder_m, self.boot_ns
        elif self.boot_ns - self._range_ns > RANGE_STALE_NS:
            self.distance_bottom_m = None

    def _fly(self, moved: bool) -> None:
        commander, controller = self.commander, self.controller
        if not commander.is_armed:
            controller.stop()
            self._mode_flown = None
            if moved:
                self.takeoff.update(self.boot_ns, 0.008, False, True, 0.0)
            self._detect(math.nan)
            return
        if moved:
            self._set_goals(0.008)
        self._detect(self._down_mps)
        if self.takeoff.state < Takeoff.RAMP:
            controller.idle()
            return
        controller.step(self.ekf.o, STEP_S, 0.008 if moved else 0.0)
        if moved and self.takeoff.state == Takeoff.FLIGHT and not self.land.has_contact:
            controller.learn_hover(float(self.ekf.o[15]), 0.008)

    def _set_goals(self, dt: float) -> None:
        mode = self.commander.mode
        if mode is not self._mode_flown:
            self._mode_flown = mode
            self.tasks.enter(mode)
        self._down_mps = self.tasks.update(mode, dt, self.distance_bottom_m)
        if mode is Mode.TAKEOFF and self.tasks.done:
            self.commander.takeoff_done()
        landed = self.land.is_landed
        climb = -self._down_mps if math.isfinite(self._down_mps) else 0.0
        if mode is Mode.TAKEOFF:
            climb = max(climb, self.params.real("MPC_TKO_SPEED")) if landed else climb
        up = self.takeoff.update(self.boot_ns, dt, True, landed, climb if mode is not Mode.LAND else 0.0)
        tilt = self.params.real("MPC_TILTMAX_LND" if self.takeoff.state == Takeoff.RAMP else "MPC_TILTMAX_AIR")
        self.controller.limits(up, self.params.real("MPC_Z_VEL_MAX_DN"), tilt, self.takeoff.state == Takeoff.FLIGHT)
        if self.land.has_contact and not landed:
            self.tasks.hands_off()

    def _detect(self, down_mps: float) -> None:
        if self.boot_ns < self._next_detect_ns:
            return
        self._next_detect_ns = self.boot_ns + DETECT_NS
        armed = self.commander.is_armed
        self.land.update(self.boot_ns, self.ekf.o, self.controller, self.takeoff, armed, down_mps)
        if armed or not self.land.is_landed:
            self._rest_ns = self.boot_ns + REST_NS
        self.ekf.at_rest = self.boot_ns >= self._rest_ns

    def _keep_home(self) -> None:
        """Home follows the vehicle until it takes off."""
        if self.ekf.global_valid and self.land.is_landed:
            if not self.home_set or self.commander.is_armed:
                self.tasks.home[:] = self.ekf.o[7:10]
                self.home_us = self.boot_ns // 1000
            self.home_set = True
        elif not self.home_set and self.commander.is_armed and self.land.is_landed:
            self.tasks.home[:] = self.ekf.o[7:10]

    def _serve(self) -> None:
        t_ns = self.boot_ns
        if not self._told_boot_params and t_ns >= self._boot_params_ns:
            self._told_boot_params = True
            for link in self.links.values():
                for name in self.params.changed_at_boot:
                    self.parameters.send_value(link, name)
        self.parameters.step(t_ns)
        for link in self.links.values():
            link.step(self, t_ns)
        self._collect()
        if self._reboot_wanted:
            out = self._out
            self.reboot(self.now_ns)
            self._out = out

    def _collect(self) -> None:
        for name, link in self.links.items():
            if link.out:
                self._out += [(name, frame) for frame in link.out]
                link.out.clear()
