"""What external vision may do to the estimate: starts, gates, resets, time-outs. PX4's rules, aid source by aid source.

Source: PX4 ekf2/EKF/aid_sources/external_vision/*.cpp and common.h; measured times in PX4.md section 6.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

from simbridge.autopilot import kernels
from simbridge.autopilot.params import ParamStore
from simbridge.autopilot.vision import VisionSample

if TYPE_CHECKING:
    from simbridge.autopilot.estimator import Estimator

MS = 1_000_000
MAX_INTERVAL_NS = 200 * MS  # EV_MAX_INTERVAL: fusion starts only if samples follow each other faster
STALE_NS = 100 * MS  # a sample more than this behind the horizon is not taken out of the buffer any more
MIN_SPACING_NS = 10_526_316  # EKF2_DELAY_MAX 200 ms over the 19 gaps of the buffer: faster samples are dropped
NO_AID_NS = 1_000 * MS  # no_aid_timeout_max: a source whose samples all fail this long is reset or stopped
HEIGHT_TIMEOUT_NS = 5_000 * MS  # hgt_fusion_timeout_max
RESETS_IN_AIR = 5
STABLE_AFTER_NS = 2_500 * MS  # "horizontal position unstable" until so long after fusion began (recorded 2.34 to 2.6 s)
UNSTABLE_AFTER_STOP_NS = 1_250 * MS  # on the ground, after fusion stopped (recorded 1.05 to 1.45 s)

HPOS, VPOS, VEL, YAW = 1, 2, 4, 8  # bits of EKF2_EV_CTRL
VISION_BIT = 8  # of EKF2_SENS_EN
HEIGHT_REF_VISION = 3


class Aid:
    """One aid source. `ratio`: worst innovation against its gate, squared; NaN while inactive."""

    def __init__(self) -> None:
        self.active = False
        self.fused_ns = 0
        self.resets_left = RESETS_IN_AIR
        self.ratio = math.nan

    def start(self, horizon_ns: int) -> None:
        self.active = True
        self.fused_ns = horizon_ns
        self.resets_left = RESETS_IN_AIR

    def stop(self) -> None:
        self.active = False
        self.ratio = math.nan


@dataclass(slots=True)
class _Moment:
    """What holds for a sample as a whole. `starts`: a source may start; `jumped`: reset_counter moved."""

    now_ns: int
    horizon_ns: int
    starts: bool
    jumped: bool
    quality_ok: bool


class VisionAiding:
    """Buffers vision samples and fuses each when the horizon reaches it."""

    def __init__(self, ekf: Estimator, params: ParamStore) -> None:
        self._ekf = ekf
        self._params = params
        self._buffer: deque[VisionSample] = deque(maxlen=20)
        self._pushed_ns = -(10**18)
        self._last_push_stamp_ns = -(10**18)
        self._previous: VisionSample | None = None
        self.position, self.velocity, self.height, self.heading = Aid(), Aid(), Aid(), Aid()
        self.yaw_aligned = False
        self.xy_valid = False
        self.dead_reckoning = False
        self.too_fast = 0
        self.reset_count = 0
        self._offset = [0.0, 0.0]  # of the vision's origin against ours: the late-origin hazard
        self._started_ns = 0
        self._stopped_ns = -(10**18)
        self._invalid_at_ns = -1

    @property
    def aided(self) -> bool:
        """Position or velocity is being fused."""
        return self.position.active or self.velocity.active

    @property
    def height_is_reference(self) -> bool:
        return self.height.active and self._params.integer("EKF2_HGT_REF") == HEIGHT_REF_VISION

    def stable(self, now_ns: int) -> bool:
        """The preflight check's view of the horizontal position."""
        if not self.xy_valid or now_ns - self._stopped_ns < UNSTABLE_AFTER_STOP_NS:
            return False
        if self.position.ratio > 1.0:
            return False
        return now_ns - self._started_ns >= STABLE_AFTER_NS

    def add(self, sample: VisionSample, now_ns: int) -> None:
        """Buffer a sample; its stamp becomes that of the measurement (EKF2_EV_DELAY)."""
        sample.t_ns -= int(self._params.real("EKF2_EV_DELAY") * MS)
        if sample.t_ns - self._last_push_stamp_ns < MIN_SPACING_NS:
            self.too_fast += 1
            return
        self._last_push_stamp_ns = sample.t_ns
        self._pushed_ns = now_ns
        self._buffer.append(sample)

    def step(self, now_ns: int, horizon_ns: int) -> None:
        """Fuse what is due; stop all sources when vision has been silent for 0.4 s of the horizon's time."""
        sample: VisionSample | None = None
        while self._buffer and self._buffer[0].t_ns <= horizon_ns:
            sample = self._buffer.popleft()
            if sample.t_ns < horizon_ns - STALE_NS:
                sample = None
        if sample is not None and self._params.integer("EKF2_SENS_EN") & VISION_BIT:
            self._take(sample, now_ns, horizon_ns)
            self._previous = sample
        elif (
            self._any_active() and self._previous is not None and self._previous.t_ns + 2 * MAX_INTERVAL_NS < horizon_ns
        ):
            for aid in (self.position, self.velocity, self.height, self.heading):
                aid.stop()
        self._judge(now_ns)

    def _any_active(self) -> bool:
        return self.position.active or self.velocity.active or self.height.active or self.heading.active

    def _judge(self, now_ns: int) -> None:
        """Validity of the horizontal position: from the first aid until dead reckoning has lasted EKF2_NOAID_TOUT."""
        if self.aided:
            if not self.xy_valid or self.dead_reckoning:
                if not self.xy_valid:
                    self._started_ns = now_ns
                self.dead_reckoning, self.xy_valid = False, True
            return
        if self.xy_valid and not self.dead_reckoning:
            self.dead_reckoning = True
            self._stopped_ns = now_ns
            self._invalid_at_ns = now_ns - NO_AID_NS + self._params.integer("EKF2_NOAID_TOUT") * 1000
        if self.xy_valid and now_ns >= self._invalid_at_ns:
            self.xy_valid = self.dead_reckoning = False
            self.yaw_aligned = self.yaw_aligned and self.heading.active

    def _take(self, s: VisionSample, now_ns: int, horizon_ns: int) -> None:
        control = self._params.integer("EKF2_EV_CTRL")
        quality_ok = self._params.integer("EKF2_EV_QMIN") <= 0 or s.quality >= self._params.integer("EKF2_EV_QMIN")
        previous = self._previous
        starts = (
            quality_ok
            and previous is not None
            and s.t_ns - previous.t_ns < MAX_INTERVAL_NS
            and now_ns - self._pushed_ns < MAX_INTERVAL_NS
        )
        jumped = previous is not None and s.reset_counter != previous.reset_counter
        at = _Moment(now_ns, horizon_ns, starts, jumped, quality_ok)
        self._yaw(s, at, bool(control & YAW) and s.yaw_rad is not None)
        self._velocity(s, at, bool(control & VEL))
        self._position(s, at, bool(control & HPOS) and (self.yaw_aligned or not s.is_ned))
        self._height(s, at, bool(control & VPOS))

    def _variance(self, measured: float, lower_name: str) -> float:
        lower = self._params.real(lower_name) ** 2
        if self._params.integer("EKF2_EV_NOISE_MD") == 1 or not math.isfinite(measured):
            return lower
        return max(measured, lower)

    def _failing(self, aid: Aid, at: _Moment) -> bool:
        """All samples failed for a second: True if it may be reset to vision; else it is stopped."""
        if at.horizon_ns - aid.fused_ns <= NO_AID_NS:
            return False
        if aid.resets_left > 0 and at.quality_ok:
            if not self._ekf.at_rest:
                aid.resets_left -= 1
            return True
        aid.stop()
        return False

    def _yaw(self, s: VisionSample, at: _Moment, wanted: bool) -> None:
        aid, ekf = self.heading, self._ekf
        if not wanted or s.yaw_rad is None:
            aid.stop()
            return
        variance = self._variance(s.yaw_var, "EKF2_EVA_NOISE")
        innovation = math.remainder(s.yaw_rad - kernels.yaw_of(ekf.x), 2 * math.pi)
        if not aid.active:
            if at.starts:
                self._reset_yaw(innovation, variance)
                self.yaw_aligned = s.is_ned
                aid.start(at.horizon_ns)
            return
        if at.jumped and at.quality_ok:
            self._reset_yaw(innovation, variance)
            aid.fused_ns = at.horizon_ns
            return
        gate = self._params.real("EKF2_HDG_GATE")
        aid.ratio = innovation**2 / (gate**2 * (kernels.yaw_variance(ekf.x, ekf.P) + variance))
        if at.quality_ok and aid.ratio <= 1.0:
            kernels.fuse_yaw(ekf.x, ekf.P, innovation, variance)
            aid.fused_ns = at.horizon_ns
        elif self._failing(aid, at):
            self._reset_yaw(innovation, variance)
            aid.fused_ns = at.horizon_ns

    def _reset_yaw(self, angle: float, variance: float) -> None:
        self._ekf.turn(angle)
        kernels.reset_block(self._ekf.P, 2, 1, variance)
        self.reset_count += 1

    def _velocity(self, s: VisionSample, at: _Moment, wanted: bool) -> None:
        aid, ekf = self.velocity, self._ekf
        if not wanted or s.velocity_mps is None or not (self.yaw_aligned or self.heading.active or s.velocity_in_body):
            aid.stop()
            return
        v = s.velocity_mps
        if s.velocity_in_body:
            v = kernels.to_ned(ekf.x, v[0], v[1], v[2])
        variances = [self._variance(value, "EKF2_EVV_NOISE") for value in s.velocity_var]
        if not aid.active:
            if at.starts:
                if not self.aided:
                    self._reset(3, v, variances)
                aid.start(at.horizon_ns)
            return
        ok = self._gate_and_fuse(
            aid, 3, v, variances, self._params.real("EKF2_EVV_GATE"), at.quality_ok and not at.jumped
        )
        if ok:
            aid.fused_ns = at.horizon_ns
        elif (at.jumped and at.quality_ok) or self._failing(aid, at):
            self._reset(3, v, variances)
            aid.fused_ns = at.horizon_ns

    def _position(self, s: VisionSample, at: _Moment, wanted: bool) -> None:
        aid = self.position
        if not wanted or s.position_m is None:
            aid.stop()
            return
        p = (s.position_m[0] - self._offset[0], s.position_m[1] - self._offset[1])
        variances = [self._variance(value, "EKF2_EVP_NOISE") for value in s.position_var[:2]]
        if not aid.active:
            if at.starts:
                self._reset(6, p, variances)
                aid.start(at.horizon_ns)
            return
        ok = self._gate_and_fuse(
            aid, 6, p, variances, self._params.real("EKF2_EVP_GATE"), at.quality_ok and not at.jumped
        )
        if ok:
            aid.fused_ns = at.horizon_ns
        elif (at.jumped and at.quality_ok) or self._failing(aid, at):
            self._reset(6, p, variances)
            aid.fused_ns = at.horizon_ns
            self._started_ns = at.now_ns  # preflight has to see it stable anew

    def _height(self, s: VisionSample, at: _Moment, wanted: bool) -> None:
        aid, ekf = self.height, self._ekf
        if not wanted or s.position_m is None:
            aid.stop()
            return
        is_reference = self._params.integer("EKF2_HGT_REF") == HEIGHT_REF_VISION
        z = s.position_m[2]
        if is_reference and ekf.origin is not None:
            z += ekf.origin.alt_m  # vision's height is taken for absolute altitude
        variances = [self._variance(s.position_var[2], "EKF2_EVP_NOISE")]
        if not aid.active:
            if at.starts:
                if is_reference:
                    self._reset(8, (z,), variances)
                aid.start(at.horizon_ns)
            return
        ok = self._gate_and_fuse(
            aid, 8, (z,), variances, self._params.real("EKF2_EVP_GATE"), at.quality_ok and not at.jumped
        )
        if ok:
            aid.fused_ns = at.horizon_ns
        elif (at.jumped and at.quality_ok) or at.horizon_ns - aid.fused_ns > HEIGHT_TIMEOUT_NS:
            self._reset(8, (z,), variances)
            aid.fused_ns = at.horizon_ns

    def _gate_and_fuse(
        self, aid: Aid, first: int, measured: tuple[float, ...], variances: list[float], gate: float, allowed: bool
    ) -> bool:
        """Fuse all components or, if one fails its gate, none."""
        ekf = self._ekf
        aid.ratio = kernels.gate_and_fuse(ekf.x, ekf.P, first, measured, tuple(variances), gate, allowed)
        return allowed and not aid.ratio > 1.0

    def _reset(self, first: int, values: tuple[float, ...], variances: list[float]) -> None:
        for i, value in enumerate(values):
            self._ekf.shift(first + i, value)
            kernels.reset_block(self._ekf.P, first + i, 1, variances[i])
        self.reset_count += 1

    def origin_set(self, first: bool) -> None:
        """The origin came. Before vision it does no harm that lasts; while NED vision is fused it moves the vision's own
        origin by the distance to latitude and longitude 0: after a second of failing gates the position jumps there.
        """
        ekf = self._ekf
        if ekf.origin is None or not first:
            return
        north, east = ekf.origin.project(0.0, 0.0)
        if not self.position.active:
            ekf.shift(6, north + ekf.x[7])
            ekf.shift(7, east + ekf.x[8])
        elif self._previous is not None and self._previous.is_ned:
            self._offset = [north, east]
        if self.height_is_reference and ekf.origin.alt_m != 0.0:
            ekf.shift(8, ekf.x[9] + ekf.origin.alt_m)
