"""The named streams between stages: one message type each, with rate, queue policy, age limit, and whether recorded.

docs/dataflow.md's table is generated from this one (`make docs`).
"""

from __future__ import annotations

from dataclasses import dataclass

from companion import messages as m


@dataclass(frozen=True, slots=True, kw_only=True)
class Topic:
    """One named stream. rate_hz 0: when something happens. queue 1: only the newest counts. stale_after_s None: never."""

    name: str
    message: type
    source: str
    sinks: tuple[str, ...]
    rate_hz: float
    queue: int
    stale_after_s: float | None
    recorded: bool = True


SCAN = Topic(
    name="lidar/scan", message=m.LidarScan, source="lidar", sinks=("odometry",), rate_hz=10, queue=2, stale_after_s=0.3
)
ATTITUDE = Topic(
    name="vehicle/attitude", message=m.AttitudeSample, source="mavlink", sinks=("odometry",), rate_hz=50, queue=256,
    stale_after_s=0.3,
)  # fmt: skip
RANGEFINDER = Topic(
    name="vehicle/rangefinder", message=m.RangefinderSample, source="mavlink", sinks=("odometry",), rate_hz=10,
    queue=64, stale_after_s=1.0,
)  # fmt: skip
VEHICLE = Topic(
    name="vehicle/state", message=m.VehicleState, source="mavlink", sinks=("navigator", "guard"), rate_hz=20, queue=1,
    stale_after_s=1.0,
)  # fmt: skip
LEVELLED = Topic(
    name="odometry/levelled", message=m.LevelledScan, source="odometry", sinks=("mapping",), rate_hz=2, queue=8,
    stale_after_s=None, recorded=False,
)  # fmt: skip
WALLS = Topic(
    name="odometry/walls", message=m.WallRanges, source="odometry", sinks=("navigator", "guard", "mavlink"),
    rate_hz=10, queue=1, stale_after_s=0.3,
)  # fmt: skip
ESTIMATE = Topic(
    name="odometry/estimate", message=m.OdometryEstimate, source="odometry", sinks=("mavlink", "navigator", "guard"),
    rate_hz=31.25, queue=1, stale_after_s=0.3,
)  # fmt: skip
KEYFRAME = Topic(
    name="odometry/keyframe", message=m.OdometryEstimate, source="odometry", sinks=("mapping",), rate_hz=0.2, queue=8,
    stale_after_s=None,
)  # fmt: skip
WANTED = Topic(
    name="navigator/setpoint", message=m.Setpoint, source="navigator", sinks=("guard",), rate_hz=20, queue=1,
    stale_after_s=0.3,
)  # fmt: skip
SETPOINT = Topic(
    name="guard/setpoint", message=m.Setpoint, source="guard", sinks=("mavlink",), rate_hz=20, queue=1,
    stale_after_s=0.3,
)  # fmt: skip
REQUEST = Topic(
    name="navigator/request", message=m.VehicleRequest, source="navigator, guard", sinks=("mavlink",), rate_hz=0,
    queue=16, stale_after_s=None,
)  # fmt: skip
OPERATOR = Topic(
    name="operator/command", message=m.OperatorCommand, source="edges", sinks=("navigator", "guard"), rate_hz=0,
    queue=16, stale_after_s=None,
)  # fmt: skip
EVENT = Topic(
    name="event", message=m.Event, source="all stages", sinks=("mavlink", "telemetry"), rate_hz=0, queue=256,
    stale_after_s=None,
)  # fmt: skip
VOLUME = Topic(
    name="volume/report", message=m.VolumeReport, source="volume", sinks=("telemetry",), rate_hz=0, queue=1,
    stale_after_s=None,
)  # fmt: skip

TOPICS: tuple[Topic, ...] = (
    SCAN, ATTITUDE, RANGEFINDER, VEHICLE, LEVELLED, WALLS, ESTIMATE, KEYFRAME, WANTED, SETPOINT, REQUEST, OPERATOR,
    EVENT, VOLUME,
)  # fmt: skip
