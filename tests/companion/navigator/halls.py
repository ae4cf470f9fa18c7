"""A flat world for the navigator: polygons, a LiDAR's horizontal layer, a vehicle that follows velocities with a lag.

No dynamics and no flight controller beyond modes: what is tested here is where the navigator flies, from any start.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from companion.config import CompanionConfig
from companion.geometry import quat_from_rpy, wrap_angle
from companion.messages import (
    FlightMode,
    LandedState,
    OdometryEstimate,
    OperatorCommand,
    RequestKind,
    Setpoint,
    VehicleRequest,
    VehicleState,
    WallRanges,
)
from companion.navigator import Navigator, NavigatorInput, NavigatorOutput, NavigatorState
from companion.navigator.guard import Guard, GuardInput

Ring = list[tuple[float, float]]
MS = 1_000_000


def rectangle(x0: float, y0: float, x1: float, y1: float) -> Ring:
    return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]


def circle(x: float, y: float, r: float, corners: int = 48) -> Ring:
    turn = [2 * math.pi * n / corners for n in range(corners)]
    return [(x + r * math.cos(a), y + r * math.sin(a)) for a in turn]


def column(x: float, y: float, size: float = 0.8) -> Ring:
    return rectangle(x - size / 2, y - size / 2, x + size / 2, y + size / 2)


def pilasters(width: float, depth: float) -> list[Ring]:
    """Along the two long walls of a rectangle."""
    rings = []
    for x in np.arange(5.0, width, 5.0):
        rings += [rectangle(x - 0.3, 0.0, x + 0.3, 0.4), rectangle(x - 0.3, depth - 0.4, x + 0.3, depth)]
    return rings


HALLS: dict[str, list[Ring]] = {
    "cement_store": [rectangle(0, 0, 50, 30)],
    # A pile against the long wall, cut by the layer in a bulge that reaches 5 m into the hall.
    "leaning_pile": [rectangle(0, 0, 50, 30), [(18, 30), (20, 27), (24, 25), (28, 25.5), (31, 28), (32, 30)]],
    "l_shaped": [[(0, 0), (56, 0), (56, 24), (24, 24), (24, 48), (0, 48)]],
    "columns": [
        rectangle(0, 0, 48, 32), *pilasters(48, 32),
        *[column(x, y, 0.6) for x in (12, 24, 36) for y in (11.5, 20.5)],
    ],
    "silo": [circle(16, 16, 16)],
    # Columns at odd places: one so near the wall that D fits on neither side, one in a corner.
    "clutter": [
        rectangle(0, 0, 60, 40),
        *[column(x, y) for x, y in [(15, 14), (30, 14), (45, 13), (15, 27), (30, 27), (45, 27), (52, 9)]],
    ],
}  # fmt: skip


@njit(cache=True)
def _cast(a: np.ndarray, edge: np.ndarray, x: float, y: float, bearing: np.ndarray) -> np.ndarray:
    out = np.full(len(bearing), np.inf)
    for n in range(len(bearing)):
        dx, dy = math.cos(bearing[n]), math.sin(bearing[n])
        for k in range(len(a)):
            den = dx * edge[k, 1] - dy * edge[k, 0]
            if abs(den) < 1e-12:
                continue
            ax, ay = a[k, 0] - x, a[k, 1] - y
            along = (ax * edge[k, 1] - ay * edge[k, 0]) / den
            share = (ax * dy - ay * dx) / den
            if along > 0 and 0 <= share <= 1 and along < out[n]:
                out[n] = along
    return out


class Hall:
    """Rings of straight edges: the first is the hall's outline, the others stand in it."""

    def __init__(self, rings: list[Ring]) -> None:
        self.rings = [np.array(r, dtype=float) for r in rings]
        self.a = np.concatenate(self.rings)
        self.b = np.concatenate([np.roll(r, -1, axis=0) for r in self.rings])
        self.edge = self.b - self.a

    def cast(self, x: float, y: float, bearing: np.ndarray) -> np.ndarray:
        return _cast(self.a, self.edge, x, y, bearing)

    def clearance(self, x: float, y: float) -> float:
        p = np.array([x, y]) - self.a
        share = np.clip((p * self.edge).sum(axis=1) / (self.edge**2).sum(axis=1), 0, 1)
        return float(np.hypot(*(p - share[:, None] * self.edge).T).min())

    def is_inside(self, x: float, y: float) -> bool:
        """Inside the outline and in nothing that stands there."""
        return _within(self.rings[0], x, y) and not any(_within(r, x, y) for r in self.rings[1:])

    def random_start(self, rng: np.random.Generator, clearance_m: float) -> tuple[float, float, float]:
        low, high = self.rings[0].min(axis=0), self.rings[0].max(axis=0)
        while True:
            x, y = (float(v) for v in rng.uniform(low, high))
            if self.is_inside(x, y) and self.clearance(x, y) >= clearance_m:
                return x, y, float(rng.uniform(-math.pi, math.pi))


def _within(ring: np.ndarray, x: float, y: float) -> bool:
    inside = False
    for (ax, ay), (bx, by) in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        if (ay > y) != (by > y) and x < (bx - ax) * (y - ay) / (by - ay) + ax:
            inside = not inside
    return inside


@dataclass
class Log:
    x: list[float] = field(default_factory=list)
    y: list[float] = field(default_factory=list)
    yaw: list[float] = field(default_factory=list)
    state: list[NavigatorState] = field(default_factory=list)
    is_straight: list[bool] = field(default_factory=list)
    events: list[str] = field(default_factory=list)


class Rig:
    """Navigator and guard in a hall. Step 50 ms; scans each 100 ms, 60 ms old when they come."""

    def __init__(
        self, hall: Hall, start: tuple[float, float, float], config: CompanionConfig, seed: int = 0,
        noise_m: float = 0.12,
    ) -> None:  # fmt: skip
        self.hall, self.config, self.noise_m = hall, config, noise_m
        self.rng = np.random.default_rng(seed)
        self.x, self.y, self.yaw = start
        self.start = start
        self.z, self.v, self.yaw_rate = 0.0, np.zeros(3), 0.0
        self.t = 1_000 * MS
        self.armed, self.mode, self.landed = False, FlightMode.HOLD, LandedState.ON_GROUND
        self.heartbeat = True
        self.see = True
        self.hears_setpoints = True
        self.battery: float | None = 1.0
        self.navigator, self.guard = Navigator(config), Guard(config)
        self.walls: WallRanges | None = None
        self.pending: list[tuple[int, WallRanges]] = []
        self.estimate: OdometryEstimate | None = None
        self.estimate_changes: dict[str, object] = {}
        self.output: NavigatorOutput | None = None
        self.setpoint: Setpoint | None = None
        self.requests: list[VehicleRequest] = []
        self.heartbeat_ns = self.t
        self.min_clearance = math.inf
        self.log = Log()
        self.drift = np.zeros(2)

    # map: pinned to the start pose

    def in_map(self) -> tuple[float, float, float]:
        x0, y0, yaw0 = self.start
        dx, dy = self.x - x0, self.y - y0
        c, s = math.cos(yaw0), math.sin(yaw0)
        return c * dx + s * dy, -s * dx + c * dy, wrap_angle(self.yaw - yaw0)

    def _scan(self) -> WallRanges | None:
        columns = 512
        bearing = 2 * math.pi * np.arange(columns) / columns
        true = self.hall.cast(self.x, self.y, bearing + self.yaw)
        measured = true + self.noise_m * self.rng.standard_normal(columns)
        reach = self.config.lidar.max_range_m
        good = (true < reach) & (true > self.config.lidar.min_range_m)
        ranges = np.full(360, np.inf)
        sector = np.floor(np.degrees(bearing) + 0.5).astype(int) % 360
        np.minimum.at(ranges, sector[good], measured[good])
        return WallRanges(t_ns=self.t, front_m=None, right_m=None, ranges_m=ranges, is_seen=np.ones(360, dtype=bool))

    def _estimate(self) -> OdometryEstimate:
        x, y, yaw = self.in_map()
        self.drift += 0.0005 * self.rng.standard_normal(2)
        noise = 0.02 * self.rng.standard_normal(3)
        values: dict[str, object] = {
            "t_ns": self.t, "t_scan_ns": self.walls.t_ns if self.walls else self.t,
            "position_map_m": np.array([x + self.drift[0], y + self.drift[1], self.z]) + noise,
            "q_map_body_wxyz": quat_from_rpy(0.0, 0.0, yaw + 0.003 * self.rng.standard_normal()),
            "velocity_body_mps": np.zeros(3), "rate_body_radps": np.zeros(3),
            "pose_covariance": np.diag([4e-4] * 3 + [1e-5] * 3), "velocity_covariance": 1e-3 * np.eye(3),
            "quality": 90, "reset_counter": 0, "converged": True, "is_degenerate": False, "inliers": 400,
            "iterations": 5, "keyframe_id": 0, "is_keyframe": False,
        }  # fmt: skip
        return OdometryEstimate(**{**values, **self.estimate_changes})  # type: ignore[arg-type]

    def vehicle(self) -> VehicleState:
        return VehicleState(
            t_ns=self.heartbeat_ns, t_heartbeat_ns=self.heartbeat_ns, is_connected=True, is_armed=self.armed,
            mode=self.mode, is_failsafe=False, landed_state=self.landed, position_map_m=None, velocity_map_mps=None,
            battery_ratio=self.battery, is_position_valid=True, is_ready_to_arm=True,
        )  # fmt: skip

    def step(self, *commands: OperatorCommand) -> NavigatorOutput:
        self.t += 50 * MS
        if self.see:
            scan = self._scan() if (self.t // (50 * MS)) % 2 == 0 else None
            if scan is not None:
                self.pending.append((self.t + 60 * MS, scan))
            while self.pending and self.pending[0][0] <= self.t:
                self.walls = self.pending.pop(0)[1]
            self.estimate = self._estimate()
        if self.heartbeat:
            self.heartbeat_ns = self.t
        vehicle = self.vehicle()
        self.output = self.navigator.step(
            self.t,
            NavigatorInput(
                estimate=self.estimate, walls=self.walls, vehicle=vehicle, commands=commands, sent=self.setpoint
            ),
        )
        verdict = self.guard.check(
            self.output.setpoint, self.t,
            GuardInput(estimate=self.estimate, walls=self.walls, vehicle=vehicle, commands=commands),
        )  # fmt: skip
        self.setpoint = verdict.setpoint
        for request in (*self.output.requests, *verdict.requests):
            self.requests.append(request)
            self._obey(request)
        self.log.events += [e.name for e in (*self.output.events, *verdict.events)]
        self._move(0.05)
        return self.output

    def _obey(self, request: VehicleRequest) -> None:
        if request.kind is RequestKind.ARM and self.mode is FlightMode.OFFBOARD:
            self.armed = True
        elif request.kind is RequestKind.OFFBOARD:
            self.mode = FlightMode.OFFBOARD
        elif request.kind is RequestKind.LAND:
            self.mode = FlightMode.LAND
        elif request.kind is RequestKind.DISARM and self.landed is LandedState.ON_GROUND:
            self.armed = False

    def _move(self, dt: float) -> None:
        wanted, yaw_rate = np.zeros(3), 0.0
        if self.armed and self.mode is FlightMode.LAND:
            wanted = np.array([0.0, 0.0, -0.7])
        elif self.armed and self.mode is FlightMode.OFFBOARD and self.setpoint is not None and self.hears_setpoints:
            v, yaw0 = self.setpoint.velocity_map_mps, self.start[2]  # silent: zeros
            c, s = math.cos(yaw0), math.sin(yaw0)
            wanted = np.array([c * v[0] - s * v[1], s * v[0] + c * v[1], v[2]])
            yaw_rate = self.setpoint.yaw_rate_radps
        self.v += (wanted - self.v) * dt / 0.5
        self.yaw_rate += (yaw_rate - self.yaw_rate) * dt / 0.3
        self.x, self.y = self.x + self.v[0] * dt, self.y + self.v[1] * dt
        self.z = max(0.0, self.z + self.v[2] * dt)
        self.yaw = wrap_angle(self.yaw + self.yaw_rate * dt)
        if self.z > 0.1:
            self.landed = LandedState.IN_AIR
            self.min_clearance = min(self.min_clearance, self.hall.clearance(self.x, self.y))
        elif self.mode is FlightMode.LAND and self.landed is LandedState.IN_AIR:
            self.landed, self.armed, self.v = LandedState.ON_GROUND, False, np.zeros(3)
        output = self.output
        assert output is not None
        self.log.x.append(self.x)
        self.log.y.append(self.y)
        self.log.yaw.append(self.yaw)
        self.log.state.append(output.state)
        self.log.is_straight.append(output.is_straight and abs(self.yaw_rate) < math.radians(5))

    def fly(self, limit_s: float = 1800.0) -> NavigatorOutput:
        end = self.t + round(limit_s * 1e9)
        while True:
            output = self.step()
            if output.finished or self.t > end:
                return output

    def fly_until(self, state: NavigatorState, limit_s: float = 600.0) -> NavigatorOutput:
        end = self.t + round(limit_s * 1e9)
        while True:
            output = self.step()
            if output.state is state:
                return output
            assert not output.finished, f"{output.state}: {output.reason}"
            assert self.t < end, f"still {output.state}"

    # figures

    def from_start_m(self) -> float:
        return math.hypot(self.x - self.start[0], self.y - self.start[1])

    def wall_distance_rms_m(self) -> float:
        """Perpendicular distance to the edge that the right beam meets, less D, where straight."""
        errors = []
        for n in np.flatnonzero(self.log.is_straight)[::4]:
            bearing = np.array([self.log.yaw[n] - math.pi / 2])
            x, y = self.log.x[n], self.log.y[n]
            d = self.hall.cast(x, y, bearing)[0]
            hit = np.array([x + d * math.cos(bearing[0]), y + d * math.sin(bearing[0])])
            p = hit - self.hall.a
            length = np.hypot(*self.hall.edge.T)
            off = np.abs(p[:, 0] * self.hall.edge[:, 1] - p[:, 1] * self.hall.edge[:, 0]) / length
            share = (p * self.hall.edge).sum(axis=1) / length**2
            e = int(np.argmin(np.where((share > -0.01) & (share < 1.01), off, np.inf)))
            normal = np.array([self.hall.edge[e, 1], -self.hall.edge[e, 0]]) / length[e]
            errors.append(abs(normal @ (np.array([x, y]) - self.hall.a[e])) - self.config.navigator.wall_distance_m)
        return float(np.sqrt(np.mean(np.square(errors)))) if errors else math.nan
