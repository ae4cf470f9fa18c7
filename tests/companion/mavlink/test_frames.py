"""NED and FRD against map and FLU: signs settled by what a real autopilot sent."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from companion.geometry import matrix_from_quat, quat_from_rpy, yaw_from_quat
from companion.mavlink import frames, wire
from tests.companion.mavlink.tlog import read_tlog
from tests.shared_data import shared_data

angles = st.floats(-3.0, 3.0)


def test_left_of_map_is_west_and_up_is_minus_down() -> None:
    assert frames.flip(np.array([1.0, 2.0, 3.0])) == (1.0, -2.0, -3.0)


@given(st.tuples(*[st.floats(-1e4, 1e4)] * 3))
def test_there_and_back_is_the_same_place(vector: tuple[float, float, float]) -> None:
    assert tuple(frames.vector_from_frd(*frames.flip(np.array(vector)))) == vector


@given(angles, st.floats(-1.5, 1.5), angles)
def test_a_point_seen_in_the_body_is_the_same_point_in_both_worlds(roll: float, pitch: float, yaw: float) -> None:
    """PX4.md: "it must be body-FRD to NED/FRD always"."""
    q = quat_from_rpy(roll, pitch, yaw)
    point_flu = np.array([1.0, 2.0, 3.0])
    q_ned = np.array(frames.quaternion_to_ned_frd(q))
    in_ned = matrix_from_quat(q_ned) @ frames.vector_from_frd(*point_flu)
    assert np.allclose(frames.vector_from_frd(*in_ned), matrix_from_quat(q) @ point_flu)


@given(angles, st.floats(-1.5, 1.5), angles, st.floats(0.999, 1.001))
def test_quaternion_norm_in_float32_is_within_1e5(roll: float, pitch: float, yaw: float, scale: float) -> None:
    """AUTOPILOTS.md: PX4 ignores a quaternion whose norm is off by more than 1e-5. PX4.md: "Quaternion must have
    |norm-1| <= 1e-5, otherwise EKF2 drops the attitude"."""
    q = np.array(frames.quaternion_to_ned_frd(quat_from_rpy(roll, pitch, yaw) * scale), dtype=np.float32)
    assert abs(math.sqrt(float((q.astype(np.float64) ** 2).sum())) - 1.0) < 1e-6


def test_no_rotation_is_told_and_not_guessed() -> None:
    nan = float("nan")
    assert frames.quaternion_from_ned_frd(0, 0, 0, 0) is None
    assert frames.quaternion_from_ned_frd(nan, 0, 0, 1) is None


def test_turning_left_lowers_the_heading_of_ned() -> None:
    w, x, y, z = frames.quaternion_to_ned_frd(quat_from_rpy(0, 0, 0.5))
    assert math.isclose(2 * math.atan2(z, w), -0.5)
    assert math.isclose(yaw_from_quat(np.array(frames.quaternion_from_ned_frd(w, x, y, z))), 0.5)


def test_pose_covariance_changes_sign_where_one_axis_is_turned() -> None:
    covariance = np.arange(36.0).reshape(6, 6)
    covariance = covariance + covariance.T
    got = frames.pose_covariance_to_ned(covariance)
    sign = np.diag([1.0, -1, -1, 1, -1, -1])
    assert np.array_equal(got, (sign @ covariance @ sign)[np.triu_indices(6)])


def test_velocity_covariance_says_nan_for_turn_rates() -> None:
    """AUTOPILOTS.md: unset values are NaN. PX4.md: "Unset values = NaN"."""
    covariance = np.array([[1.0, 2, 3], [2, 4, 5], [3, 5, 6]])
    got = np.full((6, 6), np.nan)
    got[np.triu_indices(6)] = frames.velocity_covariance_to_frd(covariance)
    assert got[:3, :3][np.triu_indices(3)].tolist() == [1.0, -2.0, -3.0, 4.0, 5.0, 6.0]
    assert np.isnan(got[3:][np.triu_indices(3)[0], 3 + np.triu_indices(3)[1]]).all()


def test_real_px4_agrees_with_our_signs_in_flight() -> None:
    """The recording companion flew the square (4,0), (4,4): first north, then east, heading north. In map that is
    forward, then right: y negative; and 3 m high is +3."""
    records = read_tlog(shared_data("autopilots", "px4", "ev_offboard.from_fc.tlog"))
    t0 = records[0][0]
    at = {}
    for t_us, data in records:
        if data[7] == wire.LOCAL_POSITION_NED and data[8:10] == b"\0\0":
            _, x, y, z, *_ = wire.unpack(wire.LOCAL_POSITION_NED, data[10:-2])
            at[round((t_us - t0) / 1e6, 1)] = frames.vector_from_frd(x, y, z)
    corner = min(at, key=lambda t: abs(t - 81.7))
    assert np.allclose(at[corner], [4.0, -4.0, 3.0], atol=0.5)
