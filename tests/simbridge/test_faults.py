"""What a mission lets go wrong does go wrong: then, so long, in that way, and by the seed."""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np
import pytest
from pymavlink.dialects.v20 import common as mavlink

from simbridge.config import FaultConfig
from simbridge.faults import LinkFaults
from simbridge.loop import BOOT_NS, Simulation
from simbridge.sensors import GRAVITY_MPS2
from tests.simbridge.stores import HOVER, Motors, lift, run, sim_config

KINDS = get_args(FaultConfig.model_fields["kind"].annotation)
MS = 1_000_000


def flown(fault: dict[str, Any], seconds: float = 2.0, **sections: Any) -> tuple[Motors, list[tuple[int, bytes]]]:
    """A second of flight with a fault from 1 s on; what the flight controller heard, and packets with their times."""
    motors = Motors(HOVER)
    simulation = Simulation(sim_config(faults=[{"at_s": 1.0, **fault}], **sections), motors)
    lift(simulation, 6.0)
    packets = []
    for _ in range(round(seconds * 250)):
        simulation.step()
        packets += [(simulation.t_ns - BOOT_NS, p) for p in simulation.take_lidar_packets()]
    return motors, packets


def split(packets: list[tuple[int, bytes]]) -> tuple[list[bytes], list[bytes]]:
    return [p for t, p in packets if t < 1000 * MS], [p for t, p in packets if t >= 1000 * MS]


def frame_ids(packets: list[bytes]) -> list[int]:
    return [int.from_bytes(p[2:4], "little") for p in packets]


@pytest.mark.parametrize("kind", KINDS)
def test_lidar_fault_leaves_what_came_before_it_untouched(kind: str) -> None:
    _, sound = flown({"target": "lidar", "kind": "off"})
    _, packets = flown({"target": "lidar", "kind": kind})
    assert split(packets)[0] == split(sound)[0]
    assert len(split(packets)[0]) > 300


def test_lidar_off_sends_nothing_and_comes_back() -> None:
    _, packets = flown({"target": "lidar", "kind": "off", "duration_s": 0.5})
    during = [p for t, p in packets if 1000 * MS <= t < 1500 * MS]
    after = [p for t, p in packets if t >= 1500 * MS]
    assert during == []
    assert len(after) > 150


def test_lidar_stuck_sends_its_last_whole_turn_again_and_again() -> None:
    before, after = split(flown({"target": "lidar", "kind": "stuck"})[1])
    assert len(after) == pytest.approx(320, abs=2)
    assert set(after) <= set(before)
    assert set(frame_ids(after)) == {8}  # turn 9 was being measured when it stuck
    assert after[:32] == after[32:64]


def test_lidar_garbage_is_not_what_was_measured() -> None:
    _, sound = flown({"target": "lidar", "kind": "slow", "at_s": 100})
    _, after = split(flown({"target": "lidar", "kind": "garbage"})[1])
    assert len(after) == pytest.approx(320, abs=2)
    assert not {p for _, p in sound} & set(after)
    assert {len(p) for p in after} > {1216}


def test_lidar_wrong_measures_too_far_in_sound_packets() -> None:
    _, packets = flown({"target": "lidar", "kind": "wrong", "wrong_by": 0.5})
    before, after = split(packets)

    def first_range(packet: bytes) -> float:
        return (int.from_bytes(packet[44:48], "little") & 0x7FFFF) * 0.001  # RNG19: first pixel after two headers

    assert first_range(before[0]) == pytest.approx(4.0, abs=0.01)  # the wall behind
    late = [p for p in after if int.from_bytes(p[40:42], "little") == 0]
    assert [first_range(p) for p in late] == pytest.approx([4.5] * len(late), abs=0.02)


def test_lidar_slow_drops_whole_turns() -> None:
    _, after = split(flown({"target": "lidar", "kind": "slow", "slow_ratio": 0.5}, seconds=3.0)[1])
    ids = frame_ids(after)
    assert len(set(ids)) == pytest.approx(10, abs=1)
    whole = [ids.count(n) for n in sorted(set(ids))[1:-1]]
    assert set(whole) == {32}


def test_lidar_delayed_comes_later_but_complete() -> None:
    _, sound = flown({"target": "lidar", "kind": "slow", "at_s": 100})
    _, late = flown({"target": "lidar", "kind": "delayed", "delay_s": 0.2})
    sent = {p: t for t, p in sound}
    delays = {t - sent[p] for t, p in late if sent[p] >= 1000 * MS}
    assert delays == {200 * MS}


def test_lidar_intermittent_comes_and_goes_by_the_seed() -> None:
    fault = {"target": "lidar", "kind": "intermittent", "loss_ratio": 0.5}
    counts = []
    for seed in (1, 2):
        _, packets = flown(fault, seconds=6.0, seed=seed)
        counts.append([sum(1 for t, _ in packets if k * 500 * MS <= t < (k + 1) * 500 * MS) for k in range(2, 12)])
    assert {0, 1} == {int(n > 80) for n in counts[0]}
    assert all(n < 5 or n > 150 for n in counts[0] + counts[1])
    assert counts[0] != counts[1]
    assert flown(fault, seconds=2.0, seed=1)[1] == flown(fault, seconds=2.0, seed=1)[1]


@pytest.mark.parametrize("kind", KINDS)
def test_rangefinder_fault_shows(kind: str) -> None:
    motors, _ = flown({"target": "rangefinder", "kind": kind, "wrong_by": 3.0, "delay_s": 0.4})
    before = [r for r in motors.rangefinder[:250] if r is not None]
    after = [r for r in motors.rangefinder[250:] if r is not None]
    assert len(before) == 50
    expected = {"off": 0, "slow": 25, "delayed": 30, "intermittent": None}.get(kind, 50)
    if expected is not None:
        assert len(after) == pytest.approx(expected, abs=1)
    match kind:
        case "stuck":
            assert set(after) == {before[-1]}
        case "wrong":
            assert after[0] == pytest.approx(before[-1] + 3.0, abs=0.1)
        case "garbage":
            assert np.std(after) > 5.0
        case "intermittent":
            assert len(after) in (0, 25, 50)
        case _:
            pass


def test_baro_wrong_shifts_pressure_and_altitude_together() -> None:
    motors, _ = flown({"target": "baro", "kind": "wrong", "wrong_by": -1.0})
    before = [b for b in motors.baro[:250] if b is not None][-1]
    after = next(b for b in motors.baro[250:] if b is not None)
    assert after.pressure_hpa == pytest.approx(before.pressure_hpa - 1.0, abs=0.01)
    assert after.pressure_altitude_m == pytest.approx(before.pressure_altitude_m + 8.7, abs=0.3)


@pytest.mark.parametrize("kind", KINDS)
def test_imu_fault_shows_and_there_is_always_a_sample(kind: str) -> None:
    motors, _ = flown({"target": "imu", "kind": kind, "duration_s": 0.5}, vehicle={"imu": {"part": "bmi088"}})
    accel = np.array([s.accel_frd_mps2 for s in motors.imu])
    assert len(accel) == 500
    assert accel[50:250, 2].mean() == pytest.approx(-GRAVITY_MPS2, abs=0.3)
    assert accel[375:, 2].mean() == pytest.approx(-GRAVITY_MPS2, abs=0.3)
    during = accel[250:375]
    match kind:
        case "off":
            assert not during.any()
        case "stuck":
            assert len(np.unique(during, axis=0)) == 1
        case "garbage":
            assert during.std() > 50
        case "wrong":
            assert during[:, 0].mean() == pytest.approx(1.0, abs=0.1)
        case "slow":
            assert len(np.unique(during, axis=0)) == pytest.approx(63, abs=1)
        case "delayed" | "intermittent":
            assert len(np.unique(during, axis=0)) <= 125


def test_fault_since_liftoff_waits_for_it() -> None:
    motors = Motors(0.0)
    fault = {"target": "lidar", "kind": "off", "at_s": 0.2, "since": "liftoff"}
    simulation = Simulation(sim_config(faults=[fault]), motors)
    assert len(run(simulation, 1.0)) > 300
    assert simulation.liftoff_ns is None
    lift(simulation, 1.0)
    motors.command = np.full(4, HOVER)
    run(simulation, 0.3)
    assert simulation.liftoff_ns == BOOT_NS + 1004 * MS
    assert run(simulation, 0.5) == []


# ------------------------------------------------------------------------------------------------------------ MAVLink


def odometry(n: int) -> bytes:
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=197)
    mav.seq = n % 256
    zero21 = [0.0] * 21
    message = mavlink.MAVLink_odometry_message(
        n, 1, 12, 1.5, 2.5, -9.0, [1, 0, 0, 0], 0.4, 0, 0, 0, 0, 0, zero21, zero21, 0, 4, 90
    )
    return bytes(message.pack(mav))


def setpoint(n: int) -> bytes:
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
    mav.seq = n % 256
    message = mavlink.MAVLink_set_position_target_local_ned_message(
        n, 1, 1, 8, 0x5C7, 0, 0, 0, 0.43, 0, 0, 0, 0, 0, 0, 0.1
    )
    return bytes(message.pack(mav))


def through(
    fault: dict[str, Any], direction: Literal["to_autopilot", "from_autopilot"] = "to_autopilot", seed: int = 0
) -> list[tuple[int, bytes]]:
    """Two seconds of one ODOMETRY and one setpoint each 40 ms, faulty from 1 s on; times in ms."""
    link = LinkFaults((FaultConfig.model_validate({"at_s": 1.0, **fault}),), direction, seed)
    out = []
    for ms in range(0, 2000, 4):
        frames = [odometry(ms), setpoint(ms)] if ms % 40 == 0 else []
        out += [(ms, f) for f in link.pass_on(frames, BOOT_NS + ms * MS)]
    return out


def of(message_id: int, frames: list[tuple[int, bytes]], after_ms: int = 1000) -> list[tuple[int, bytes]]:
    return [(t, f) for t, f in frames if t >= after_ms and int.from_bytes(f[7:10], "little") == message_id]


ODOMETRY, SETPOINT = 331, 84


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("target", "hit", "spared"), [("vision", ODOMETRY, SETPOINT), ("setpoint", SETPOINT, ODOMETRY)]
)
def test_link_fault_hits_only_its_messages_and_only_then(kind: str, target: str, hit: int, spared: int) -> None:
    sound = through({"target": "from_autopilot", "kind": "off"})
    out = through({"target": target, "kind": kind, "loss_ratio": 1.0})
    assert [f for f in out if f[0] < 1000] == [f for f in sound if f[0] < 1000]
    assert of(spared, out) == of(spared, sound)
    assert of(hit, out) != of(hit, sound)


@pytest.mark.parametrize(("kind", "arrive"), [("off", 0), ("slow", 12), ("intermittent", 0), ("stuck", 25)])
def test_vision_arrives_as_often_as_the_fault_lets_it(kind: str, arrive: int) -> None:
    out = of(ODOMETRY, through({"target": "vision", "kind": kind, "loss_ratio": 1.0}))
    assert len(out) == pytest.approx(arrive, abs=1)


def test_stuck_vision_repeats_its_last_frame() -> None:
    assert {f for _, f in of(ODOMETRY, through({"target": "vision", "kind": "stuck"}))} == {odometry(960)}


def test_delayed_vision_comes_late_and_unchanged() -> None:
    out = of(ODOMETRY, through({"target": "vision", "kind": "delayed", "delay_s": 0.2}))
    assert out[0] == (1200, odometry(1000))
    assert out[-1] == (1960, odometry(1760))


@pytest.mark.parametrize(
    ("target", "message_id", "name", "value"), [("vision", ODOMETRY, "x", 3.5), ("setpoint", SETPOINT, "vx", 2.43)]
)
def test_wrong_frame_is_sound_but_says_something_else(target: str, message_id: int, name: str, value: float) -> None:
    _, frame = of(message_id, through({"target": target, "kind": "wrong", "wrong_by": 2.0}))[0]
    original = odometry(1000) if message_id == ODOMETRY else setpoint(1000)
    message = mavlink.MAVLink(None).decode(bytearray(frame))
    before = mavlink.MAVLink(None).decode(bytearray(original))
    assert getattr(message, name) == pytest.approx(value)
    assert message.get_header().seq == before.get_header().seq
    assert message.get_srcComponent() == before.get_srcComponent()
    rest = {k: v for k, v in message.to_dict().items() if k != name}
    assert rest == {k: v for k, v in before.to_dict().items() if k != name}


def test_signed_frame_cannot_be_bent() -> None:
    frame = bytearray(odometry(1000))
    frame[2] |= 1
    link = LinkFaults((FaultConfig(target="vision", kind="wrong", at_s=0),), "to_autopilot", 0)
    assert link.pass_on([bytes(frame)], BOOT_NS) == [bytes(frame)]


def test_garbage_cannot_be_read() -> None:
    sound = {odometry(ms) for ms in range(2000)}
    out = [f for t, f in through({"target": "to_autopilot", "kind": "garbage"}) if t >= 1000]
    assert len(out) == 50
    assert not set(out) & sound


@pytest.mark.parametrize(("direction", "left"), [("to_autopilot", 0), ("from_autopilot", 50)])
def test_dead_link_is_dead_in_its_direction(direction: Literal["to_autopilot", "from_autopilot"], left: int) -> None:
    out = through({"target": "to_autopilot", "kind": "off"}, direction)
    assert sum(1 for t, _ in out if t >= 1000) == left


def test_bytes_that_are_no_mavlink_pass_a_message_fault() -> None:
    link = LinkFaults((FaultConfig(target="vision", kind="off", at_s=0),), "to_autopilot", 0)
    odd = [b"", b"\xfd", b"\xfe\x00\x01", bytes(300)]
    assert link.pass_on(odd, BOOT_NS) == odd
