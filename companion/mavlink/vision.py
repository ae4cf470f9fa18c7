"""ODOMETRY: the companion's estimate as external vision, and what must hold before a sample may leave."""

from __future__ import annotations

import math
from collections import Counter

from companion.mavlink import frames, wire
from companion.mavlink.dialect import FRAME_BODY_FRD, Dialect
from companion.messages import OdometryEstimate


def pack_odometry(estimate: OdometryEstimate, dialect: Dialect, time_usec: int) -> bytes:
    """The payload of ODOMETRY for this autopilot: pose in its local frame, twist in BODY_FRD."""
    q = frames.quaternion_to_ned_frd(estimate.q_map_body_wxyz)
    return wire.pack(
        wire.ODOMETRY,
        time_usec,
        *frames.flip(estimate.position_map_m),
        *q,
        *frames.flip(estimate.velocity_body_mps),
        *frames.flip(estimate.rate_body_radps),
        *frames.pose_covariance_to_ned(estimate.pose_covariance),
        *frames.velocity_covariance_to_frd(estimate.velocity_covariance),
        dialect.odometry_frame,
        FRAME_BODY_FRD,
        estimate.reset_counter & 0xFF,
        dialect.estimator_type,
        max(-1, min(100, estimate.quality)),
    )


class Vision:
    """Lets samples out in order, not too close, only good ones, never before the origin stands."""

    def __init__(self) -> None:
        self.refused: Counter[str] = Counter()
        self.restart()

    def restart(self) -> None:
        self.sent = 0
        self.t_sent_ns: int | None = None
        self.newest: OdometryEstimate | None = None

    def payload(self, estimate: OdometryEstimate, dialect: Dialect | None, *, origin_confirmed: bool) -> bytes | None:
        """ODOMETRY for the estimate; None, counted by reason, when it must not leave."""
        reason = self._reason(estimate, dialect, origin_confirmed)
        if reason is not None or dialect is None:
            self.refused[reason or "autopilot_unknown"] += 1
            return None
        self.sent += 1
        self.t_sent_ns = estimate.t_ns
        self.newest = estimate
        return pack_odometry(estimate, dialect, estimate.t_ns // 1000)

    def _reason(self, estimate: OdometryEstimate, dialect: Dialect | None, origin_confirmed: bool) -> str | None:
        if dialect is None:
            return "autopilot_unknown"
        if not origin_confirmed:
            return "no_origin"
        if estimate.quality < 0:
            return "quality_failed"  # PX4 would fuse it: EKF2_EV_QMIN is 0 by default (PX4.md, 7)
        if self.t_sent_ns is not None and estimate.t_ns - self.t_sent_ns < dialect.min_odometry_spacing_ns:
            return "too_soon" if estimate.t_ns > self.t_sent_ns else "time_went_back"
        # One sum is enough: it is not finite as soon as one of its parts is not.
        total = (
            sum(estimate.position_map_m.tolist())
            + sum(estimate.q_map_body_wxyz.tolist())
            + sum(estimate.velocity_body_mps.tolist())
            + sum(estimate.rate_body_radps.tolist())
            + sum(estimate.pose_covariance.ravel().tolist())
            + sum(estimate.velocity_covariance.ravel().tolist())
        )
        if not math.isfinite(total):
            return "not_finite"
        q = estimate.q_map_body_wxyz.tolist()
        if abs(sum(v * v for v in q) - 1.0) > 1e-3:
            return "no_rotation"
        return None
