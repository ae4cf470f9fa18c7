from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from simbridge.sitl.truth import magnetic_field_frd_gauss, q_ned_frd_wxyz, rotate_inverse
from tests.simbridge.sitl.recordings import decode, tlog_frames
from tests.simbridge.sitl.test_ardupilot import StandingPose


def pose(q: list[float]) -> StandingPose:
    return StandingPose(np.zeros(3), np.zeros(3), np.array(q))


def test_rotation_agrees_with_scipy() -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        q, v = rng.normal(size=4), rng.normal(size=3)
        q /= np.linalg.norm(q)
        expected = Rotation.from_quat(q, scalar_first=True).inv().apply(v)
        assert rotate_inverse(q, v) == pytest.approx(expected, abs=1e-12)


def test_a_nose_turned_left_in_world_is_a_negative_yaw_in_ned() -> None:
    yaw = math.radians(40.0)
    q = q_ned_frd_wxyz(np.array([math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)]))
    assert Rotation.from_quat(q, scalar_first=True).as_euler("ZYX", degrees=True)[0] == pytest.approx(-40.0)


def test_facing_north_the_field_is_the_recorded_one() -> None:
    recorded = decode(next(f for _, f in tlog_frames("autopilots", "px4", "hil_lockstep.to_fc.tlog")))
    field = magnetic_field_frd_gauss(pose([1.0, 0.0, 0.0, 0.0]), np.zeros(3))
    assert field == pytest.approx([recorded.xmag, recorded.ymag, recorded.zmag], abs=0.003)


def test_facing_west_north_is_to_the_right() -> None:
    """x of world is north, so a quarter turn to the left looks west."""
    field = magnetic_field_frd_gauss(pose([math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]), np.zeros(3))
    assert field == pytest.approx([-0.01, 0.215, 0.425], abs=1e-9)
