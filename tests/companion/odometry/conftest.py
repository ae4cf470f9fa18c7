"""Flights that several tests look at, flown once."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.config import CompanionConfig
from companion.geometry import yaw_from_quat
from companion.messages import AttitudeSample, LidarScan, OdometryEstimate, RangefinderSample
from companion.odometry import Odometry, ScanResult
from companion.odometry.paper import PaperPipeline
from tests.companion.odometry.hall import Hall, Noise, Track, lap, lidar_geometry, rectangle, stream, truth_in_map

Message = AttitudeSample | RangefinderSample | LidarScan
CONFIG = CompanionConfig.model_validate({"odometry": {"keyframe_period_s": 3.2}})


@dataclass
class Flown:
    """A flight and what the odometry made of it. error: (N, 4) x, y, z, yaw for each scan; truth: (N, 4)."""

    track: Track
    messages: list[Message]
    odometry: Odometry
    results: list[ScanResult]
    predicted: list[OdometryEstimate]
    truth: NDArray[np.float64]
    error: NDArray[np.float64]
    paper: PaperPipeline
    paper_error: NDArray[np.float64]


def error_of(estimate: OdometryEstimate, truth: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4,) x, y, z, yaw."""
    e = np.array([*estimate.position_map_m, yaw_from_quat(estimate.q_map_body_wxyz)]) - truth
    e[3] = (e[3] + np.pi) % (2 * np.pi) - np.pi
    return e


def feed(odometry: Odometry, messages: Iterable[Message]) -> list[ScanResult]:
    results = []
    for message in messages:
        if isinstance(message, AttitudeSample):
            odometry.on_attitude(message)
        elif isinstance(message, RangefinderSample):
            odometry.on_rangefinder(message)
        else:
            result = odometry.on_scan(message)
            if result is not None:
                results.append(result)
    return results


def fly_through(track: Track, messages: list[Message]) -> Flown:
    odometry, paper = Odometry(CONFIG), PaperPipeline(CONFIG)
    results, predicted, truth, error, paper_error = [], [], [], [], []
    t0 = next(m.t_ns for m in messages if isinstance(m, LidarScan))
    for message in messages:
        if not isinstance(message, LidarScan):
            feed(odometry, [message])
            continue
        (result,) = feed(odometry, [message])
        true = truth_in_map(track, message.t_ns, t0)
        results.append(result)
        truth.append(true)
        error.append(error_of(result.estimate, true))
        ahead = odometry.predict(message.t_ns + 60_000_000)
        assert ahead is not None
        predicted.append(ahead)
        if result.keyframe and true[2] > 8.5:
            e = result.estimate
            x, y, yaw = e.position_map_m[0], e.position_map_m[1], yaw_from_quat(e.q_map_body_wxyz)
            paper.on_keyframe_scan(message, (x, y, yaw))
            paper_error.append(np.array(paper.poses[-1][:2]) - true[:2])
    return Flown(
        track, messages, odometry, results, predicted, np.array(truth), np.array(error), paper, np.array(paper_error)
    )


@pytest.fixture(scope="session")
def flown() -> Flown:
    """A lap of a 34 x 24 m hall with a pile, range noise 0.12 m, attitude wandering by 0.3 deg."""
    hall = Hall([rectangle(34, 24)], 15.0, [(17, 12, 7, 5.0)])
    track, _ = lap(34, 24, 5.0, 0.5)
    return fly_through(track, list(stream(hall, track, lidar_geometry(), Noise(), seed=3)))
