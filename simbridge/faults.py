"""What goes wrong, by time and seed, in PX4's words: off, stuck, garbage, wrong, slow, delayed, intermittent.

A `Channel` spoils one stream of items (sensor samples, LiDAR packets, MAVLink frames) while its fault lasts.
`SensorFaults` holds those of the sensors and belongs to the Simulation; `LinkFaults` those of one direction of the
MAVLink link and belongs to whoever carries the bytes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Generic, Literal, TypeVar

import numpy as np

from simbridge import link_frames
from simbridge.config import FaultConfig
from simbridge.sensors import BaroSample, ImuSample, isa_altitude_m
from simbridge.streams import stream

T = TypeVar("T")
NS = 1_000_000_000
BLINK_NS = 500_000_000  # intermittent: comes or stays away for this long at a time
DIRECTIONS: dict[str, str] = {"vision": "to_autopilot", "setpoint": "to_autopilot"}


class Channel(Generic[T]):
    """One stream under one fault. group: items with the same number belong together (a LiDAR's turn)."""

    def __init__(
        self,
        cfg: FaultConfig,
        rng: np.random.Generator,
        *,
        spoil: Callable[[T, np.random.Generator], T],
        bend: Callable[[T, float], T],
        group: Callable[[T], int] | None = None,
    ) -> None:
        self.cfg = cfg
        self._rng, self._spoil, self._bend, self._group = rng, spoil, bend, group
        self._late: deque[tuple[int, T]] = deque()
        self._last: list[T] = []  # the newest whole group before the fault
        self._current: list[T] = []
        self._current_group: int | None = None
        self._repeats = 0
        self._credit = 0.0
        self._slow_group: tuple[int | None, bool] = (None, True)
        self._blink: tuple[int, bool] = (-1, True)

    def is_active(self, t_ns: int, boot_ns: int, liftoff_ns: int | None) -> bool:
        since = boot_ns if self.cfg.since == "boot" else liftoff_ns
        if since is None:
            return False
        begin = since + round(self.cfg.at_s * NS)
        return begin <= t_ns and (self.cfg.duration_s is None or t_ns < begin + round(self.cfg.duration_s * NS))

    def pass_on(self, items: Iterable[T], t_ns: int, *, is_active: bool) -> list[T]:
        """What becomes of the items at time t; call it each step, since late ones come out too."""
        out: list[T] = []
        while self._late and self._late[0][0] <= t_ns:
            out.append(self._late.popleft()[1])
        for item in items:
            if is_active:
                out += self._faulty(item, t_ns)
            else:
                self._remember(item)
                out.append(item)
        return out

    def _faulty(self, item: T, t_ns: int) -> list[T]:
        match self.cfg.kind:
            case "off":
                return []
            case "stuck":
                return self._again()
            case "garbage":
                return [self._spoil(item, self._rng)]
            case "wrong":
                return [self._bend(item, self.cfg.wrong_by)]
            case "slow":
                return [item] if self._is_spared(item) else []
            case "delayed":
                self._late.append((t_ns + round(self.cfg.delay_s * NS), item))
                return []
            case "intermittent":
                return [item] if self._is_there(t_ns) else []

    def _remember(self, item: T) -> None:
        number = None if self._group is None else self._group(item)
        if number is None or number != self._current_group:
            self._last, self._current, self._current_group = self._current, [], number
        self._current.append(item)

    def _again(self) -> list[T]:
        source = self._last if self._group is not None and self._last else self._current
        if not source:
            return []
        self._repeats += 1
        return [source[(self._repeats - 1) % len(source)]]

    def _is_spared(self, item: T) -> bool:
        number = None if self._group is None else self._group(item)
        if number is None or number != self._slow_group[0]:
            self._credit += self.cfg.slow_ratio
            spared = self._credit >= 1.0
            self._credit -= 1.0 if spared else 0.0
            self._slow_group = (number, spared)
        return self._slow_group[1]

    def _is_there(self, t_ns: int) -> bool:
        block = t_ns // BLINK_NS
        if block != self._blink[0]:
            self._blink = (block, float(self._rng.random()) >= self.cfg.loss_ratio)
        return self._blink[1]


class SensorFaults:
    """The faults of LiDAR, inertial unit, barometer and rangefinder. Set liftoff_ns when the vehicle takes off."""

    def __init__(self, faults: tuple[FaultConfig, ...], seed: int, boot_ns: int) -> None:
        self.liftoff_ns: int | None = None
        self._boot_ns = boot_ns
        self._lidar = _channels(faults, "lidar", seed, spoil=_noise_bytes, bend=_unbent, group=_turn_of)
        self._imu = _channels(faults, "imu", seed, spoil=_spoilt_imu, bend=_bent_imu)
        self._baro = _channels(faults, "baro", seed, spoil=_spoilt_baro, bend=_bent_baro)
        self._rangefinder = _channels(faults, "rangefinder", seed, spoil=_spoilt_range, bend=_bent_range)
        self._held_imu: ImuSample | None = None

    def imu(self, sample: ImuSample, t_ns: int) -> ImuSample:
        """There is always a sample: off gives zeros, one that stays away the last one again."""
        if not self._imu:
            return sample
        passed = self._run(self._imu, [sample], t_ns)
        if passed:
            self._held_imu = passed[-1]
        if any(c.cfg.kind == "off" and c.is_active(t_ns, self._boot_ns, self.liftoff_ns) for c in self._imu):
            return ImuSample(accel_frd_mps2=np.zeros(3), gyro_frd_radps=np.zeros(3))
        return self._held_imu or sample

    def baro(self, sample: BaroSample | None, t_ns: int) -> BaroSample | None:
        return sample if not self._baro else _newest(self._run(self._baro, _listed(sample), t_ns))

    def rangefinder(self, distance_m: float | None, t_ns: int) -> float | None:
        return distance_m if not self._rangefinder else _newest(self._run(self._rangefinder, _listed(distance_m), t_ns))

    def lidar(self, packets: list[bytes], t_ns: int) -> list[bytes]:
        return packets if not self._lidar else self._run(self._lidar, packets, t_ns)

    def lidar_bias_m(self, t_ns: int) -> float:
        """What a wrong LiDAR adds to its ranges: it measures so, its packets are sound."""
        if not self._lidar:
            return 0.0
        return sum(
            c.cfg.wrong_by
            for c in self._lidar
            if c.cfg.kind == "wrong" and c.is_active(t_ns, self._boot_ns, self.liftoff_ns)
        )

    def _run(self, channels: list[Channel[T]], items: list[T], t_ns: int) -> list[T]:
        for channel in channels:
            active = channel.is_active(t_ns, self._boot_ns, self.liftoff_ns)
            items = channel.pass_on(items, t_ns, is_active=active)
        return items


class LinkFaults:
    """The faults of one direction of the MAVLink link, on whole frames as bytes."""

    def __init__(
        self,
        faults: tuple[FaultConfig, ...],
        direction: Literal["to_autopilot", "from_autopilot"],
        seed: int,
        boot_ns: int = NS,
    ) -> None:
        """boot_ns: simulated time at which the mission's faults begin to count (`loop.BOOT_NS`)."""
        self._boot_ns = boot_ns
        self._channels: list[tuple[frozenset[int] | None, Channel[bytes]]] = []
        for target in ("vision", "setpoint", "to_autopilot", "from_autopilot"):
            if DIRECTIONS.get(target, target) != direction:
                continue
            for channel in _channels(faults, target, seed, spoil=_noise_bytes, bend=link_frames.bent):
                self._channels.append((link_frames.MESSAGES.get(target), channel))

    def pass_on(self, frames: list[bytes], t_ns: int, liftoff_ns: int | None = None) -> list[bytes]:
        """What of these frames arrives at time t, with late ones; call it each step, also without frames.

        liftoff_ns: `Simulation.liftoff_ns`, for faults that count from there.
        """
        for messages, channel in self._channels:
            active = channel.is_active(t_ns, self._boot_ns, liftoff_ns)
            out = channel.pass_on((), t_ns, is_active=active)
            for frame in frames:
                if messages is None or link_frames.message_id(frame) in messages:
                    out += channel.pass_on((frame,), t_ns, is_active=active)
                else:
                    out.append(frame)
            frames = out
        return frames


def _channels(
    faults: tuple[FaultConfig, ...],
    target: str,
    seed: int,
    *,
    spoil: Callable[[T, np.random.Generator], T],
    bend: Callable[[T, float], T],
    group: Callable[[T], int] | None = None,
) -> list[Channel[T]]:
    return [
        Channel(cfg, stream(seed, f"fault {i}"), spoil=spoil, bend=bend, group=group)
        for i, cfg in enumerate(faults)
        if cfg.target == target
    ]


def _listed(item: T | None) -> list[T]:
    return [] if item is None else [item]


def _newest(items: list[T]) -> T | None:
    return items[-1] if items else None


def _turn_of(packet: bytes) -> int:
    return int.from_bytes(packet[2:4], "little")  # frame id: Ouster lidar packet header


def _noise_bytes(data: bytes, rng: np.random.Generator) -> bytes:
    """As long as it was, or cut short; nothing in it means anything."""
    length = len(data) if rng.random() < 0.5 else int(rng.integers(1, len(data) + 1))
    return rng.bytes(length)


def _unbent(data: bytes, by: float) -> bytes:
    return data


def _spoilt_imu(sample: ImuSample, rng: np.random.Generator) -> ImuSample:
    return ImuSample(accel_frd_mps2=rng.uniform(-156.0, 156.0, 3), gyro_frd_radps=rng.uniform(-35.0, 35.0, 3))


def _bent_imu(sample: ImuSample, by: float) -> ImuSample:
    return replace(sample, accel_frd_mps2=sample.accel_frd_mps2 + np.array([by, 0.0, 0.0]))


def _spoilt_baro(sample: BaroSample, rng: np.random.Generator) -> BaroSample:
    return _bent_baro(sample, float(rng.uniform(-200.0, 200.0)))


def _bent_baro(sample: BaroSample, by: float) -> BaroSample:
    pressure = sample.pressure_hpa + by
    return replace(sample, pressure_hpa=pressure, pressure_altitude_m=isa_altitude_m(pressure))


def _spoilt_range(distance_m: float, rng: np.random.Generator) -> float:
    return float(rng.uniform(0.0, 50.0))


def _bent_range(distance_m: float, by: float) -> float:
    return distance_m + by
