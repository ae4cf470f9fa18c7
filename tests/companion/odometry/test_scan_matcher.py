"""Scan matching without a flight controller."""

from __future__ import annotations

import math

import numpy as np

from companion.odometry.scan_matcher import ScanMatcher2D
from tests.companion.odometry.hall import Hall, rectangle

ROOM = Hall([rectangle(12, 8), rectangle(1, 1, 7, 3), rectangle(0.5, 2, 2, 5)])


def test_a_walk_through_a_room_is_followed_to_centimetres() -> None:
    rng = np.random.default_rng(0)
    matcher, errors = ScanMatcher2D(), []
    a = np.radians(np.arange(180) - 89.5)
    for k in range(150):
        true = np.array([2.0 + 0.04 * k * math.cos(0.004 * k), 2.0 + 0.002 * k, 0.004 * k])
        d = np.stack((np.cos(a + true[2]), np.sin(a + true[2]), np.zeros(180)), axis=1)
        r = ROOM.cast(np.tile([true[0], true[1], 1.0], (180, 1)), d) + rng.normal(size=180) * 0.02
        found = matcher.match(np.stack((r * np.cos(a), r * np.sin(a)), axis=1), k * 100_000_000)
        assert found.is_matched
        errors.append(found.pose - (true - (2.0, 2.0, 0.0)))
    errors_m = np.array(errors)
    assert np.hypot(errors_m[:, 0], errors_m[:, 1]).max() < 0.08
    assert np.degrees(np.abs(errors_m[:, 2])).max() < 1.0


def test_a_scan_of_nothing_is_carried_on_by_constant_velocity() -> None:
    matcher = ScanMatcher2D()
    line = np.stack((np.full(100, 3.0), np.linspace(-2, 2, 100)), axis=1)
    matcher.match(line, 0)
    found = matcher.match(np.full((50, 2), 400.0), 100_000_000)
    assert not found.is_matched
    assert np.isfinite(found.pose).all()
