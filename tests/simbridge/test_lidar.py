"""Packets are an Ouster's: ouster-sdk reads them back to the true points, at the true times."""

from __future__ import annotations

import hashlib
import math
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from ouster.sdk import core

from simbridge.config import LidarSimConfig
from simbridge.loop import BOOT_NS, Simulation
from simbridge.ouster import PacketWriter, directions_sensor, sensor_info
from simbridge.rotation import matrix_from_rpy
from tests.simbridge.stores import CONE, HOVER, Motors, lift, run, sim_config


def flying(seed: int = 0, **sections: Any) -> Simulation:
    simulation = Simulation(sim_config(seed=seed, **sections), Motors(HOVER))
    lift(simulation, 6.0)
    return simulation


def frames(packets: list[bytes], metadata: str) -> list[Any]:
    """Whole turns, as ouster-sdk puts them together."""
    info = core.SensorInfo(metadata)
    batcher, layout, found = core.FrameBatcher(info), core.PacketFormat(info), []
    frame = core.LidarFrame(info)
    for data in packets:
        packet = core.LidarPacket(layout)
        assert len(data) == len(packet.buf)
        packet.buf[:] = np.frombuffer(data, dtype=np.uint8)
        assert packet.validate(info) == core.PacketValidationFailure.NONE
        assert layout.crc(packet.buf) == layout.calculate_crc(packet.buf)
        if batcher.batch(packet, frame):
            found.append(core.LidarFrame(frame))
    return found


def ranges_m(frame: Any) -> NDArray[np.float64]:
    return np.asarray(frame.field("RANGE") * 0.001)


@pytest.mark.parametrize(("rows", "columns", "rate"), [(5, 512, 10), (16, 1024, 10), (32, 512, 20), (64, 512, 10)])
def test_beams_point_where_ouster_sdk_says(rows: int, columns: int, rate: int) -> None:
    cfg = LidarSimConfig.model_validate({"rows": rows, "columns": columns, "rate_hz": rate})
    info = core.SensorInfo(sensor_info(cfg).to_json_string())
    points = core.XYZLut(info)(np.full((rows, columns), 10_000, dtype=np.uint32)).reshape(rows, columns, 3)
    wanted = 10.0 * directions_sensor(cfg).transpose(1, 0, 2) + np.array([0, 0, 0.03618])
    assert np.abs(points - wanted).max() < 1e-9


def test_packets_are_those_that_ouster_sdk_makes_of_the_whole_frame() -> None:
    cfg = LidarSimConfig()
    info, rng = sensor_info(cfg), np.random.default_rng(4)
    whole, writer = core.LidarFrame(info), PacketWriter(cfg)
    ranges = rng.integers(0, 50_000, (5, 512), dtype=np.uint32)
    signals = rng.integers(0, 60_000, (5, 512), dtype=np.uint16)
    whole.field("RANGE")[:], whole.field("SIGNAL")[:] = ranges, signals
    whole.field("REFLECTIVITY")[:] = 40
    whole.status[:], whole.timestamp[:], whole.frame_id = 1, np.arange(512) * 195_312, 77
    whole.measurement_id[:] = np.arange(512)
    wanted = [bytes(p.buf) for p in core.frame_to_packets(whole, core.PacketFormat(info), 1, 992100000000)]
    for n in range(32):
        columns = slice(16 * n, 16 * n + 16)
        writer.range_mm[n], writer.signal[n] = ranges[:, columns].T, signals[:, columns].T
        writer.stamps[n] = np.arange(512)[columns] * 195_312
        assert writer.pack(77, n) == wanted[n]


@pytest.mark.parametrize("mount", [{}, {"mount_position_m": [0.1, 0.05, 0.1], "mount_rpy_deg": [3, -5, 20]}])
def test_packets_project_back_to_the_store_to_the_millimetre(mount: dict[str, Any]) -> None:
    """While the vehicle tumbles and flies fast: each column by its own time and pose."""
    simulation = flying(world={"piles": [CONE]}, lidar=mount)
    simulation._vehicle.motion[:] = 1.5, -1.0, 0.5, 0.3, -0.4, 0.8
    times, positions, quats, packets = [], [], [], []
    for _ in range(60):
        truth = simulation.truth()
        times.append(truth.t_ns)
        positions.append(truth.position_world_m)
        quats.append(truth.q_world_body_wxyz)
        simulation.step()
        packets += simulation.take_lidar_packets()
    metadata = simulation.lidar_metadata_json()
    turn = matrix_from_rpy(np.radians(mount.get("mount_rpy_deg", [0, 0, 0])))
    place = np.array(mount.get("mount_position_m", [0, 0, 0.08]))
    frame = frames(packets, metadata)[0]
    points_sensor = core.XYZLut(core.SensorInfo(metadata))(frame).reshape(5, 512, 3)
    worst = 0.0
    seen = 0
    for column in range(512):
        t_ns = int(frame.timestamp[column]) - 1000 * 10**9
        before = np.searchsorted(times, t_ns, side="right") - 1
        share = (t_ns - times[before]) / 4e6
        position = positions[before] * (1 - share) + positions[before + 1] * share
        quat = quats[before] * (1 - share) + quats[before + 1] * share
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, quat / np.linalg.norm(quat))
        seen_rows = frame.field("RANGE")[:, column] > 0
        body = place + points_sensor[seen_rows, column] @ turn.T
        for x, y, z in position + body @ rotation.reshape(3, 3).T:
            to_pile = abs(z - simulation.world.surface_height(x, y))
            worst = max(worst, min(abs(x), abs(20 - x), abs(y), abs(12 - y), abs(10 - z), to_pile))
            seen += 1
    assert seen > 2500
    assert worst < 0.0015  # 0.5 mm are the rounding of the range


def test_columns_carry_evenly_spaced_stamps_of_the_sensors_clock() -> None:
    simulation = flying(lidar={"clock_offset_s": 50.0})
    first, second = frames(run(simulation, 0.35), simulation.lidar_metadata_json())[:2]
    stamps = np.concatenate([first.timestamp, second.timestamp]).astype(np.int64)
    assert stamps[0] == BOOT_NS + 50 * 10**9
    assert set(np.diff(stamps)) <= {195_312, 195_313}
    assert stamps[512] - stamps[0] == 100_000_000
    assert second.frame_id == first.frame_id + 1
    assert first.complete()


def test_packets_leave_when_their_last_column_is_measured() -> None:
    simulation = flying()
    layout = core.PacketFormat(core.SensorInfo(simulation.lidar_metadata_json()))
    for _ in range(50):
        simulation.step()
        for data in simulation.take_lidar_packets():
            packet = core.LidarPacket(layout)
            packet.buf[:] = np.frombuffer(data, dtype=np.uint8)
            last = int(layout.packet_header(core.ColHeader.TIMESTAMP, packet.buf)[-1]) - 1000 * 10**9
            assert 0 <= simulation.t_ns - last < 4_000_000


@pytest.mark.parametrize(("yaw_deg", "column"), [(0, 256), (45, 256 + 64), (-45, 256 - 64)])
def test_what_stands_to_the_right_comes_later_in_the_turn(yaw_deg: float, column: int) -> None:
    """The sensor looks back first and turns clockwise, so ahead is half a turn on."""
    simulation = flying(world={"columns": [{"center": [10, 6], "radius_m": 0.5}]}, vehicle={"start": [4, 6, yaw_deg]})
    row = ranges_m(frames(run(simulation, 0.25), simulation.lidar_metadata_json())[0])[0]
    near = np.arange(column - 20, column + 20)
    assert row[near].min() == pytest.approx(5.5, abs=0.01)
    assert near[np.argmin(row[near])] == pytest.approx(column, abs=2)


def test_noise_has_its_size_and_no_bias() -> None:
    clean, noisy = flying(), flying(lidar={"noise_m": 0.12})
    a = np.stack([ranges_m(f) for f in frames(run(clean, 0.55), clean.lidar_metadata_json())])
    b = np.stack([ranges_m(f) for f in frames(run(noisy, 0.55), noisy.lidar_metadata_json())])
    error = (b - a)[(a > 0) & (b > 0)]
    assert error.std() == pytest.approx(0.12, rel=0.02)
    assert abs(error.mean()) < 0.005
    assert np.abs(error).max() < 0.8


def test_a_units_own_offset_is_drawn_by_the_seed_and_a_fault_comes_on_top() -> None:
    def offset_m(seed: int, is_wrong: bool = False) -> float:
        exact, off = flying(seed=seed), flying(seed=seed, lidar={"offset_sigma_m": 0.05})
        if is_wrong:
            faults = [{"target": "lidar", "kind": "wrong", "at_s": 0.0, "wrong_by": 0.5}]
            off = flying(seed=seed, lidar={"offset_sigma_m": 0.05}, faults=faults)
        a = np.stack([ranges_m(f) for f in frames(run(exact, 0.25), exact.lidar_metadata_json())])
        b = np.stack([ranges_m(f) for f in frames(run(off, 0.25), off.lidar_metadata_json())])
        error = (b - a)[(a > 1) & (b > 1)]
        assert error.std() < 0.001
        return float(error.mean())

    drawn = [offset_m(seed) for seed in range(4)]
    assert len({round(d, 3) for d in drawn}) == 4
    assert max(abs(d) for d in drawn) < 0.2
    assert drawn[0] == pytest.approx(offset_m(0), abs=1e-9)
    assert offset_m(1, is_wrong=True) == pytest.approx(drawn[1] + 0.5, abs=0.002)


def test_beams_that_are_off_return_nothing_and_the_others_stay() -> None:
    all_on, some_off = flying(), flying(lidar={"rows_off": [1, 4]})
    a = ranges_m(frames(run(all_on, 0.25), all_on.lidar_metadata_json())[0])
    b = ranges_m(frames(run(some_off, 0.25), some_off.lidar_metadata_json())[0])
    assert (b[[1, 4]] == 0).all()
    assert np.array_equal(a[[0, 2, 3]], b[[0, 2, 3]])


def test_nothing_returns_from_beyond_the_range_limits() -> None:
    simulation = flying(lidar={"min_range_m": 5.0, "max_range_m": 9.0, "noise_m": 0.12})
    got = ranges_m(frames(run(simulation, 0.25), simulation.lidar_metadata_json())[0])
    seen = got[got > 0]
    assert 100 < len(seen) < 2000
    assert seen.min() >= 5.0
    assert seen.max() <= 9.0


def test_grazing_hits_get_lost_and_square_ones_do_not() -> None:
    simulation = flying(lidar={"grazing_deg": 60.0}, vehicle={"start": [2, 6, 0]})
    got = ranges_m(frames(run(simulation, 0.25), simulation.lidar_metadata_json())[0])[0]
    bearing = math.pi - 2 * math.pi * np.arange(512) / 512  # counter-clockwise from x
    reach_y = 6.0 / np.maximum(np.abs(np.sin(bearing)), 1e-9)
    incidence = np.degrees(np.arccos(np.clip(np.abs(np.sin(bearing)), 0, 1)))
    long_wall = (reach_y * np.cos(bearing) < 18) & (reach_y * np.cos(bearing) > -2)
    assert (got[long_wall & (incidence < 59)] > 0).all()
    lost = got[long_wall & (incidence > 62)] == 0
    assert 0.1 < lost.mean() < 0.9


def test_dust_shortens_and_swallows() -> None:
    clean, dusty = flying(), flying(lidar={"dust": {"visibility_m": 15.0, "lost_ratio": 0.3}})
    a = ranges_m(frames(run(clean, 0.25), clean.lidar_metadata_json())[0])
    b = ranges_m(frames(run(dusty, 0.25), dusty.lidar_metadata_json())[0])
    through = np.abs(a - b) < 0.002
    assert through.mean() == pytest.approx(np.exp(-a / 15.0).mean(), abs=0.03)
    assert ((b == 0) & (a > 0)).sum() / (~through).sum() == pytest.approx(0.3, abs=0.08)  # and those nearer than 0.5 m
    assert (b <= a + 0.002).all()


def test_vehicle_does_not_see_itself() -> None:
    simulation = flying(lidar={"min_range_m": 0.05, "mount_position_m": [0, 0, -0.03]})
    got = ranges_m(frames(run(simulation, 0.25), simulation.lidar_metadata_json())[0])
    assert got[got > 0].min() > 3.0


def test_mount_error_turns_the_picture() -> None:
    straight = flying(world={"columns": [{"center": [10, 6], "radius_m": 0.5}]})
    wrong = flying(
        world={"columns": [{"center": [10, 6], "radius_m": 0.5}]}, lidar={"mount_error_rpy_deg": [0, 0, 7.03125]}
    )
    a = ranges_m(frames(run(straight, 0.25), straight.lidar_metadata_json())[0])[0]
    b = ranges_m(frames(run(wrong, 0.25), wrong.lidar_metadata_json())[0])[0]
    assert np.abs(np.roll(a, 10) - b).max() < 0.01  # ten columns, turned left: what it sees comes later


@pytest.mark.parametrize("loss", [0.0, 0.3])
def test_packets_get_lost_at_their_ratio(loss: float) -> None:
    packets = run(flying(lidar={"packet_loss_ratio": loss}), 2.0)
    assert len(packets) == pytest.approx(640 * (1 - loss), abs=1 if loss == 0 else 60)


def digest(seed: int) -> str:
    simulation = flying(
        seed=seed,
        world={"wind": {"gust_mps": 1.0}},
        vehicle={"imu": {"part": "bmi088"}},
        lidar={"noise_m": 0.12, "grazing_deg": 70, "dust": {"visibility_m": 30}, "packet_loss_ratio": 0.1},
    )
    return hashlib.sha256(b"".join(run(simulation, 0.5))).hexdigest()


def test_one_seed_gives_the_same_packets_to_the_last_bit() -> None:
    assert digest(5) == digest(5)
    assert digest(5) != digest(6)
