"""Tilt by walls: bumps make walls lean, all scans from one place see the same of them, and nobody is to be sure then."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.messages import Array
from companion.odometry.height_map import HeightMap
from companion.odometry.tilt import Tilt
from companion.odometry.turned import BLOCK_SCANS, Turned, TurnedBy
from companion.odometry.wall_map import WallMap

HALF_M = 19.0
PLACE = np.array([-13.0, -12.0])
UP_M = 5.6
NOISE_M = 0.03


class Room:
    """A square of walls with bumps of that RMS and of 2 to 8 m, on a level floor; its maps know it well."""

    def __init__(self, rms_m: float, seed: int) -> None:
        rng = np.random.default_rng(seed)
        angle, length = rng.uniform(0.0, 2 * math.pi, (4, 24)), 2.0 * 4.0 ** rng.random((4, 24))
        self._k = 2 * math.pi / length * np.stack([np.cos(angle), np.sin(angle)])
        self._phase = rng.uniform(0.0, 2 * math.pi, (4, 24))
        self._rms_m = rms_m
        self.walls, self.ground = WallMap(), HeightMap()
        around = (np.arange(512) + 0.5) * 2 * math.pi / 512
        for z in np.concatenate([np.full(100, 0.1), np.linspace(0.1, UP_M, 40), np.full(40, UP_M)]):
            points = self.seen(around, np.zeros(512), z, rng)
            self.walls.insert(points[:, :2] + PLACE, z, np.zeros(3))
        xy = np.stack(np.meshgrid(*2 * [np.arange(-HALF_M, HALF_M, 0.2)]), axis=-1).reshape(-1, 2)
        floor = np.column_stack([xy, np.zeros(len(xy)), np.full(len(xy), 4.0)])
        self.ground.insert(floor, np.zeros(3), np.array([0.0, 0.0, 5.0]), NOISE_M, 1e-6)

    def seen(self, bearing: Array, elevation: Array, z_m: float, rng: np.random.Generator) -> Array:
        """(N, 4) points on the walls and how many returns each is, from PLACE at that height."""
        c, s = np.cos(bearing), np.sin(bearing)
        east, north, west, south = (
            (HALF_M - PLACE[0]) / c,
            (HALF_M - PLACE[1]) / s,
            (-HALF_M - PLACE[0]) / c,
            (-HALF_M - PLACE[1]) / s,
        )
        reach = np.stack([east, north, west, south])
        reach[reach <= 0.0] = np.inf
        wall, flat = np.argmin(reach, axis=0), np.min(reach, axis=0)
        z = flat * np.tan(elevation)
        along = np.where(wall % 2 == 0, PLACE[1] + flat * s, PLACE[0] + flat * c)
        waves = self._k[0, wall] * along[:, None] + self._k[1, wall] * (z + z_m)[:, None] + self._phase[wall]
        bump = self._rms_m * math.sqrt(2 / 24) * np.sin(waves).sum(axis=1)
        flat = flat + bump / np.abs(np.where(wall % 2 == 0, c, s)) + NOISE_M / 2 * rng.standard_normal(len(flat))
        points = np.column_stack([flat * c, flat * s, z, np.full(len(flat), 4.0)])
        return points[z + z_m > 0.0]

    def hover(self, scans: int, *, turned_rad: float = 0.0, swing_rad: float = 0.0) -> Tilt:
        """What is believed of the tilt's error, which is 0, after so many scans of 16 rows from one place.

        turned_rad: of the LiDAR about the body's z beyond its mount. swing_rad: how far the vehicle tilts, about both axes.
        """
        rng, tilt = np.random.default_rng(1), Tilt()
        bearing, elevation = (
            a.ravel()
            for a in np.meshgrid((np.arange(128) + 0.5) * 2 * math.pi / 128, np.radians(-3.0 * np.arange(1, 16)))
        )
        for n in range(scans):
            tilt.carry(0.1, np.array([*PLACE, UP_M]))
            points = self.seen(bearing, elevation, UP_M, rng)
            roll, pitch = swing_rad * math.sin(0.9 * n), swing_rad * math.sin(0.5 * n)
            missed = turned_rad * np.array([pitch, -roll])
            points[:, :3] = points[:, :3] @ _turned(tilt.offset - missed).T
            fit = self.ground.fit(
                points, np.array([*PLACE, 0.0]), UP_M, self.walls, sigma_range_m=NOISE_M / 2, gate_m=0.6,
                seen_spread_m=UP_M, lean=tilt.lean, tilt_information=np.linalg.inv(tilt.p),
                shift_information=np.eye(2) / 0.01**2,
            )  # fmt: skip
            assert fit.wall_points > 200
            tilt.take(fit, roll, pitch)
        return tilt


def _turned(offset: Array) -> Array:
    """Rotation (3, 3) by roll and pitch, both small."""
    roll, pitch = offset
    return np.array([[1.0, 0.0, pitch], [0.0, 1.0, -roll], [-pitch, roll, 1.0]])


def sigma_rad(tilt: Tilt) -> float:
    return float(np.sqrt(0.5 * np.trace(tilt.p[:2, :2])))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_plumb_walls_tell_the_tilt_well(seed: int) -> None:
    tilt = Room(0.0, seed).hover(60)
    assert np.degrees(np.abs(tilt.offset)).max() < 0.06
    assert math.degrees(sigma_rad(tilt)) < 0.08


def test_bumpy_walls_leave_the_tilt_as_unsure_as_it_is_however_long_it_hovers() -> None:
    tilts = [Room(0.03, seed).hover(60) for seed in range(8)]
    errors = np.array([tilt.offset / sigma_rad(tilt) for tilt in tilts])
    assert np.mean(errors**2) < 5.0  # 1 if exact; 19 were bumps no more than noise
    assert np.degrees(np.median([sigma_rad(tilt) for tilt in tilts])) > 0.1


@pytest.mark.parametrize("turned_deg", [-2.0, 0.0, 3.0])
def test_a_lidar_turned_about_the_vertical_shows_where_the_vehicle_tilts(turned_deg: float) -> None:
    tilt = Room(0.0, 1).hover(801, turned_rad=math.radians(turned_deg), swing_rad=math.radians(1.0))
    found = tilt.turned.by
    assert found.sigma_rad < math.radians(0.4)
    assert abs(found.angle_rad - math.radians(turned_deg)) < 3.0 * found.sigma_rad
    assert found.is_sure == (turned_deg != 0.0)
    assert f"lidar.mount_rpy_deg by {math.degrees(found.angle_rad):+.1f}" in found.in_words()


def told_by_blocks(degrees: list[float]) -> TurnedBy:
    """After blocks of scans each of which shows that much, to 1 deg."""
    turned, tilt, unknown = Turned(), math.radians(2.0), np.diag([1e8, 1e8, 1e8, 1e8])
    information = np.diag([1.0, 1.0, 0.0, 0.0]) / (math.radians(1.0) * tilt) ** 2 / BLOCK_SCANS
    for shown in degrees:
        for _ in range(BLOCK_SCANS):
            missed = math.radians(shown) * np.array([0.0, -tilt, 0.0, 0.0])
            correction = np.linalg.solve(unknown + information, information @ missed)
            turned.take(tilt, 0.0, 0.0, correction, information, unknown)
            turned.carry(np.zeros(4))
    return turned.by


def test_what_one_manoeuvre_tells_is_not_believed_when_the_others_do_not() -> None:
    alike, apart = told_by_blocks([3.0] * 16), told_by_blocks([0.0] * 13 + [16.0] * 3)
    assert math.degrees(alike.angle_rad) == pytest.approx(3.0, abs=0.05)
    assert math.degrees(apart.angle_rad) == pytest.approx(3.0, abs=0.05)
    assert math.degrees(alike.sigma_rad) == pytest.approx(0.25, abs=0.01)
    assert math.degrees(apart.sigma_rad) > 1.0
    assert alike.is_sure
    assert not apart.is_sure
    assert not told_by_blocks([3.0] * 3).is_sure  # too short a flight


def test_nothing_is_known_of_it_where_the_vehicle_stays_level_or_no_wall_is_seen() -> None:
    still = Room(0.0, 1).hover(60, turned_rad=math.radians(3.0)).turned.by
    assert still.sigma_rad > math.radians(9.9)
    assert not still.is_sure
    assert not Tilt().turned.by.is_sure


def test_off_the_start_height_is_as_unsure_as_the_tilt_that_the_ground_was_mapped_with() -> None:
    tilt = Tilt()
    assert tilt.drift_variance() == 0.0
    for n in range(1, 301):
        tilt.p[:2, :2] = np.eye(2) * math.radians(0.2) ** 2
        tilt.carry(0.1, np.array([0.1 * n, 0.0, UP_M]))
    assert 0.03 < math.sqrt(tilt.drift_variance()) < 30.0 * math.radians(0.2)
    tilt.carry(0.1, np.array([0.0, 0.0, UP_M]))
    assert tilt.drift_variance() == 0.0
