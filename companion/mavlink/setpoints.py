"""Velocity setpoints and obstacle distances as the autopilots take them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from companion.jit import kernel
from companion.mavlink import frames, wire
from companion.mavlink.dialect import FRAME_BODY_FRD, FRAME_LOCAL_NED
from companion.messages import Array, Setpoint, WallRanges

# POSITION_TARGET_TYPEMASK: position, acceleration and yaw ignored; velocity and yaw rate used. Both autopilots.
VELOCITY_AND_YAW_RATE = 0x5C7
SECTORS = 72
_BEAMS_PER_SECTOR = 5
_UNKNOWN = 65535
_SENSOR_LASER = 0
_NAN = float("nan")


def pack_setpoint(setpoint: Setpoint, target_system: int, time_boot_ms: int) -> bytes | None:
    """SET_POSITION_TARGET_LOCAL_NED in LOCAL_NED; None when a number in it is not finite: that must never leave."""
    vx, vy, vz = frames.flip(setpoint.velocity_map_mps)
    yaw_rate = -setpoint.yaw_rate_radps  # NED: clockwise from above is positive
    if not math.isfinite(vx + vy + vz + yaw_rate):
        return None
    return wire.pack(
        wire.SET_POSITION_TARGET_LOCAL_NED,
        time_boot_ms & 0xFFFFFFFF,
        0.0,
        0.0,
        0.0,
        vx,
        vy,
        vz,
        0.0,
        0.0,
        0.0,
        0.0,
        yaw_rate,
        VELOCITY_AND_YAW_RATE,
        target_system,
        wire.COMP_AUTOPILOT,
        FRAME_LOCAL_NED,
    )


def pack_obstacles(ranges: WallRanges, *, min_range_m: float, max_range_m: float) -> bytes:
    """OBSTACLE_DISTANCE: 72 sectors of 5 degrees clockwise from forward, cm, BODY_FRD. Each is centred on its bearing
    and holds the nearest return; max + 1 where nothing was within reach, 65535 where nothing was seen."""
    max_cm = min(int(max_range_m * 100), 65533)
    distances = _sector_distances_cm(ranges.ranges_m, ranges.is_seen, max_cm).tolist()
    return wire.pack(
        wire.OBSTACLE_DISTANCE,
        ranges.t_ns // 1000,
        *distances,
        int(min_range_m * 100),
        max_cm,
        _SENSOR_LASER,
        _BEAMS_PER_SECTOR,
        float(_BEAMS_PER_SECTOR),
        0.0,
        FRAME_BODY_FRD,
    )


@kernel
def _sector_distances_cm(ranges_m: Array, is_seen: NDArray[np.bool_], max_cm: int) -> NDArray[np.int64]:
    """(72,) of what was seen (360,) by whole degrees counter-clockwise; see pack_obstacles."""
    out = np.empty(SECTORS, np.int64)
    for sector in range(SECTORS):
        nearest, is_known = np.inf, False
        for k in range(_BEAMS_PER_SECTOR):
            bearing = (k - _BEAMS_PER_SECTOR * sector - _BEAMS_PER_SECTOR // 2) % 360
            if is_seen[bearing] and not math.isnan(ranges_m[bearing]):
                nearest, is_known = min(nearest, ranges_m[bearing]), True
        if not is_known:
            out[sector] = _UNKNOWN
        elif nearest * 100 > max_cm:
            out[sector] = max_cm + 1
        else:
            out[sector] = max(0, round(nearest * 100))
    return out
