"""Messages and small recordings for tests."""

from __future__ import annotations

import numpy as np

from companion import messages as m
from companion.recording.mcap_write import Channel, McapWriter, Schema


def an_estimate(t_ns: int = 1, seed: int = 0) -> m.OdometryEstimate:
    rng = np.random.default_rng(seed)
    return m.OdometryEstimate(
        t_ns=t_ns,
        t_scan_ns=t_ns - 5,
        position_map_m=rng.normal(size=3),
        q_map_body_wxyz=np.array([1.0, 0.0, 0.0, 0.0]),
        velocity_body_mps=rng.normal(size=3),
        rate_body_radps=rng.normal(size=3),
        pose_covariance=rng.normal(size=(6, 6)),
        velocity_covariance=rng.normal(size=(3, 3)),
        quality=87,
        reset_counter=1,
        converged=True,
        is_degenerate=False,
        inliers=400,
        iterations=4,
        keyframe_id=3,
        is_keyframe=False,
    )


def one_of_each() -> list[object]:
    """Every kind of message that is recorded, with what JSON finds hard."""
    rng = np.random.default_rng(1)
    zero = np.zeros(3)
    return [
        an_estimate(),
        m.AttitudeSample(t_ns=2, q_ref_body_wxyz=rng.normal(size=4), rate_body_radps=np.array([np.nan, -0.0, 5e-324])),
        m.RangefinderSample(t_ns=3, distance_m=float("inf")),
        m.VehicleState(
            t_ns=4, t_heartbeat_ns=3, is_connected=True, is_armed=False, mode=m.FlightMode.HOLD, is_failsafe=False,
            landed_state=m.LandedState.IN_AIR, position_map_m=rng.normal(size=3), velocity_map_mps=None,
            battery_ratio=0.1, is_position_valid=True, is_ready_to_arm=False, not_ready_because=("no origin", "é"),
        ),
        m.WallRanges(
            t_ns=5, front_m=None, right_m=0.1 + 0.2, ranges_m=np.where(rng.random(360) < 0.5, np.inf, rng.random(360)),
            is_seen=rng.random(360) < 0.5,
        ),
        m.Setpoint(t_ns=6, kind=m.SetpointKind.SILENT, velocity_map_mps=zero, yaw_rate_radps=1e-300, reason='a "b"'),
        m.VehicleRequest(t_ns=7, kind=m.RequestKind.LAND),
        m.OperatorCommand(t_ns=8, kind=m.OperatorCommandKind.ABORT, source="mqtt"),
        m.Event(t_ns=9, severity=m.Severity.CRITICAL, name="x", text="line\nbreak"),
        m.VolumeReport(
            volume_m3=1000.125, interval_m3=(999.0, 1001.0), interval_level=0.95, seen_ratio=0.9,
            interpolated_ratio=0.05, unseen_ratio=0.05, floor_area_m2=1.0, pile_area_m2=0.5, x_m=rng.random(20),
            y_m=rng.random(10), surface_z_m=np.full((10, 20), np.nan), floor_z_m=rng.random((10, 20)),
            cell_state=rng.integers(0, 4, (10, 20)).astype(np.int8), warnings=("w",),
        ),
    ]  # fmt: skip


def small_recording(messages: int = 300, chunk_bytes: int = 2000) -> bytes:
    """A whole MCAP file with two channels, metadata and an attachment, in several chunks."""
    out = bytearray()
    writer = McapWriter(out.extend, chunk_bytes=chunk_bytes)
    writer.add_schema(Schema(1, "name", "jsonschema", b"{}"))
    writer.add_channel(Channel(1, 1, "a", "json", {"key": "value"}))
    writer.add_channel(Channel(2, 0, "b", "raw"))
    writer.add_metadata("run", {"mission": "small"})
    writer.add_attachment("config.json", "application/json", b'{"a": 1}', 5)
    for n in range(messages):
        writer.add_message(1 + n % 2, 1000 + n * 10, b"%d " % n * 10)
    writer.finish()
    return bytes(out)
