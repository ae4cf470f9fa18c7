"""How good and how fast is our registration beside the paper's and public packages, on the same scans?

    python -m benchmarks.registration [--seeds 1] [--seconds 120] [--json]

A drone flies along the walls of a 50 x 30 m hall with a pile: range noise 0.12 m, 512 points, 10 Hz, tilt wandering by
0.3 deg (tests/companion/odometry/hall.py, exact truth). Each method gets the same levelled, motion-compensated horizontal
layers of the same scans, and the same gyro increments of yaw as its guess. small_gicp matches each scan to the last
keyframe's and chains keyframes (a scan stands at three heights, since it is a 3D package); KISS-ICP keeps its own map; the
paper's sees keyframes only, from identity. Peers start at the true pose of the first scan; ours at take-off. Printed:
e_p over keyframes, median processor time of one registration of one scan, and both as ratios to ours.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from companion.config import CompanionConfig
from companion.messages import AttitudeSample, LidarScan, RangefinderSample
from companion.odometry import Odometry
from companion.odometry.paper import register_paper
from tests.companion.odometry.hall import Hall, Noise, lap, lidar_geometry, rectangle, stream, truth_in_map

Array = NDArray[np.float64]
PERIOD_S = 4.8
HEIGHTS_M = (-0.3, 0.0, 0.3)


@dataclass
class Frame:
    """A scan in level flight: layer (N, 2) levelled, yaw by the gyro, true x, y, yaw, our own pose."""

    layer: Array
    gyro_yaw: float
    truth: Array
    ours: Array
    is_keyframe: bool


@dataclass
class Score:
    errors: list[Array] = field(default_factory=list)
    ms: list[float] = field(default_factory=list)

    @property
    def e_p_m(self) -> float:
        return float(np.sqrt(np.mean(np.sum(np.square(self.errors), axis=1))))


def se2(x: float, y: float, yaw: float) -> Array:
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, x], [s, c, y], [0.0, 0.0, 1.0]])


def lift(t: Array) -> Array:
    """SE(2) as (4, 4)."""
    out = np.eye(4)
    out[:2, :2], out[:2, 3] = t[:2, :2], t[:2, 2]
    return out


def flatten(t: Array) -> Array:
    return se2(float(t[0, 3]), float(t[1, 3]), math.atan2(t[1, 0], t[0, 0]))


def solid(layer: Array) -> Array:
    """The layer at several heights, (3 N, 3)."""
    return np.concatenate([np.column_stack((layer, np.full(len(layer), z))) for z in HEIGHTS_M])


def record(seed: int, seconds: float, ours: Score) -> list[Frame]:
    """Fly, running our odometry; its registrations are timed as they happen."""
    hall = Hall([rectangle(50, 30)], 15.0, [(25, 15, 11, 7.5)])
    track, _ = lap(50, 30, 6.0, 0.43)
    odometry = Odometry(CompanionConfig.model_validate({"odometry": {"keyframe_period_s": PERIOD_S}}))
    register = odometry.walls.register

    def timed(*args: object, **kwargs: object) -> object:
        begin = time.process_time()
        result = register(*args, **kwargs)  # type: ignore[arg-type]
        ours.ms.append((time.process_time() - begin) * 1e3)
        return result

    odometry.walls.register = timed  # type: ignore[method-assign,assignment]
    frames: list[Frame] = []
    t0, gyro_yaw, last_ns, first_ns = None, 0.0, 0, 0
    for m in stream(hall, track, lidar_geometry(), Noise(), seed):
        if isinstance(m, AttitudeSample):
            gyro_yaw += m.rate_body_radps[2] * (m.t_ns - last_ns) * 1e-9
            last_ns = m.t_ns
            odometry.on_attitude(m)
        elif isinstance(m, RangefinderSample):
            odometry.on_rangefinder(m)
        elif isinstance(m, LidarScan):
            result = odometry.on_scan(m)
            t0 = m.t_ns if t0 is None else t0
            true = truth_in_map(track, m.t_ns, t0)
            if result is None or (true[2] < 8.79 and not frames):
                continue
            first_ns = first_ns or m.t_ns
            if m.t_ns - first_ns > seconds * 1e9 or true[2] < 8.79:
                break
            level = result.levelled
            layer = np.ascontiguousarray(level.points_level[level.row == 0, :2])
            index = round((m.t_ns - first_ns) / 1e8)
            is_keyframe = index % round(PERIOD_S * 10) == 0
            position = result.estimate.position_map_m
            frames.append(Frame(layer, gyro_yaw, true[[0, 1, 3]], position[:2], is_keyframe))
            if is_keyframe:
                ours.errors.append(position[:2] - true[:2])
    return frames


def score_paper(frames: list[Frame]) -> Score:
    score, keyframes = Score(), [f for f in frames if f.is_keyframe]
    pose = se2(*keyframes[0].truth)
    for before, now in pairwise(keyframes):
        begin = time.process_time()
        found = register_paper(before.layer, now.layer, np.hypot(*now.layer.T))
        score.ms.append((time.process_time() - begin) * 1e3)
        step = np.eye(3)
        step[:2, :2], step[:2, 2] = found.rotation, found.translation
        pose = pose @ step
        score.errors.append(pose[:2, 2] - now.truth[:2])
    return score


def score_chain(frames: list[Frame], match: Callable[[Array, Array, Array], Array]) -> Score:
    """Each scan to the last keyframe's; guess: where it was a scan ago, moved on alike, turned by the gyro."""
    score, anchor, pose_anchor = Score(), frames[0], se2(*frames[0].truth)
    relative, velocity, previous = np.eye(3), np.zeros(2), frames[0]
    for now in frames[1:]:
        guess = relative.copy()
        guess[:2, :2] = relative[:2, :2] @ se2(0, 0, now.gyro_yaw - previous.gyro_yaw)[:2, :2]
        guess[:2, 2] += velocity
        begin = time.process_time()
        found = match(anchor.layer, now.layer, guess)
        score.ms.append((time.process_time() - begin) * 1e3)
        velocity = 0.8 * velocity + 0.2 * (found[:2, 2] - relative[:2, 2])
        relative, previous = found, now
        if now.is_keyframe:
            pose_anchor = pose_anchor @ found
            velocity = found[:2, :2].T @ velocity
            anchor, relative = now, np.eye(3)
            score.errors.append(pose_anchor[:2, 2] - now.truth[:2])
    return score


def small_gicp_matcher(kind: str) -> Callable[[Array, Array, Array], Array]:
    import small_gicp

    def match(target: Array, source: Array, guess: Array) -> Array:
        result = small_gicp.align(
            solid(target),
            solid(source),
            lift(guess),
            registration_type=kind,
            downsampling_resolution=0.02,
            max_correspondence_distance=1.0,
            num_threads=1,
        )
        return flatten(np.asarray(result.T_target_source))

    return match


def score_kiss(frames: list[Frame]) -> Score:
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    config = KISSConfig()
    config.data.deskew, config.data.max_range = False, 60.0
    config.mapping.voxel_size = 0.5
    config.registration.max_num_threads = 1
    kiss, score, start = KissICP(config), Score(), se2(*frames[0].truth)
    for k, now in enumerate(frames):
        points = solid(now.layer)
        begin = time.process_time()
        kiss.register_frame(points, np.zeros(len(points)))
        score.ms.append((time.process_time() - begin) * 1e3)
        if now.is_keyframe and k > 0:
            pose = start @ flatten(np.asarray(kiss.last_pose))
            score.errors.append(pose[:2, 2] - now.truth[:2])
    return score


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=120.0, help="of level flight")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    table: dict[str, Score] = {}
    for seed in range(options.seeds):
        ours = Score()
        frames = record(seed, options.seconds, ours)
        scores = {
            "stockpilot": ours,
            "the paper's": score_paper(frames),
            "small_gicp ICP": score_chain(frames, small_gicp_matcher("ICP")),
            "small_gicp plane ICP": score_chain(frames, small_gicp_matcher("PLANE_ICP")),
            "small_gicp GICP": score_chain(frames, small_gicp_matcher("GICP")),
            "KISS-ICP": score_kiss(frames),
        }
        for name, score in scores.items():
            total = table.setdefault(name, Score())
            total.errors += score.errors
            total.ms += score.ms
    base = table["stockpilot"]
    base_ms = float(np.median(base.ms))
    rows = [
        {
            "method": name,
            "e_p_m": score.e_p_m,
            "e_p_ratio": score.e_p_m / base.e_p_m,
            "ms": float(np.median(score.ms)),
            "ms_ratio": float(np.median(score.ms)) / base_ms,
            "registrations": len(score.ms),
        }
        for name, score in table.items()
    ]
    if options.json:
        print(json.dumps(rows))
        return
    print(f"{'method':22} {'e_p, m':>8} {'x ours':>8} {'ms':>8} {'x ours':>8} {'registrations':>14}")
    for r in rows:
        print(
            f"{r['method']:22} {r['e_p_m']:8.4f} {r['e_p_ratio']:8.1f} {r['ms']:8.2f} {r['ms_ratio']:8.1f}"
            f" {r['registrations']:14d}"
        )


if __name__ == "__main__":
    main()
