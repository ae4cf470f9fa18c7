"""Whether the vehicle does what it is told. An autopilot that no longer gets our setpoints may say nothing: ArduCopter
stops after GUID_TIMEOUT and holds in GUIDED (ARDUPILOT.md). Only what it does tells: so what was asked is compared with what was
done.

Gusts carry a vehicle that follows off its way too. They do not carry it ever farther, as it flies against them: so where
the last half minute has shown much of that, a longer way is looked at before anything is said.
"""

from __future__ import annotations

import math
import statistics
from bisect import bisect_left
from collections import deque
from dataclasses import dataclass
from operator import attrgetter

from companion.geometry import wrap_angle, yaw_from_quat
from companion.messages import OdometryEstimate, Setpoint

WINDOW_NS = 3_000_000_000
WINDOWS_NS = (WINDOW_NS, 5_000_000_000, 8_000_000_000, 12_000_000_000)  # the longest is judged whatever gusts do
LASTING_NS = 1_500_000_000  # a start or a change of direction is over by then
MAX_STEP_S = 0.3  # between two setpoints; longer is a pause, in which nothing was asked
LEAST_MPS = 0.2  # asked on the mean of a window, to be judged at all
GUSTS_RATIO = 6.0  # asked within a window over what the vehicle usually was off after three seconds, likewise
USUAL_EVERY_NS = 500_000_000
USUAL_COUNT = 60  # half a minute: a vehicle that has just stopped following does not yet show in the median
USUAL_AT_FIRST = (0.3,) * 20  # m; until ten seconds have told
LEAST_RAD = math.radians(20.0)
DONE_RATIO = 0.25


@dataclass(frozen=True, slots=True)
class _Trace:
    """Asked and done since it began to be watched: m in map, rad."""

    t_ns: int
    asked: tuple[float, float, float]
    done: tuple[float, float, float]


_t_ns = attrgetter("t_ns")


class FollowWatch:
    """Horizontal motion and turning, asked and done, over the last three seconds; over more of them in gusts."""

    def __init__(self) -> None:
        self._traces: deque[_Trace] = deque()
        # What done was off asked over WINDOW_NS, time after time.
        self._off_m: deque[float] = deque(USUAL_AT_FIRST, maxlen=USUAL_COUNT)
        self._usual_m = statistics.median(self._off_m)
        self._off_ns = 0
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
        while t_ns - self._traces[0].t_ns > WINDOWS_NS[-1]:
            self._traces.popleft()
        if t_ns - self._off_ns >= USUAL_EVERY_NS and t_ns - self._traces[0].t_ns >= WINDOW_NS:
            (ax, ay, _), (dx, dy, _) = self._within(WINDOW_NS)
            self._off_m.append(math.hypot(dx - ax, dy - ay))
            self._usual_m = statistics.median(self._off_m)
            self._off_ns = t_ns

    def _within(self, window_ns: int) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Asked and done within the last so many ns, or since it began to be watched."""
        end = self._traces[-1]
        begin = self._traces[bisect_left(self._traces, end.t_ns - window_ns, key=_t_ns)]
        (a, b, c), (ax, ay, asked_turn) = begin.asked, end.asked
        (d, e, f), (dx, dy, turned) = begin.done, end.done
        return (ax - a, ay - b, asked_turn - c), (dx - d, dy - e, turned - f)

    def _unfollowed(self) -> str:
        if len(self._traces) < 2:
            return ""
        usual_m = self._usual_m
        for window_ns in WINDOWS_NS:
            (ax, ay, _), (dx, dy, _) = self._within(window_ns)
            asked_m = math.hypot(ax, ay)
            if asked_m < LEAST_MPS * window_ns * 1e-9:
                continue
            if asked_m >= GUSTS_RATIO * usual_m or window_ns == WINDOWS_NS[-1]:
                done_m = (ax * dx + ay * dy) / asked_m
                if done_m < DONE_RATIO * asked_m:
                    return f"asked to move {asked_m:.1f} m, it moved {done_m:.1f} m"
                break
        (_, _, asked_turn), (_, _, turned) = self._within(WINDOW_NS)
        if abs(asked_turn) >= LEAST_RAD and turned * math.copysign(1.0, asked_turn) < DONE_RATIO * abs(asked_turn):
            return f"asked to turn {math.degrees(asked_turn):.0f} deg, it turned {math.degrees(turned):.0f} deg"
        return ""
