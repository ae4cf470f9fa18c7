"""What the navigator knows at one step: where it is, what it sees, how well."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from companion.config import CompanionConfig
from companion.geometry import yaw_from_quat
from companion.messages import FlightMode, OdometryEstimate, VehicleState
from companion.navigator.follow import FollowWatch
from companion.navigator.interface import NavigatorInput
from companion.navigator.scan_view import ScanView
from companion.navigator.wall_follower import Pose2
from companion.navigator.watch import Vision, VisionWatch


@dataclass(frozen=True, slots=True)
class Situation:
    """pose, z_m: the newest good ones, map. view: of a scan not seen before, taken at view_pose; else None. unfollowed:
    why the vehicle is believed not to do what it is told; empty while it does."""

    t_ns: int
    vehicle: VehicleState | None
    vision: Vision
    pose: Pose2
    z_m: float
    view: ScanView | None
    view_pose: Pose2
    unfollowed: str = ""

    def since_s(self, t_ns: int | None) -> float:
        return (self.t_ns - t_ns) / 1e9 if t_ns is not None else 0.0


NOTHING_YET = Situation(
    0, None, Vision(False, "nothing came yet", 1.0, 0.0, False), Pose2(0.0, 0.0, 0.0), 0.0, None, Pose2(0.0, 0.0, 0.0)
)


class Lookout:
    """Builds the situation. Poses are kept for two seconds, so that a scan is placed where it was taken."""

    def __init__(self, config: CompanionConfig) -> None:
        self._watch = VisionWatch(config.guard, config.lidar)
        self._follow = FollowWatch()
        self._poses: deque[tuple[int, Pose2]] = deque(maxlen=40)
        self._scan_ns = -1
        self._last = NOTHING_YET

    def look(self, t_ns: int, inputs: NavigatorInput) -> Situation:
        vehicle = inputs.vehicle
        is_fused = vehicle is None or not vehicle.is_armed or vehicle.is_vision_fused
        vision = self._watch.step(t_ns, inputs.estimate, inputs.walls, is_fused=is_fused)
        pose, z, view, view_pose = self._last.pose, self._last.z_m, None, self._last.view_pose
        if inputs.estimate is not None and vision.is_good:
            pose, z = self._place(inputs.estimate)
            if inputs.walls is not None and inputs.walls.t_ns > self._scan_ns:
                self._scan_ns = inputs.walls.t_ns
                view, view_pose = ScanView.of(inputs.walls), self._pose_at(inputs.walls.t_ns)
        is_ours = vehicle is not None and vehicle.is_armed and vehicle.mode is FlightMode.OFFBOARD
        estimate = inputs.estimate if vision.is_good else None
        unfollowed = self._follow.step(t_ns, inputs.sent if is_ours else None, estimate)
        self._last = Situation(t_ns, vehicle, vision, pose, z, view, view_pose, unfollowed)
        return self._last

    def _place(self, estimate: OdometryEstimate) -> tuple[Pose2, float]:
        x, y, z = (float(v) for v in estimate.position_map_m)
        pose = Pose2(x, y, yaw_from_quat(estimate.q_map_body_wxyz))
        if not self._poses or estimate.t_ns > self._poses[-1][0]:
            self._poses.append((estimate.t_ns, pose))
        return pose, z

    def _pose_at(self, t_ns: int) -> Pose2:
        """The pose nearest in time, looked for from the newest back."""
        best = self._poses[-1]
        for known in reversed(self._poses):
            if abs(known[0] - t_ns) > abs(best[0] - t_ns):
                break
            best = known
        return best[1]
