"""The rotating LiDAR: casts each column at the moment it belongs to, returns the device's own packets."""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from simbridge.config import LidarSimConfig
from simbridge.kernels import aim, returns
from simbridge.model import RAY_GROUPS
from simbridge.ouster import COLUMNS_PER_PACKET, SENSOR_ABOVE_BASE_M, PacketWriter, directions_sensor, sensor_info
from simbridge.rotation import matrix_from_rpy
from simbridge.sensors import STEP_NS
from simbridge.streams import stream

Array = NDArray[np.float64]

NS = 1_000_000_000
BIAS = 7  # place in the kernel's parameters
CUTOFF_M = 1000.0


class Lidar:
    """Call `cast` once each step; packets come out as their last column is done."""

    def __init__(
        self, model: mujoco.MjModel, data: mujoco.MjData, body_id: int, cfg: LidarSimConfig, seed: int, began_ns: int,
        step_ns: int = STEP_NS,
    ) -> None:  # fmt: skip
        """body_id: the carrier, which rays pass through. began_ns: simulated time of the first column. step_ns: the
        longest time between two casts."""
        self._model, self._data, self._body_id = model, data, body_id
        self._columns, self._per_s = cfg.columns, cfg.columns * cfg.rate_hz
        self._began_ns, self._clock_offset_ns = began_ns, round(cfg.clock_offset_s * NS)
        self._turn_ns = NS // cfg.rate_hz
        self.metadata_json: str = sensor_info(cfg).to_json_string()
        self._writer = PacketWriter(cfg)
        self._rows = np.array([row for row in range(cfg.rows) if row not in cfg.rows_off], dtype=np.int64)
        turn, self._lever = _true_mount(cfg)
        directions = directions_sensor(cfg)[:, self._rows] @ turn.T
        self._directions = np.ascontiguousarray(np.concatenate([directions, directions]))  # so that no slice wraps
        self._noise_rng, self._chance_rng = stream(seed, "lidar noise"), stream(seed, "lidar chance")
        self._loss_rng, self._loss_ratio = stream(seed, "lidar packets"), cfg.packet_loss_ratio
        self._noise = np.zeros((cfg.columns, len(self._rows)))
        self._chance = np.zeros((cfg.columns, len(self._rows), 3))
        self._params = _parameters(cfg)
        self._offset_m = cfg.offset_sigma_m * float(stream(seed, "lidar offset").standard_normal())
        self.range_bias_m = 0.0
        self._packets_per_turn = cfg.columns // COLUMNS_PER_PACKET
        most = self._per_s * step_ns // NS + 2  # columns of the longest step
        self._shifts, self._origin = np.zeros((most, 3)), np.zeros(3)
        self._rays, self._normals = np.zeros(3 * most * len(self._rows)), np.zeros(3 * most * len(self._rows))
        self._distance = np.zeros(most * len(self._rows))
        self._geom = np.zeros(most * len(self._rows), dtype=np.int32)
        self._next = 0  # column, counted from the first one

    @property
    def range_bias_m(self) -> float:
        """Added to every range beside the unit's own offset: a fault."""
        return float(self._params[BIAS]) - self._offset_m

    @range_bias_m.setter
    def range_bias_m(self, bias_m: float) -> None:
        self._params[BIAS] = bias_m + self._offset_m

    def cast(self, t_middle_ns: int, t_end_ns: int, before: Array, pose: Array, motion: Array) -> list[bytes]:
        """Measure the columns up to t_end and give the packets that are done.

        before, pose: (7,) position and quaternion (wxyz) in `world` at the step's ends; t_middle is halfway. motion: (6,)
        velocity in `world`, turn rate in body (FLU), at the end.
        """
        first, end = self._next, (t_end_ns - self._began_ns) * self._per_s // NS + 1
        if end <= first:
            return []
        self._next = end
        self._shoot(first, end - first, t_middle_ns, before, pose, motion)
        column = first
        while column < end:
            into = column % self._columns
            count = min(end - column, self._columns - into)
            self._receive(into, count, column - first, column // self._columns)
            column += count
        packets = [self._pack(n) for n in range(first // COLUMNS_PER_PACKET, end // COLUMNS_PER_PACKET)]
        if self._loss_ratio > 0.0:
            packets = [packet for packet in packets if self._loss_rng.random() >= self._loss_ratio]
        return packets

    def _shoot(self, first: int, count: int, t_middle_ns: int, before: Array, pose: Array, motion: Array) -> None:
        """One mj_multiRay for the columns of a step, all from the pose's origin, each in its own direction."""
        t_first_s = (self._began_ns + first * NS // self._per_s - t_middle_ns) * 1e-9
        aim(
            self._directions, first % self._columns, count, t_first_s, 1.0 / self._per_s, before, pose, motion,
            self._lever, self._rays, self._shifts, self._origin,
        )  # fmt: skip
        n = count * len(self._rows)
        mujoco.mj_multiRay(
            self._model, self._data, self._origin, self._rays[: 3 * n], RAY_GROUPS, 1, self._body_id,
            self._geom[:n], self._distance[:n], self._normals[: 3 * n], n, CUTOFF_M,
        )  # fmt: skip

    def _receive(self, first: int, count: int, offset: int, turn: int) -> None:
        """Noise and losses on `count` columns of this step's rays, into the packets of the turn that is being filled."""
        if first == 0:
            self._noise_rng.standard_normal(out=self._noise)
            self._chance_rng.random(out=self._chance)
        writer = self._writer
        t_turn_ns = self._began_ns + self._clock_offset_ns + turn * self._turn_ns
        returns(
            self._distance, self._normals, self._rays, self._shifts, offset, count, self._noise, self._chance,
            self._params, self._rows, first, t_turn_ns, self._per_s, writer.stamps, writer.range_mm, writer.signal,
        )  # fmt: skip

    def _pack(self, number: int) -> bytes:
        """The packet of this number, counted from the first turn's first."""
        turn, packet = divmod(number, self._packets_per_turn)
        return self._writer.pack(turn, packet)


def _parameters(cfg: LidarSimConfig) -> Array:
    """In the order that the kernel `returns` reads; BIAS is the last."""
    dust_per_m = 1.0 / cfg.dust.visibility_m if cfg.dust.visibility_m is not None else 0.0
    return np.array(
        [
            cfg.noise_m, cfg.min_range_m, cfg.max_range_m, math.cos(math.radians(cfg.grazing_deg)),
            cfg.dropout_ratio, dust_per_m, cfg.dust.lost_ratio, 0.0,
        ]
    )  # fmt: skip


def _true_mount(cfg: LidarSimConfig) -> tuple[Array, Array]:
    """Rotation (3, 3) sensor to body, and the beams' origin in body, both with the mount's error."""
    rpy = np.radians(np.array(cfg.mount_rpy_deg) + np.array(cfg.mount_error_rpy_deg))
    turn = matrix_from_rpy(rpy)
    position = np.array(cfg.mount_position_m) + np.array(cfg.mount_error_position_m)
    return turn, np.asarray(position + turn @ np.array([0.0, 0.0, SENSOR_ABOVE_BASE_M]))
