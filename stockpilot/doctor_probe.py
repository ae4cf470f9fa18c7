"""The doctor's test pose: a standing ODOMETRY stream, sent where that is safe, to see whether the autopilot fuses it."""

from __future__ import annotations

import asyncio
import math
import time
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from companion.mavlink.ardupilot import ARDUPILOT
from companion.mavlink.checks import SentVision
from companion.mavlink.dialect import FRAME_BODY_FRD, Dialect
from companion.mavlink.px4 import PX4
from stockpilot.vehicle_link import VehicleLink

_DIALECTS: dict[str, Dialect] = {"px4": PX4, "ardupilot": ARDUPILOT}
ORIGIN_E7 = (474_000_000, 85_000_000)  # any place will do (MavlinkConfig)
_ORIGIN_TRIES = 5


@dataclass(frozen=True, slots=True, kw_only=True)
class Probe:
    """What to send. None: as the companion would. The rest are for looking at one gate by itself."""

    is_forced: bool = False  # also when a companion seems to be running
    rate_hz: float = 30.0
    frame_id: int | None = None
    child_frame_id: int = FRAME_BODY_FRD
    estimator_type: int | None = None
    quaternion_scale: float = 1.0
    quality: int = 90
    position_sigma_m: float = 0.1
    jump_m: float = 0.0  # half way through, without reset_counter
    is_clock_still: bool = False  # every sample with the same time_usec


async def ensure_origin(link: VehicleLink, *, may_set: bool) -> bool:
    """Ask for the origin; where there is none, set it at altitude 0, as the companion does before any vision."""
    if "GPS_GLOBAL_ORIGIN" in link.newest:
        return True
    await _request_origin(link)
    if await link.wait_for("GPS_GLOBAL_ORIGIN", 1.0) is not None:
        return True
    latitude, longitude = ORIGIN_E7
    for _ in range(_ORIGIN_TRIES if may_set else 0):
        await link.send(
            "SET_GPS_GLOBAL_ORIGIN",
            {
                "target_system": link.system_id,
                "latitude": latitude,
                "longitude": longitude,
                "altitude": 0,
                "time_usec": 0,
            },
        )
        if await link.wait_for("GPS_GLOBAL_ORIGIN", 1.0) is not None:
            return True
    return False


async def _request_origin(link: VehicleLink) -> None:
    await link.command(512, 49.0)  # MAV_CMD_REQUEST_MESSAGE


async def send_pose(link: VehicleLink, probe: Probe, seconds: float) -> SentVision:
    """Stand still at the origin in the autopilot's own attitude for so long; how it really left."""
    dialect = _DIALECTS[link.autopilot or "px4"]
    frame = dialect.odometry_frame if probe.frame_id is None else probe.frame_id
    kind = dialect.estimator_type if probe.estimator_type is None else probe.estimator_type
    q = _attitude(link)
    scaled = [v * probe.quaternion_scale for v in q]
    variance = probe.position_sigma_m**2
    covariance = _diagonal(variance, variance, variance, 0.003, 0.003, 0.003)
    fields: dict[str, Any] = {
        "frame_id": frame,
        "child_frame_id": probe.child_frame_id,
        "y": 0.0,
        "z": 0.0,
        "q": scaled,
        **dict.fromkeys(("vx", "vy", "vz", "rollspeed", "pitchspeed", "yawspeed"), 0.0),
        "pose_covariance": covariance,
        "velocity_covariance": _diagonal(0.01, 0.01, 0.01, 0.01, 0.01, 0.01),
        "reset_counter": 0,
        "estimator_type": kind,
        "quality": probe.quality,
    }
    begin = time.monotonic()
    left: list[float] = []
    stamps: list[int] = []
    period = 1.0 / probe.rate_hz
    while time.monotonic() - begin < seconds:
        now = time.monotonic()
        is_late_half = now - begin > seconds / 2
        x = probe.jump_m if is_late_half else 0.0
        stamps.append(stamps[0] if probe.is_clock_still and stamps else time.monotonic_ns() // 1000)
        await link.send("ODOMETRY", {**fields, "time_usec": stamps[-1], "x": x})
        left.append(now)
        await asyncio.sleep(max(0.0, begin + len(left) * period - time.monotonic()))
    gaps = [b - a for a, b in pairwise(left)]
    norm = math.sqrt(sum(v * v for v in scaled))
    return SentVision(
        rate_hz=len(gaps) / sum(gaps) if gaps else 0.0,
        max_gap_s=max(gaps, default=seconds),
        frame_id=frame,
        child_frame_id=probe.child_frame_id,
        estimator_type=kind,
        norm_error=abs(norm - 1.0),
        quality=probe.quality,
        position_sigma_m=probe.position_sigma_m,
        stamps_forward=all(before < after for before, after in pairwise(stamps)),
    )


def _attitude(link: VehicleLink) -> list[float]:
    """The autopilot's own, with heading 0: tilt must agree, heading is what vision gives."""
    a = link.newest.get("ATTITUDE", {})
    roll, pitch = float(a.get("roll") or 0.0), float(a.get("pitch") or 0.0)
    cr, sr, cp, sp = math.cos(roll / 2), math.sin(roll / 2), math.cos(pitch / 2), math.sin(pitch / 2)
    q = [cr * cp, sr * cp, cr * sp, -sr * sp]
    norm = math.sqrt(sum(v * v for v in q))
    return [v / norm for v in q]


def _diagonal(*values: float) -> list[float]:
    """Upper triangle of a 6 x 6, row by row."""
    out: list[float] = []
    for row, value in enumerate(values):
        out += [value, *[0.0] * (5 - row)]
    return out
