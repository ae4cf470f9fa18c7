"""Messages for tests: good ones, with what a test wants different."""

from __future__ import annotations

import math

import numpy as np

from companion.config import CompanionConfig
from companion.geometry import quat_from_rpy
from companion.messages import (
    FlightMode,
    LandedState,
    OdometryEstimate,
    OperatorCommand,
    OperatorCommandKind,
    Setpoint,
    SetpointKind,
    VehicleState,
    WallRanges,
)
from companion.navigator.guard import Guard, GuardInput, GuardVerdict

S = 1_000_000_000
MS = 1_000_000


def estimate(t_ns: int, *, at: tuple[float, float, float] = (0.0, 0.0, 5.0), yaw: float = 0.0, **changes: object):
    values: dict[str, object] = {
        "t_ns": t_ns, "t_scan_ns": t_ns, "position_map_m": np.array(at), "q_map_body_wxyz": quat_from_rpy(0, 0, yaw),
        "velocity_body_mps": np.zeros(3), "rate_body_radps": np.zeros(3), "pose_covariance": 1e-4 * np.eye(6),
        "velocity_covariance": 1e-3 * np.eye(3), "quality": 90, "reset_counter": 0, "converged": True,
        "is_degenerate": False, "inliers": 400, "iterations": 5, "keyframe_id": 0, "is_keyframe": False,
    }  # fmt: skip
    return OdometryEstimate(**{**values, **changes})  # type: ignore[arg-type]


def walls(t_ns: int, ranges: np.ndarray | float = 20.0, seen: np.ndarray | bool = True) -> WallRanges:
    """All round at one distance unless told; a millimetre of noise by time, so that no two scans are equal."""
    noise = 1e-3 * np.sin(t_ns / 1e7 + np.arange(360))
    return WallRanges(
        t_ns=t_ns, front_m=None, right_m=None, ranges_m=np.broadcast_to(ranges, 360) + noise,
        is_seen=np.array(np.broadcast_to(seen, 360)),
    )  # fmt: skip


def vehicle(t_ns: int, **changes: object) -> VehicleState:
    values: dict[str, object] = {
        "t_ns": t_ns, "t_heartbeat_ns": t_ns, "is_connected": True, "is_armed": True, "mode": FlightMode.OFFBOARD,
        "is_failsafe": False, "landed_state": LandedState.IN_AIR, "position_map_m": None, "velocity_map_mps": None,
        "battery_ratio": 0.9, "is_position_valid": True, "is_ready_to_arm": True,
    }  # fmt: skip
    return VehicleState(**{**values, **changes})  # type: ignore[arg-type]


def setpoint(t_ns: int, *velocity: float, yaw_rate: float = 0.0) -> Setpoint:
    return Setpoint(t_ns=t_ns, kind=SetpointKind.VELOCITY, velocity_map_mps=np.array(velocity), yaw_rate_radps=yaw_rate)


def abort(t_ns: int) -> OperatorCommand:
    return OperatorCommand(t_ns=t_ns, kind=OperatorCommandKind.ABORT, source="sigterm")


class GuardRig:
    """A guard that has taken off at the origin and hovers 5 m up among walls at 20 m, until a test changes that."""

    def __init__(self, config: CompanionConfig | None = None, ranges: np.ndarray | float = 20.0) -> None:
        self.guard = Guard(config or CompanionConfig())
        self.t = 10 * S
        self.ranges = ranges
        self.guard.check(None, self.t, self.inputs(at=(0.0, 0.0, 0.0)))

    def inputs(self, at: tuple[float, float, float] = (0.0, 0.0, 5.0), **changes: object) -> GuardInput:
        values: dict[str, object] = {
            "estimate": estimate(self.t, at=at), "walls": walls(self.t, self.ranges), "vehicle": vehicle(self.t)
        }  # fmt: skip
        return GuardInput(**{**values, **changes})  # type: ignore[arg-type]

    def check(self, *velocity: float, yaw_rate: float = 0.0, later_ms: int = 50, **changes: object) -> GuardVerdict:
        """A fresh setpoint, a little later."""
        self.t += later_ms * MS
        given = changes.pop("inputs", None) or self.inputs(**changes)
        return self.guard.check(setpoint(self.t, *velocity, yaw_rate=yaw_rate), self.t, given)


def toward(bearing_deg: float, speed: float = 0.5) -> tuple[float, float, float]:
    return speed * math.cos(math.radians(bearing_deg)), speed * math.sin(math.radians(bearing_deg)), 0.0
