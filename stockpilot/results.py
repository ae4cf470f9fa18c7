"""What a flight in the emulated store leaves behind: scores against truth, report.json, clouds, trajectory, pictures."""

from __future__ import annotations

import math
import resource
from dataclasses import dataclass
from typing import Any

import numpy as np

from companion.flight import Flight
from companion.geometry import quat_from_rpy, rpy_from_quat, yaw_from_quat
from companion.mapping import Mapper
from companion.messages import Array, OdometryEstimate, PointMap, VolumeReport
from companion.odometry.paper import PaperPipeline
from companion.volume import estimate_volume
from companion.volume.paper import paper_volume
from simbridge.world import World
from stockpilot.files import turned_keys, volume_keys
from stockpilot.lockstep import Outcome
from stockpilot.mission import Mission
from stockpilot.score import MapPin, PoseScore, cramer_rao_bound_m, pin_map, score_poses, wall_distance_rms_m

AT_HEIGHT_M = 0.5  # the paper's pipeline sees the scans this near to the mission's height


@dataclass(slots=True)
class Scored:
    """A flight with its scores, ready to be written and drawn."""

    report: dict[str, Any]
    volume: VolumeReport | None
    point_map: PointMap
    pin: MapPin
    paper_path_map_m: Array  # (K, 2)


def score_flight(
    mission: Mission, flight: Flight, world: World, outcome: Outcome, *, autopilot: str, min_clearance_m: float,
    collision: bool, with_perfect_poses: bool = False,
) -> Scored:  # fmt: skip
    """Score both pipelines of one flight. See issue and docs for the keys of the report."""
    point_map = flight.mapper.point_map()
    volume = flight.measure(point_map) if len(point_map.points_map) else None
    began_ns = outcome.estimates[0].t_scan_ns if outcome.estimates else int(outcome.truth.t_ns[0])
    pin = pin_map(outcome.truth, began_ns)
    keyframes = [result.estimate for _, result in outcome.keyframe_scans]
    ours = _score_estimates(outcome, pin, keyframes)
    outline = world.outlines()
    truth_volume = world.true_volume_m3
    keyframe_t = np.array([e.t_scan_ns for e in keyframes], dtype=np.int64)
    sensor = mission.companion.lidar
    paper, paper_path = _paper(mission, outcome, pin, truth_volume)
    navigation = flight.navigation
    report: dict[str, Any] = {
        "mission": mission.name,
        "seed": mission.seed,
        "autopilot": autopilot,
        "state": outcome.state,
        "reason": outcome.reason,
        "forward_speed_mps": mission.companion.navigator.forward_speed_mps,
        "scan_period_s": mission.companion.odometry.keyframe_period_s,
        "wall_distance_m": mission.companion.navigator.wall_distance_m,
        "height_m": mission.companion.navigator.height_m,
        "flight_time_s": outcome.flight_time_s,
        "simulated_s": outcome.simulated_s,
        "wall_time_s": outcome.wall_time_s,
        "real_time_factor": outcome.simulated_s / max(outcome.wall_time_s, 1e-9),
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "scans": flight.scans,
        "keyframes": len(keyframes),
        "lap_closed": bool(navigation is not None and navigation.lap_closed),
        "collision": collision,
        "min_clearance_m": min_clearance_m,
        "wall_distance_rms_m": wall_distance_rms_m(
            outcome.truth, world.wall_outlines(), mission.companion.navigator.wall_distance_m
        ),
        "landed_from_start_m": _landed_from_start(outcome),
        **volume_scores(volume, truth_volume),
        **turned_keys(flight.lidar_turned_by),
        "odometry_max_gap_s": outcome.odometry_max_gap_s,
        "e_p_m": ours.e_p_m,
        "e_p_xy_m": ours.e_p_xy_m,
        "e_z_m": ours.e_z_m,
        "e_yaw_deg": ours.e_yaw_deg,
        "c_c": sum(e.iterations for e in keyframes),
        "cramer_rao_bound_m": cramer_rao_bound_m(
            outcome.truth, keyframe_t, outline, noise_m=mission.sim.lidar.noise_m if mission.sim else 0.0,
            max_range_m=sensor.max_range_m, columns=sensor.columns,
        ),
        "degenerate_ratio": float(np.mean([e.is_degenerate for e in outcome.estimates])) if outcome.estimates else None,
        "paper": paper,
        "crossed_sha256": outcome.crossed_sha256,
        "events": [
            {"t_s": (e.t_ns - int(outcome.truth.t_ns[0])) * 1e-9, "severity": e.severity.name, "name": e.name, "text": e.text}
            for e in flight.events
        ],
    }  # fmt: skip
    if with_perfect_poses:
        perfect = _volume_with_perfect_poses(mission, outcome, pin)
        report["e_v_percent_perfect_poses"] = _error_percent(perfect, truth_volume)
    return Scored(report=report, volume=volume, point_map=point_map, pin=pin, paper_path_map_m=paper_path)


def volume_scores(volume: VolumeReport | None, truth_m3: float) -> dict[str, Any]:
    """The report's keys that follow from the measured volume."""
    return {
        **volume_keys(volume),
        "truth_volume_m3": truth_m3,
        "e_v_percent": _error_percent(volume.volume_m3 if volume else None, truth_m3),
        "truth_in_interval": bool(volume and volume.interval_m3[0] <= truth_m3 <= volume.interval_m3[1]),
    }


def _score_estimates(outcome: Outcome, pin: MapPin, estimates: list[OdometryEstimate]) -> PoseScore:
    return score_poses(
        outcome.truth,
        pin,
        np.array([e.t_scan_ns for e in estimates], dtype=np.int64),
        np.array([e.position_map_m for e in estimates], dtype=np.float64).reshape(-1, 3),
        np.array([yaw_from_quat(e.q_map_body_wxyz) for e in estimates], dtype=np.float64),
    )


def _paper(mission: Mission, outcome: Outcome, pin: MapPin, truth_volume_m3: float) -> tuple[dict[str, Any], Array]:
    """The paper's pipeline on the same keyframe scans, from the first at the desired height on (section 2.2), pinned to
    the true pose there. It takes z = h as given, so its position error is horizontal."""
    pipeline = PaperPipeline(mission.companion)
    height_m = mission.companion.navigator.height_m
    for scan, result in outcome.keyframe_scans:
        if abs(result.estimate.position_map_m[2] - height_m) > AT_HEIGHT_M:
            continue
        if not pipeline.t_ns:
            position, yaw = outcome.truth.pose_at(np.array([scan.t_ns]))
            x, y, _ = pin.to_map(position)[0]
            pipeline.on_keyframe_scan(scan, start_pose_map=(float(x), float(y), float(yaw[0]) - pin.yaw_rad))
        else:
            pipeline.on_keyframe_scan(scan)
    if not pipeline.t_ns:
        return {"volume_m3": None, "e_v_percent": None, "e_p_m": None, "e_yaw_deg": None, "c_c": 0}, np.zeros((0, 2))
    poses = np.array(pipeline.poses, dtype=np.float64)
    volume = paper_volume(pipeline.map_points)
    t_ns = np.array(pipeline.t_ns, dtype=np.int64)
    position, _ = outcome.truth.pose_at(t_ns)
    height = pin.to_map(position)[:, 2:3]
    score = score_poses(outcome.truth, pin, t_ns, np.column_stack([poses[:, :2], height]), poses[:, 3])
    return {
        "volume_m3": volume,
        "e_v_percent": _error_percent(volume, truth_volume_m3),
        "e_p_m": score.e_p_m,
        "e_yaw_deg": score.e_yaw_deg,
        "c_c": pipeline.c_c,
        "scans": len(pipeline.t_ns),
    }, poses[:, :2]


def _volume_with_perfect_poses(mission: Mission, outcome: Outcome, pin: MapPin) -> float | None:
    """The same scans placed by the true poses: what is left is sensing and surface, not odometry."""
    import dataclasses

    mapper = Mapper(mission.companion)
    for scan in outcome.mapped_scans:
        estimate = scan.estimate
        position, yaw = outcome.truth.pose_at(np.array([estimate.t_scan_ns]))
        roll, pitch, _ = rpy_from_quat(estimate.q_map_body_wxyz)
        true = dataclasses.replace(
            estimate,
            position_map_m=pin.to_map(position)[0],
            q_map_body_wxyz=quat_from_rpy(roll, pitch, float(yaw[0]) - pin.yaw_rad),
        )
        mapper.add(scan.levelled, true)
    point_map = mapper.point_map()
    return estimate_volume(point_map, mission.companion.volume).volume_m3 if len(point_map.points_map) else None


def _landed_from_start(outcome: Outcome) -> float:
    path = outcome.truth.position_world_m
    return float(np.hypot(*(path[-1, :2] - path[0, :2])))


def _error_percent(volume_m3: float | None, truth_m3: float) -> float | None:
    if volume_m3 is None or truth_m3 <= 0 or not math.isfinite(volume_m3):
        return None
    return 100.0 * (volume_m3 - truth_m3) / truth_m3
