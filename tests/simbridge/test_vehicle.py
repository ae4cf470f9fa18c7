"""The quadrotor obeys VEHICLE.md: thrust, lag, signs, drag; it stands, lands and collides."""

from __future__ import annotations

import math

import numpy as np
import pytest

from simbridge.loop import Simulation
from tests.simbridge.stores import CONE, HOVER, Motors, lift, run, sim_config

FRONT_RIGHT, REAR_LEFT, FRONT_LEFT, REAR_RIGHT = range(4)


def hovering(**sections: object) -> tuple[Simulation, Motors]:
    motors = Motors(HOVER)
    simulation = Simulation(sim_config(**sections), motors)
    lift(simulation, 5.0)
    run(simulation, 0.5)  # the rotors come up to speed
    simulation._vehicle.motion[:] = 0.0
    return simulation, motors


def test_hover_needs_half_of_the_command() -> None:
    assert pytest.approx(0.52, abs=0.001) == HOVER
    simulation, _ = hovering()
    run(simulation, 1.0)
    assert abs(float(simulation.truth().velocity_world_mps[2])) < 0.02


def test_full_thrust_is_2_8_times_the_weight() -> None:
    simulation, motors = hovering()
    motors.command = np.ones(4)
    run(simulation, 0.3)
    assert motors.imu[-1].accel_frd_mps2[2] == pytest.approx(-4 * 20.6 / 3.0, rel=0.02)  # drag takes the rest


def test_rotors_follow_with_their_lag() -> None:
    simulation, motors = hovering()
    motors.command = np.zeros(4)
    run(simulation, 0.032)  # one time constant and a bit
    u = HOVER * math.exp(-0.032 / 0.03)
    thrust = 20.6 * (0.35 * u + 0.65 * u * u)
    assert simulation._vehicle.thrust_ratio == pytest.approx(thrust / 20.6, rel=0.02)


@pytest.mark.parametrize(
    ("stronger", "axis"),
    [((REAR_LEFT, FRONT_LEFT), 0), ((FRONT_RIGHT, FRONT_LEFT), 1), ((FRONT_RIGHT, REAR_LEFT), 2)],
    ids=["left pair rolls right", "front pair pitches up", "counter-clockwise pair turns the nose right"],
)
def test_motor_pairs_turn_the_right_way(stronger: tuple[int, int], axis: int) -> None:
    simulation, motors = hovering()
    motors.command = np.full(4, HOVER)
    motors.command[list(stronger)] += 0.02
    run(simulation, 0.1)
    rate = motors.imu[-1].gyro_frd_radps
    assert rate[axis] > 0.01
    assert np.abs(np.delete(rate, axis)).max() < 1e-6


def test_turn_rates_have_the_size_of_torque_over_inertia() -> None:
    simulation, motors = hovering()
    motors.command = np.full(4, HOVER)
    motors.command[[REAR_LEFT, FRONT_LEFT]] += 0.02
    run(simulation, 0.3)
    before = motors.imu[-1].gyro_frd_radps[0]
    run(simulation, 0.1)

    def thrust(u: float) -> float:
        return 20.6 * (0.35 * u + 0.65 * u * u)

    torque = 2 * 0.20 * (thrust(HOVER + 0.02) - thrust(HOVER))
    assert (motors.imu[-1].gyro_frd_radps[0] - before) / 0.1 == pytest.approx(torque / 0.06, rel=0.01)


def test_drag_slows_with_its_time_constant() -> None:
    simulation, _ = hovering()
    simulation._vehicle.motion[0] = 1.0
    run(simulation, 2.0)
    assert simulation.truth().velocity_world_mps[0] == pytest.approx(math.exp(-2.0 * 0.3 / 3.0), rel=1e-3)


def test_wind_carries_the_vehicle_along() -> None:
    simulation, _ = hovering(world={"wind": {"mean_mps": [0, 0.8, 0]}})
    run(simulation, 2.0)
    assert simulation.truth().velocity_world_mps[1] == pytest.approx(0.8 * (1 - math.exp(-0.2)), rel=0.01)


def test_gusts_have_their_strength_and_come_back_to_the_mean() -> None:
    simulation, _ = hovering(world={"wind": {"gust_mps": 1.5, "gust_time_s": 0.5}})
    gusts = np.array([simulation._vehicle._draught.step() for _ in range(100_000)])
    assert gusts.std(axis=0) == pytest.approx([1.5, 1.5, 0.75], rel=0.1)
    assert np.abs(gusts.mean(axis=0)).max() < 0.25


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, -3.0])
def test_commands_that_mean_nothing_do_not_upset_the_physics(bad: float) -> None:
    simulation, motors = hovering()
    motors.command = np.array([bad, HOVER, HOVER, HOVER])
    run(simulation, 0.1)
    assert np.isfinite(simulation.truth().position_world_m).all()


@pytest.mark.parametrize("substeps", [1, 2])
def test_finer_physics_flies_nearly_the_same(substeps: int) -> None:
    ends = []
    for n in (substeps, 4):
        simulation, motors = hovering(vehicle={"substeps": n})
        motors.command = np.array([0.52, 0.53, 0.535, 0.525])
        run(simulation, 0.5)
        truth = simulation.truth()
        ends.append(np.concatenate([truth.position_world_m, truth.rate_body_radps]))
    assert ends[0][:3] == pytest.approx(ends[1][:3], abs=0.02)
    assert ends[0][3:] == pytest.approx(ends[1][3:], abs=0.03)
    assert np.abs(ends[1][3:]).max() > 0.2


def test_vehicle_stands_still_on_the_floor() -> None:
    simulation = Simulation(sim_config(world={"floor_slope": [0.02, 0.0]}), Motors())
    before = simulation.truth().position_world_m
    run(simulation, 1.0)
    assert simulation.truth().position_world_m == pytest.approx(before, abs=2e-3)
    assert not simulation.collision


def test_vehicle_lands_on_a_pile_instead_of_falling_through() -> None:
    simulation = Simulation(sim_config(world={"piles": [{**CONE, "height_m": 1.2, "repose_deg": 15}]}), Motors(0.48))
    top = simulation.world.surface_height(11.5, 6.0)
    assert top > 0.7
    simulation._vehicle.position[:] = 11.5, 6.0, top + 0.4
    run(simulation, 1.0)
    x, y, z = simulation.truth().position_world_m
    assert simulation.world.surface_height(x, y) < z < simulation.world.surface_height(x, y) + 0.2
    assert not simulation.collision


@pytest.mark.parametrize(
    ("place", "velocity"),
    [((2.0, 6.0, 5.0), (-3.0, 0, 0)), ((6.6, 6.0, 5.0), (2.0, 0, 0)), ((4.0, 6.0, 9.0), (0, 0, 3.0))],
    ids=["wall", "column", "ceiling"],
)
def test_flying_into_something_is_a_collision_and_stops_there(
    place: tuple[float, float, float], velocity: tuple[float, float, float]
) -> None:
    simulation, _ = hovering(world={"columns": [{"center": [8, 6], "radius_m": 0.5}]})
    simulation._vehicle.position[:] = place
    simulation._vehicle.motion[:3] = velocity
    run(simulation, 1.0)
    assert simulation.collision
    assert simulation.min_clearance_m < 0.1
    x, y, z = simulation.truth().position_world_m
    assert 0 < x < 7.5
    assert 0 < y < 12
    assert 0 < z < 10


@pytest.mark.parametrize(("speed", "is_collision"), [(0.7, False), (2.5, True)])
def test_only_a_hard_landing_is_a_collision(speed: float, is_collision: bool) -> None:
    simulation, motors = hovering()
    lift(simulation, 0.3)
    simulation._vehicle.motion[2] = -speed
    motors.command = np.full(4, 0.4)
    run(simulation, 0.5)
    assert simulation.collision is is_collision


@pytest.mark.parametrize(("speed", "is_collision"), [(0.43, True), (0.0, False)], ids=["flown into", "landed on"])
def test_flying_into_a_piles_flank_is_a_collision_and_landing_there_is_not(speed: float, is_collision: bool) -> None:
    simulation, motors = hovering(world={"piles": [CONE]})
    simulation._vehicle.position[:] = 11.0, 6.0, simulation.world.surface_height(11.0, 6.0) + 0.3
    simulation._vehicle.motion[:3] = speed, 0.0, 0.0
    motors.command = np.full(4, 0.5)
    run(simulation, 0.6)
    assert simulation._vehicle.has_contact
    assert simulation.collision is is_collision


def test_lying_on_its_back_is_a_collision() -> None:
    simulation = Simulation(sim_config(), Motors())
    simulation._vehicle.position[2] = 0.3
    simulation._vehicle.q_world_body_wxyz[:] = 0.0, 1.0, 0.0, 0.0
    run(simulation, 0.5)
    assert simulation.collision
