"""The sensors say what is true, plus what their data sheets admit."""

from __future__ import annotations

import math

import numpy as np
import pytest

from simbridge.config import BarometerConfig, ImuConfig, RangefinderConfig
from simbridge.loop import Simulation
from simbridge.sensors import Barometer, Imu, Rangefinder, isa_altitude_m, isa_pressure_hpa
from tests.simbridge.stores import CONE, HOVER, Motors, lift, run, sim_config

REST = np.array([0.0, 0.0, -9.81, 0.0, 0.0, 0.0])


def test_imu_at_rest_feels_gravity_upwards() -> None:
    motors = Motors()
    run(Simulation(sim_config(), motors), 0.2)
    for sample in motors.imu:
        assert sample.accel_frd_mps2 == pytest.approx([0, 0, -9.81], abs=1e-6)
        assert sample.gyro_frd_radps == pytest.approx([0, 0, 0], abs=1e-9)


def test_imu_feels_nothing_in_free_fall() -> None:
    motors = Motors()
    simulation = Simulation(sim_config(vehicle={"drag_nspm": 0}), motors)
    lift(simulation, 8.0)
    run(simulation, 0.3)
    assert motors.imu[-1].accel_frd_mps2 == pytest.approx([0, 0, 0], abs=1e-9)


def test_imu_integrates_to_the_true_velocity() -> None:
    motors = Motors(HOVER)
    simulation = Simulation(sim_config(vehicle={"substeps": 4}), motors)
    lift(simulation, 5.0)
    run(simulation, 0.1)
    start, first = simulation.truth().velocity_world_mps, len(motors.imu) + 1
    run(simulation, 0.4)
    end = simulation.truth().velocity_world_mps
    run(simulation, 0.004)
    up = sum(-s.accel_frd_mps2[2] - 9.81 for s in motors.imu[first:]) * 0.004  # level: up is -z
    assert up == pytest.approx(end[2] - start[2], abs=2e-4)


def test_pushing_right_is_positive_y() -> None:
    motors = Motors()
    simulation = Simulation(sim_config(world={"wind": {"mean_mps": [0, -5, 0]}}), motors)  # from the left
    lift(simulation, 5.0)
    run(simulation, 0.1)
    assert motors.imu[-1].accel_frd_mps2[1] == pytest.approx(5 * 0.3 / 3.0, rel=0.02)


def test_rolled_right_it_slides_right() -> None:
    simulation = Simulation(sim_config(), Motors(HOVER))
    lift(simulation, 5.0)
    roll = math.radians(20)  # x forward in FLU and FRD alike: a positive roll lowers the right side
    simulation._vehicle.q_world_body_wxyz[:] = math.cos(roll / 2), math.sin(roll / 2), 0, 0
    run(simulation, 0.3)
    assert simulation.truth().velocity_world_mps[1] < -0.3


@pytest.mark.parametrize(("part", "accel_ug", "gyro_mdps"), [("icm-42688-p", 65, 2.8), ("bmi088", 160, 14)])
def test_imu_noise_is_the_data_sheets(part: str, accel_ug: float, gyro_mdps: float) -> None:
    imu = Imu(ImuConfig(part=part, accel_bias_mps2=0, gyro_bias_dps=0), seed=3)
    samples = [imu.sample(REST, 0.5) for _ in range(20_000)]
    accel = np.array([s.accel_frd_mps2 for s in samples])
    gyro = np.array([s.gyro_frd_radps for s in samples])
    assert accel[:, 0].std() == pytest.approx(accel_ug * 1e-6 * 9.81 * math.sqrt(125), rel=0.03)
    assert gyro[:, 2].std() == pytest.approx(math.radians(gyro_mdps * 1e-3) * math.sqrt(125), rel=0.03)
    assert accel.mean(axis=0) == pytest.approx([0, 0, -9.81], abs=1e-3)


def test_imu_bias_is_drawn_by_the_seed() -> None:
    means = []
    for seed in range(40):
        imu = Imu(ImuConfig(accel_bias_mps2=0.1, gyro_bias_dps=1.0), seed=seed)
        means.append(np.mean([imu.sample(REST, 0.0).accel_frd_mps2 for _ in range(100)], axis=0))
    assert (np.array(means) - REST[:3]).std() == pytest.approx(0.1, rel=0.25)


def test_misaligned_imu_tilts_gravity() -> None:
    imu = Imu(ImuConfig(part="ideal", misalignment_rpy_deg=(2.0, 0.0, 0.0)), seed=0)
    accel = imu.sample(REST, 0.0).accel_frd_mps2
    roll = math.degrees(math.atan2(-accel[1], -accel[2]))
    assert roll == pytest.approx(2.0)


def test_vibration_grows_with_thrust() -> None:
    imu = Imu(ImuConfig(part="ideal", vibration_mps2=4.0), seed=0, step_ns=400_000)
    calm = np.array([imu.sample(REST, 0.0).accel_frd_mps2 for _ in range(1000)]).std(axis=0)
    loud = np.array([imu.sample(REST, 0.5).accel_frd_mps2 for _ in range(50_000)]).std(axis=0)
    assert calm.max() < 1e-12
    assert loud == pytest.approx([2.0, 2.0, 2.0], rel=0.1)


def test_vibration_shakes_but_does_not_carry_away() -> None:
    """The speed integrated from an oscillation at 80 Hz stays within cm/s; white noise of that RMS would lose 0.7 m/s
    in ten seconds (3.6 m/s2, 4 ms, root of 2500 steps)."""
    imu = Imu(ImuConfig(part="ideal", vibration_mps2=10.0), seed=0)
    felt = np.array([imu.sample(REST, 0.36).accel_frd_mps2 - REST[:3] for _ in range(2500)])
    assert felt.std(axis=0).min() > 0.7
    assert np.abs(np.cumsum(felt * 0.004, axis=0)[-1]).max() < 0.25


def test_barometer_tells_height_at_its_rate() -> None:
    barometer = Barometer(BarometerConfig(noise_hpa=0, drift_hpa=0), seed=0)
    samples = [barometer.sample(t * 4_000_000, 9.0) for t in range(250)]
    measured = [s for s in samples if s is not None]
    assert len(measured) == 50
    assert measured[0].pressure_altitude_m == pytest.approx(488.0 + 9.0, abs=1e-6)


def test_barometer_wanders_slowly_by_its_drift() -> None:
    barometer = Barometer(BarometerConfig(noise_hpa=0, drift_hpa=0.1, drift_time_s=10), seed=1)
    samples = (barometer.sample(t * 20_000_000, 0.0) for t in range(200_000))
    pressure = np.array([s.pressure_hpa for s in samples if s is not None])
    assert pressure.std() == pytest.approx(0.1, rel=0.2)
    assert np.abs(np.diff(pressure)).max() < 0.05


@pytest.mark.parametrize("altitude_m", [-100.0, 0.0, 488.0, 3000.0])
def test_standard_atmosphere_inverts(altitude_m: float) -> None:
    assert isa_altitude_m(isa_pressure_hpa(altitude_m)) == pytest.approx(altitude_m, abs=1e-6)


def test_standard_atmosphere_has_its_known_values() -> None:
    assert isa_pressure_hpa(0.0) == pytest.approx(1013.25)
    assert isa_pressure_hpa(1000.0) == pytest.approx(898.75, abs=0.1)  # ISO 2533, table


def test_rangefinder_measures_along_the_body_axis() -> None:
    motors = Motors(HOVER)
    simulation = Simulation(sim_config(world={"piles": [CONE]}), motors)
    simulation._vehicle.position[:] = 12.0, 6.0, 7.0
    simulation.step()
    run(simulation, 0.02)
    over_pile = [r for r in motors.rangefinder if r is not None][-1]
    below = simulation.world.surface_height(12.0, 6.0)
    assert over_pile == pytest.approx(simulation.truth().position_world_m[2] - below, abs=0.03)
    roll = math.radians(30)
    simulation._vehicle.position[:] = 6.0, 6.0, 5.0
    simulation._vehicle.q_world_body_wxyz[:] = math.cos(roll / 2), math.sin(roll / 2), 0, 0
    simulation._vehicle.motion[:] = 0.0
    motors.rangefinder.clear()
    run(simulation, 0.02)
    tilted = next(r for r in motors.rangefinder if r is not None)
    assert tilted == pytest.approx(5.0 / math.cos(roll), abs=0.03)


def test_rangefinder_says_nothing_out_of_range() -> None:
    rangefinder = Rangefinder(RangefinderConfig(noise_m=0, max_range_m=10), seed=0)
    assert rangefinder.sample(-1.0) is None
    assert rangefinder.sample(10.1) is None
    assert rangefinder.sample(0.01) is None
    assert rangefinder.sample(9.0) == 9.0
