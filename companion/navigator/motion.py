"""Velocities in map: towards a place, along a steering, at the mission's height."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from companion.messages import Array
from companion.navigator.wall_follower import Pose2, Steering

PLACE_GAIN_PER_S = 0.5
HEIGHT_GAIN_PER_S = 0.8


@dataclass(frozen=True, slots=True)
class Motion:
    """Wanted velocity in map (3,) and yaw rate."""

    velocity_mps: Array
    yaw_rate_radps: float = 0.0


STILL = Motion(np.zeros(3))


def towards(pose: Pose2, place: tuple[float, float], speed_mps: float, up_mps: float, yaw_rate: float = 0.0) -> Motion:
    """To a place, slower as it comes near."""
    dx, dy = place[0] - pose.x, place[1] - pose.y
    distance = math.hypot(dx, dy)
    ratio = min(speed_mps, PLACE_GAIN_PER_S * distance) / max(distance, 1e-6)
    return Motion(np.array([ratio * dx, ratio * dy, up_mps]), yaw_rate)


def steered(steering: Steering, pose: Pose2, up_mps: float) -> Motion:
    """Forward and left of the body's heading."""
    c, s = math.cos(pose.yaw), math.sin(pose.yaw)
    forward, left = steering.forward_mps, steering.left_mps
    return Motion(np.array([c * forward - s * left, s * forward + c * left, up_mps]), steering.yaw_rate_radps)


def climb_rate(height_m: float, wanted_m: float, limit_mps: float) -> float:
    """Up or down towards a height, slower as it comes near."""
    return max(-limit_mps, min(limit_mps, HEIGHT_GAIN_PER_S * (wanted_m - height_m)))
