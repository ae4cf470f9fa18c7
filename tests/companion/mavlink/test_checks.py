"""The doctor's checks, each gate of fusion broken by itself and named."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from companion.mavlink.checks import Check, Facts, SentVision, Verdict, all_checks, is_green
from companion.mavlink.fusion import check_fusion
from companion.mavlink.manifest import MANIFESTS

NAN = float("nan")


def vision(autopilot: str = "px4", **changes: Any) -> SentVision:
    fields: dict[str, Any] = {
        "rate_hz": 30.0,
        "max_gap_s": 0.04,
        "frame_id": 1 if autopilot == "px4" else 20,
        "child_frame_id": 12,
        "estimator_type": 3,
        "norm_error": 1e-7,
        "quality": 90,
        "position_sigma_m": 0.1,
    }
    return SentVision(**{**fields, **changes})


def healthy(kind: str = "px4", **changes: Any) -> Facts:
    facts = Facts(
        autopilot=kind,
        version="1.18.0" if kind == "px4" else "4.6.1",
        parameters={e.name: e.mend for e in MANIFESTS[kind].parameters},
        rates_hz=dict.fromkeys(
            ("HEARTBEAT", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "ESTIMATOR_STATUS", "EKF_STATUS_REPORT"), 10.0
        ),
        timesync_round_trip_s=0.002,
        has_origin=True,
        origin_altitude_m=0.0,
        sensors_present=1 | 2 | 8,
        sensors_health=1 | 2 | 8,
        battery_ratio=0.9,
        estimator_flags=511,
        is_vision_fused=True,
        ratios={"position": 0.1, "velocity": 0.1, "height": 0.1, "heading": 0.1},
        lidar_packets_hz=320.0,
        lidar_sources=("10.0.0.5",),
        clock_drift_s=0.0,
        clock_year=2026,
        disk_free_gib=100.0,
        vision=vision(kind),
    )
    return replace(facts, **changes)


def named(checks: list[Check]) -> dict[str, Check]:
    return {check.name: check for check in checks}


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_a_healthy_vehicle_is_green_in_every_line(autopilot: str) -> None:
    checks = all_checks(healthy(autopilot))
    assert is_green(checks)
    assert {check.verdict for check in checks} == {Verdict.OK}
    assert len({check.name for check in checks}) == len(checks) > 20


GATES = [
    ("px4", {"parameters": {"EKF2_EV_CTRL": 0}}, {}, "switch"),
    ("px4", {"parameters": {"EKF2_EV_CTRL": 1}}, {}, "switch"),
    ("px4", {"parameters": {"EKF2_SENS_EN": 8183}}, {}, "switch"),
    ("ardupilot", {"parameters": {"VISO_TYPE": 0}}, {}, "switch"),
    ("ardupilot", {"parameters": {"EK3_SRC1_POSXY": 3}}, {}, "switch"),
    ("px4", {}, {"rate_hz": 4.0, "max_gap_s": 0.25}, "rate"),
    ("px4", {}, {"rate_hz": 29.0, "max_gap_s": 0.4}, "rate"),
    ("ardupilot", {}, {"rate_hz": 2.0, "max_gap_s": 0.5}, "rate"),
    ("px4", {}, {"frame_id": 14}, "frame"),
    ("px4", {}, {"child_frame_id": 14}, "frame"),
    ("ardupilot", {}, {"frame_id": 1}, "frame"),
    ("ardupilot", {}, {"child_frame_id": 8}, "frame"),
    ("px4", {}, {"estimator_type": 6}, "estimator_type"),
    ("px4", {}, {"estimator_type": 7}, "estimator_type"),
    ("px4", {"texts": ("ODOMETRY: estimator_type 7 unsupported",), "vision": None}, None, "estimator_type"),
    ("px4", {}, {"norm_error": 1e-3}, "quaternion"),
    ("px4", {"parameters": {"EKF2_EV_QMIN": 95}}, {}, "quality"),
    ("ardupilot", {}, {"quality": -1}, "quality"),
    ("px4", {}, {"position_sigma_m": NAN}, "covariance"),
    ("px4", {}, {"position_sigma_m": 30.0}, "covariance"),
    ("px4", {}, {"stamps_forward": False}, "time"),
    ("px4", {"ratios": {"position": 7.0}}, {}, "innovation"),
]


@pytest.mark.parametrize(("autopilot", "broken", "sent", "gate"), GATES)
def test_each_shut_gate_is_named_alone(
    autopilot: str, broken: dict[str, Any], sent: dict[str, Any] | None, gate: str
) -> None:
    """Issue 4: fusion: is what we send really fused, and if not, which gate stops it. AUTOPILOTS.md: "starts only if
    two samples are < 200 ms apart and the newest is < 200 ms old". PX4.md: "6 MOCAP -> vehicle_mocap_odometry, not
    read by EKF2"."""
    facts = healthy(autopilot, is_vision_fused=False, estimator_flags=229)
    if "parameters" in broken:
        broken = {"parameters": {**facts.parameters, **broken["parameters"]}}
    if sent is not None:
        broken = {**broken, "vision": vision(autopilot, **sent)}
    checks = check_fusion(replace(facts, **broken))
    assert [c.name for c in checks] == ["fusion", f"fusion.{gate}"]
    assert all(c.verdict is Verdict.FAIL for c in checks)
    assert gate in checks[0].actual
    assert checks[1].mend


def test_a_gate_shut_in_part_is_red_though_flags_say_fused() -> None:
    """PX4.md 7: dropped in silence, whole or in part: a bad child frame drops the velocity only."""
    checks = check_fusion(healthy(vision=vision(child_frame_id=14)))
    assert checks[0].verdict is Verdict.FAIL
    assert checks[1].name == "fusion.frame"


@pytest.mark.parametrize(("part", "gate"), [("position", "frame"), ("velocity", "frame"), ("heading", "quaternion")])
def test_a_part_that_px4_drops_is_told_without_knowing_what_was_sent(part: str, gate: str) -> None:
    """Recorded in wrong_input: flags stay 511, the test ratio of the dropped part is not a number. PX4.md: "Any other
    frame_id: position dropped silently (attitude/velocity still used)"."""
    facts = healthy(vision=None)
    facts = replace(facts, ratios={name: ratio for name, ratio in facts.ratios.items() if name != part})
    checks = check_fusion(facts)
    assert [c.name for c in checks] == ["fusion", f"fusion.{gate}"]
    assert not is_green(checks)


def test_what_cannot_be_explained_is_said_so() -> None:
    (check,) = check_fusion(healthy(is_vision_fused=False))
    assert check.verdict is Verdict.FAIL
    assert "no gate that we know" in check.actual


def test_without_vision_nothing_is_claimed() -> None:
    (check,) = check_fusion(healthy(is_vision_fused=False, vision=None))
    assert check.verdict is Verdict.WARN


BROKEN = [
    ({"autopilot": "other"}, "firmware.autopilot", Verdict.FAIL),
    ({"version": "1.12.3"}, "firmware.version", Verdict.WARN),
    ({"version": None}, "firmware.version", Verdict.WARN),
    ({"timesync_round_trip_s": None}, "time.sync", Verdict.FAIL),
    ({"timesync_round_trip_s": 0.05}, "time.sync", Verdict.WARN),
    ({"rates_hz": {}}, "stream.ATTITUDE_QUATERNION", Verdict.FAIL),
    ({"sensors_health": 2 | 8}, "sensor.gyroscope", Verdict.FAIL),
    ({"sensors_health": None}, "sensors", Verdict.WARN),
    ({"battery_ratio": 0.4}, "sensor.battery", Verdict.WARN),
    ({"battery_ratio": 0.1}, "sensor.battery", Verdict.FAIL),
    ({"has_origin": False}, "origin", Verdict.WARN),
    ({"origin_altitude_m": 489.4}, "origin", Verdict.FAIL),
    ({"lidar_packets_hz": 0.0}, "lidar", Verdict.FAIL),
    ({"lidar_packets_hz": None}, "lidar", Verdict.SKIPPED),
    ({"lidar_sources": ("10.0.0.5", "10.0.0.6")}, "lidar", Verdict.WARN),
    ({"clock_drift_s": 3600.0}, "computer.clock", Verdict.WARN),
    ({"disk_free_gib": 1.5}, "computer.disk", Verdict.FAIL),
    ({"is_vision_fused": None}, "fusion", Verdict.FAIL),
]


@pytest.mark.parametrize(("changes", "name", "verdict"), BROKEN)
def test_each_broken_fact_turns_its_own_line(changes: dict[str, Any], name: str, verdict: Verdict) -> None:
    checks = named(all_checks(healthy(**changes)))
    assert checks[name].verdict is verdict
    if verdict is Verdict.FAIL:
        assert checks[name].mend
        assert not is_green(list(checks.values()))
