"""Whether the vehicle does what it is told. An autopilot that no longer gets our setpoints may say nothing: ArduCopter
stops after 3 s and holds in GUIDED (ARDUPILOT.md). Only what it does tells: so what was asked is compared with what was
done."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from companion.geometry import wrap_angle, yaw_from_quat
from companion.messages import OdometryEstimate, Setpoint

WINDOW_NS = 3_000_000_000
LASTING_NS = 1_500_000_000  # a start or a change of direction is over by then
MAX_STEP_S = 0.3  # between two setpoints; longer is a pause, in which nothing was asked
LEAST_M = 0.6  # asked within the window, to be judged at all: 0.2 m/s
LEAST_RAD = math.radians(20.0)
DONE_RATIO = 0.25


@dataclass(frozen=True, slots=True)
class _Trace:
    """Asked and done since it began to be watched: m in map, rad."""

    t_ns: int
    asked: tuple[float, float, float]
    done: tuple[float, float, float]


class FollowWatch:
    """Horizontal motion and turning, asked and done, over the last three seconds."""

    def __init__(self) -> None:
        self._traces: deque[_Trace] = deque()
        self._since_ns: int | None = None
        self._reset_counter = 0

    def step(self, t_ns: int, sent: Setpoint | None, estimate: OdometryEstimate | None) -> str:
        """Why it is believed not to follow; empty while it does, or while that cannot be said.

        sent: what left for the autopilot at the step before; None: nothing did, or it was not to follow. estimate: a
        good one; None: none is.
        """
        if sent is None or estimate is None or estimate.is_degenerate or self._has_paused(t_ns, estimate):
            self._restart(estimate)
        if sent is not None and estimate is not None:
            self._note(t_ns, sent, estimate)
        why = self._unfollowed()
        if not why:
            self._since_ns = None
            return ""
        self._since_ns = t_ns if self._since_ns is None else self._since_ns
        return why if t_ns - self._since_ns >= LASTING_NS else ""

    def _has_paused(self, t_ns: int, estimate: OdometryEstimate) -> bool:
        paused = bool(self._traces) and t_ns - self._traces[-1].t_ns > MAX_STEP_S * 1e9
        return paused or estimate.reset_counter != self._reset_counter

    def _restart(self, estimate: OdometryEstimate | None) -> None:
        self._traces.clear()
        self._since_ns = None
        if estimate is not None:
            self._reset_counter = estimate.reset_counter

    def _note(self, t_ns: int, sent: Setpoint, estimate: OdometryEstimate) -> None:
        vx, vy, _ = sent.velocity_map_mps.tolist()
        x, y, _ = estimate.position_map_m.tolist()
        yaw, asked = yaw_from_quat(estimate.q_map_body_wxyz), (0.0, 0.0, 0.0)
        if self._traces:
            last = self._traces[-1]
            dt = (t_ns - last.t_ns) / 1e9
            ax, ay, turn = last.asked
            asked = (ax + vx * dt, ay + vy * dt, turn + sent.yaw_rate_radps * dt)
            yaw = last.done[2] + wrap_angle(yaw - last.done[2])
        self._traces.append(_Trace(t_ns, asked, (x, y, yaw)))
        while t_ns - self._traces[0].t_ns > WINDOW_NS:
            self._traces.popleft()

    def _unfollowed(self) -> str:
        if len(self._traces) < 2:
            return ""
        begin, end = self._traces[0], self._traces[-1]
        ax, ay, asked_turn = (after - before for before, after in zip(begin.asked, end.asked, strict=True))
        dx, dy, turned = (after - before for before, after in zip(begin.done, end.done, strict=True))
        asked_m = math.hypot(ax, ay)
        if asked_m >= LEAST_M and (ax * dx + ay * dy) / asked_m < DONE_RATIO * asked_m:
            return f"asked to move {asked_m:.1f} m, it moved {(ax * dx + ay * dy) / asked_m:.1f} m"
        if abs(asked_turn) >= LEAST_RAD and turned * math.copysign(1.0, asked_turn) < DONE_RATIO * abs(asked_turn):
            return f"asked to turn {math.degrees(asked_turn):.0f} deg, it turned {math.degrees(turned):.0f} deg"
        return ""
