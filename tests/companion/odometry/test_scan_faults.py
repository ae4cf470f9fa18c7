"""Scans and samples as faults leave them: dropped and counted, refused, recovered from; never an exception."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

from companion.messages import AttitudeSample, LidarScan, RangefinderSample
from companion.odometry import Odometry
from tests.companion.odometry.conftest import CONFIG, Flown, Message, feed


@pytest.fixture(scope="module")
def cruise(flown: Flown) -> tuple[Odometry, list[Message]]:
    """An odometry some seconds into level flight, to be copied, and the messages of the ten seconds after."""
    scans = [i for i, m in enumerate(flown.messages) if isinstance(m, LidarScan)]
    level = scans[int(np.argmax(flown.truth[:, 2] > 8.79)) + 30]
    later = scans[int(np.argmax(flown.truth[:, 2] > 8.79)) + 130]
    odometry = Odometry(CONFIG)
    feed(odometry, flown.messages[:level])
    return odometry, flown.messages[level:later]


def _change(messages: list[Message], change, first: int, count: int) -> list[Message]:
    """Apply `change` to some of the scans; None drops the scan."""
    out, k = [], 0
    for m in messages:
        if isinstance(m, LidarScan):
            k += 1
            if first < k <= first + count:
                m = change(m)
        if m is not None:
            out.append(m)
    return out


def _start(before: Odometry) -> Odometry:
    return deepcopy(before)


def _spoil(scan: LidarScan) -> LidarScan:
    """NaN, inf, negative and zero ranges in two fifths of the columns, and lost columns."""
    ranges, valid = scan.range_m.copy(), scan.column_valid.copy()
    ranges[:, 0::10], ranges[:, 1::10], ranges[:, 2::10], ranges[:, 3::10] = np.nan, np.inf, -5.0, 0.0
    valid[100:150] = False
    return replace(scan, range_m=ranges, column_valid=valid)


def _swap(scan: LidarScan) -> LidarScan:
    """A scan that fits nowhere: its ranges at random."""
    rng = np.random.default_rng(scan.frame_id)
    return replace(scan, range_m=rng.uniform(1, 30, scan.range_m.shape).astype(np.float32))


def test_spoilt_ranges_and_lost_columns_cost_accuracy_only(cruise, flown: Flown) -> None:
    before, after = cruise
    odometry = _start(before)
    results = feed(odometry, _change(after, _spoil, 5, 50))
    assert odometry.rejected == {}
    for result in results:
        i = next(k for k, r in enumerate(flown.results) if r.estimate.t_ns == result.estimate.t_ns)
        assert np.linalg.norm(result.estimate.position_map_m[:2] - flown.truth[i, :2]) < 0.08
        assert np.isfinite(result.levelled.points_level).all()


def test_an_empty_scan_is_refused_and_the_estimate_goes_on(cruise) -> None:
    before, after = cruise
    odometry = _start(before)
    results = feed(odometry, _change(after, lambda s: replace(s, range_m=np.zeros_like(s.range_m)), 5, 1))
    assert odometry.rejected == {"too few inliers": 1}
    assert results[5].wall_ranges.front_m is None
    assert not np.isfinite(results[5].wall_ranges.ranges_m).any()
    assert results[5].estimate.quality > 0
    assert results[6].judgement is not None
    assert results[6].judgement.is_accepted


def test_three_bad_scans_in_a_row_fail_the_estimate_and_good_ones_restore_it(cruise) -> None:
    before, after = cruise
    odometry = _start(before)
    counts = odometry.walls.sums.sum()
    results = feed(odometry, _change(after, _swap, 0, 6))
    assert [r.estimate.quality == -1 for r in results[:8]] == [False, False, True, True, True, True, False, False]
    sigma = [r.estimate.pose_covariance[0, 0] for r in results[:6]]
    assert sigma == sorted(sigma)
    assert results[-1].estimate.reset_counter == 0  # it came back where it was expected: no jump
    assert counts < odometry.walls.sums.sum()


def test_bad_scans_are_never_painted_into_the_map(cruise) -> None:
    before, after = cruise
    odometry = _start(before)
    odometry_bad = _start(before)
    feed(odometry, _change(after, lambda s: None, 0, 40))
    feed(odometry_bad, _change(after, _swap, 0, 40))
    clean, bad = odometry.walls.sums[..., 0].sum(), odometry_bad.walls.sums[..., 0].sum()
    assert bad == pytest.approx(clean, rel=0.01)


def test_a_second_of_silence_is_bridged(cruise, flown: Flown) -> None:
    before, after = cruise
    odometry = _start(before)
    results = feed(odometry, _change(after, lambda s: None, 5, 10))
    last = results[-1].estimate
    i = next(k for k, r in enumerate(flown.results) if r.estimate.t_ns == last.t_ns)
    assert np.linalg.norm(last.position_map_m[:2] - flown.truth[i, :2]) < 0.06
    assert last.reset_counter == 0


def test_a_carried_off_vehicle_is_found_again_and_the_reset_is_counted(flown: Flown) -> None:
    """Three seconds vanish, clock and all: the vehicle is 1.5 m from where it is expected, along a wall that still
    fits. AUTOPILOTS.md: "a change resets the EKF to the measurement"."""
    gap_ns, cut_ns = 3_000_000_000, 45_000_000_000
    odometry = Odometry(CONFIG)
    feed(odometry, [m for m in flown.messages if m.t_ns <= cut_ns])
    moved: list[Message] = []
    for m in flown.messages:
        if not cut_ns + gap_ns < m.t_ns <= cut_ns + gap_ns + 2_000_000_000:
            continue
        if isinstance(m, LidarScan):
            m = replace(m, t_column_ns=m.t_column_ns - gap_ns)
        moved.append(replace(m, t_ns=m.t_ns - gap_ns))
    results = feed(odometry, moved)
    assert [r.estimate.reset_counter for r in results[:4]] == [0, 0, 1, 1]
    assert odometry.rejected == {"fits better elsewhere": 3}
    i = next(k for k, r in enumerate(flown.results) if r.estimate.t_ns == results[-1].estimate.t_ns + gap_ns)
    assert np.linalg.norm(results[-1].estimate.position_map_m[:2] - flown.truth[i, :2]) < 0.08


def test_the_same_frame_again_is_dropped(cruise) -> None:
    before, after = cruise
    odometry = _start(before)
    scan = next(m for m in after if isinstance(m, LidarScan))
    feed(odometry, after[: after.index(scan) + 1])
    assert odometry.on_scan(scan) is None
    assert odometry.dropped["repeated"] == 1


def test_without_attitude_nothing_is_estimated(flown: Flown) -> None:
    odometry = Odometry(CONFIG)
    scan = next(m for m in flown.messages if isinstance(m, LidarScan))
    assert odometry.on_scan(scan) is None
    assert odometry.predict(scan.t_ns) is None
    assert odometry.dropped["no attitude"] == 1


@pytest.mark.parametrize("bad", [np.nan, np.inf, 0.0])
def test_broken_attitude_and_rangefinder_are_dropped(cruise, bad: float) -> None:
    before, _ = cruise
    odometry = _start(before)
    assert before.predict(0) is not None
    t_ns = before.predict(0).t_ns + 200_000_000
    expected = odometry.predict(t_ns)
    odometry.on_attitude(AttitudeSample(t_ns=t_ns, q_ref_body_wxyz=np.full(4, bad), rate_body_radps=np.zeros(3)))
    odometry.on_rangefinder(RangefinderSample(t_ns=t_ns, distance_m=bad))
    got = odometry.predict(t_ns)
    assert expected is not None
    assert got is not None
    assert np.array_equal(got.position_map_m, expected.position_map_m)
