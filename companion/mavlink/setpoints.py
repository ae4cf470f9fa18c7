"""Velocity setpoints and obstacle distances as the autopilots take them."""

from __future__ import annotations

import math

from companion.mavlink import frames, wire
from companion.mavlink.dialect import FRAME_BODY_FRD, FRAME_LOCAL_NED
from companion.messages import Setpoint, WallRanges

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


_BEARINGS = tuple(
    tuple((k - _BEAMS_PER_SECTOR * sector - _BEAMS_PER_SECTOR // 2) % 360 for k in range(_BEAMS_PER_SECTOR))
    for sector in range(SECTORS)
)


def pack_obstacles(ranges: WallRanges, *, min_range_m: float, max_range_m: float) -> bytes:
    """OBSTACLE_DISTANCE: 72 sectors of 5 degrees clockwise from forward, cm, BODY_FRD. Each is centred on its bearing
    and holds the nearest return; max + 1 where nothing was within reach, 65535 where nothing was seen."""
    max_cm = min(int(max_range_m * 100), 65533)
    metres, seen = ranges.ranges_m.tolist(), ranges.is_seen.tolist()
    distances = []
    for bearings in _BEARINGS:
        looked = [metres[b] for b in bearings if seen[b]]
        nearest = min(looked, default=None)
        if nearest is None or math.isnan(nearest):
            distances.append(_UNKNOWN)
        elif nearest * 100 > max_cm:
            distances.append(max_cm + 1)
        else:
            distances.append(max(0, round(nearest * 100)))
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
