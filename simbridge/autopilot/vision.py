"""External vision as PX4 takes it from ODOMETRY and VISION_POSITION_ESTIMATE: what is used, what is dropped, what is told.

Rules: PX4's mavlink_receiver and EKF2.cpp UpdateExtVisionSample; each is heard in the recording `wrong_input`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

# MAV_FRAME
LOCAL_NED, LOCAL_ENU, BODY_NED, BODY_OFFSET_NED, BODY_FRD, LOCAL_FRD, LOCAL_FLU = 1, 4, 8, 9, 12, 20, 21
# MAV_ESTIMATOR_TYPE
UNKNOWN, NAIVE, VISION, VIO, MOCAP = 0, 1, 2, 3, 6
NORM_TOLERANCE = 1e-5  # of the quaternion, EKF2.cpp

Vector = tuple[float, float, float]


@dataclass(slots=True, kw_only=True)
class VisionSample:
    """One sample for the estimator. What was dropped is None; variances are NaN where the sender gave none.

    `is_ned`: pose in NED, else in a frame of unknown heading (FRD). `velocity_in_body`: FRD, else as the pose.
    """

    t_ns: int
    is_ned: bool
    position_m: Vector | None
    position_var: Vector
    velocity_mps: Vector | None
    velocity_in_body: bool
    velocity_var: Vector
    yaw_rad: float | None
    yaw_var: float
    quality: int
    reset_counter: int


@dataclass(slots=True)
class Refused:
    """A message that never reaches the estimator, and the critical text for it (None: dropped in silence)."""

    text: str | None


def _vector(x: float, y: float, z: float) -> Vector | None:
    return (x, y, z) if math.isfinite(x) and math.isfinite(y) and math.isfinite(z) else None


def _heading(q: tuple[float, ...]) -> float | None:
    w, x, y, z = q
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if not math.isfinite(norm) or abs(norm - 1.0) > NORM_TOLERANCE:
        return None
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def from_odometry(f: dict[str, Any], t_ns: int) -> VisionSample | Refused:
    """The sample in an ODOMETRY message. t_ns: its time in the autopilot's clock."""
    kind = f["estimator_type"]
    if kind == MOCAP:
        return Refused(None)  # goes to a topic that EKF2 does not read
    if kind not in (UNKNOWN, NAIVE, VISION, VIO):
        return Refused(f"ODOMETRY: estimator_type {kind} unsupported\t")
    nan = math.nan
    pose, twist = f["pose_covariance"], f["velocity_covariance"]
    has_covariance = kind != NAIVE
    use_pose = has_covariance and math.isfinite(pose[0])
    use_twist = has_covariance and math.isfinite(twist[0])
    frame, child = f["frame_id"], f["child_frame_id"]
    swap = frame == LOCAL_ENU
    position_var = (pose[6], pose[0], pose[11]) if swap else (pose[0], pose[6], pose[11])
    return VisionSample(
        t_ns=t_ns,
        is_ned=frame in (LOCAL_NED, LOCAL_ENU),
        position_m=_convert(frame, f["x"], f["y"], f["z"]),
        position_var=position_var if use_pose else (nan, nan, nan),
        velocity_mps=_velocity(child, f["vx"], f["vy"], f["vz"]),
        velocity_in_body=child in (BODY_FRD, BODY_NED, BODY_OFFSET_NED),
        velocity_var=(twist[0], twist[6], twist[11]) if use_twist else (nan, nan, nan),
        yaw_rad=_heading(f["q"]),
        yaw_var=pose[20] if use_pose else nan,
        quality=f["quality"],
        reset_counter=f["reset_counter"],
    )


def from_vision_position(f: dict[str, Any], t_ns: int) -> VisionSample:
    """The sample in a VISION_POSITION_ESTIMATE: always NED, no velocity, quality 0."""
    cov = f.get("covariance") or (math.nan,) * 21
    known = math.isfinite(cov[0]) and cov[0] != 0.0
    nan = math.nan
    return VisionSample(
        t_ns=t_ns,
        is_ned=True,
        position_m=_vector(f["x"], f["y"], f["z"]),
        position_var=(cov[0], cov[6], cov[11]) if known else (nan, nan, nan),
        velocity_mps=None,
        velocity_in_body=False,
        velocity_var=(nan, nan, nan),
        yaw_rad=f["yaw"] if math.isfinite(f["yaw"]) else None,
        yaw_var=cov[20] if known else nan,
        quality=0,
        reset_counter=f.get("reset_counter", 0),
    )


def _convert(frame: int, x: float, y: float, z: float) -> Vector | None:
    if frame in (LOCAL_NED, LOCAL_FRD):
        return _vector(x, y, z)
    if frame == LOCAL_ENU:
        return _vector(y, x, -z)
    if frame == LOCAL_FLU:
        return _vector(x, -y, -z)
    return None


def _velocity(child: int, x: float, y: float, z: float) -> Vector | None:
    if child in (BODY_FRD, BODY_NED, BODY_OFFSET_NED):
        return _vector(x, y, z)
    return _convert(child, x, y, z)
