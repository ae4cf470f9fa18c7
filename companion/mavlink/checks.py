"""Is this vehicle fit to fly: pure checks over gathered facts. `stockpilot doctor` gathers them through MAVSDK, the
session through its own link; what is red here is red before arming too."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum

from companion.mavlink.manifest import MANIFESTS, Manifest


class Verdict(Enum):
    OK = "ok"
    WARN = "warn"
    FAIL = "fail"
    SKIPPED = "skipped"


@dataclass(frozen=True, slots=True, kw_only=True)
class Check:
    """One line of the report. name: stable, group.item. mend: what to do about it; empty when all is well."""

    name: str
    verdict: Verdict
    actual: str
    expected: str = ""
    why: str = ""
    mend: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class SentVision:
    """ODOMETRY as it left, over some seconds. max_gap_s: longest pause. norm_error: of the quaternion. position_sigma_m:
    square root of the largest diagonal element of position; NaN: unset. stamps_forward: each time_usec later than the
    one before."""

    rate_hz: float
    max_gap_s: float
    frame_id: int
    child_frame_id: int
    estimator_type: int
    norm_error: float
    quality: int
    position_sigma_m: float
    stamps_forward: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Facts:
    """What is known of a vehicle. None: could not be read. parameters: None for a name that the autopilot does not
    have. ratios: innovation test ratios of the estimator, above 1 is rejected. texts: what it said meanwhile."""

    autopilot: str | None
    version: str | None = None
    is_armed: bool = False
    parameters: Mapping[str, float | None] = field(default_factory=dict)
    rates_hz: Mapping[str, float] = field(default_factory=dict)
    timesync_round_trip_s: float | None = None
    has_origin: bool | None = None
    origin_altitude_m: float | None = None
    sensors_present: int | None = None
    sensors_health: int | None = None
    battery_ratio: float | None = None
    estimator_flags: int | None = None
    is_vision_fused: bool | None = None
    ratios: Mapping[str, float] = field(default_factory=dict)
    texts: tuple[str, ...] = ()
    lidar_packets_hz: float | None = None
    lidar_sources: tuple[str, ...] = ()
    clock_drift_s: float | None = None
    clock_year: int | None = None
    disk_free_gib: float | None = None
    disk_reserve_gib: float = 2.0
    vision: SentVision | None = None


def all_checks(facts: Facts) -> list[Check]:
    """Every check, in the order of a report."""
    from companion.mavlink.fusion import check_fusion

    if facts.autopilot not in MANIFESTS:
        return [*check_firmware(facts), *check_lidar(facts), *check_computer(facts)]
    return [
        *check_firmware(facts),
        *check_parameters(facts),
        *check_time(facts),
        *check_streams(facts),
        *check_sensors(facts),
        *check_battery(facts),
        *check_origin(facts),
        *check_lidar(facts),
        *check_computer(facts),
        *check_fusion(facts),
    ]


def is_green(checks: list[Check]) -> bool:
    return not any(check.verdict is Verdict.FAIL for check in checks)


def check_firmware(facts: Facts) -> list[Check]:
    manifest = MANIFESTS.get(facts.autopilot or "")
    if manifest is None:
        return [
            Check(
                name="firmware.autopilot",
                verdict=Verdict.FAIL,
                actual=facts.autopilot or "unknown",
                expected="px4 or ardupilot",
                mend="Only PX4 and ArduCopter are understood",
            )
        ]
    found = Check(name="firmware.autopilot", verdict=Verdict.OK, actual=manifest.firmware)
    return [found, _version(facts, manifest)]


def _version(facts: Facts, manifest: Manifest) -> Check:
    known = ", ".join(manifest.known_versions)
    if facts.version is None:
        return Check(name="firmware.version", verdict=Verdict.WARN, actual="not told", expected=known)
    begins = tuple(f"{v}." for v in manifest.known_versions)
    if facts.version in manifest.known_versions or facts.version.startswith(begins):
        return Check(name="firmware.version", verdict=Verdict.OK, actual=facts.version, expected=known)
    return Check(
        name="firmware.version",
        verdict=Verdict.WARN,
        actual=facts.version,
        expected=known,
        why="parameters and failsafes are known for these versions only",
        mend="Fly a test in the open first, or use a known version",
    )


def check_parameters(facts: Facts) -> list[Check]:
    """Each parameter of the manifest. A name the firmware does not have is told, not failed: versions differ."""
    manifest = MANIFESTS.get(facts.autopilot or "")
    if manifest is None:
        return []
    known = {name: value for name, value in facts.parameters.items() if value is not None}
    checks: list[Check] = []
    for expected in manifest.parameters:
        name = next((n for n in (expected.name, *expected.other_names) if n in known), expected.name)
        if not expected.applies(known) or name not in facts.parameters:
            continue
        label = f"parameter.{name}"
        value = facts.parameters[name]
        if value is None:
            checks.append(
                Check(name=label, verdict=Verdict.WARN, actual="not there", expected=expected.words, why=expected.why)
            )
            continue
        met = expected.is_met(value)
        verdict = Verdict.OK if met else Verdict.FAIL if expected.must else Verdict.WARN
        reboot = ", then restart the autopilot" if expected.needs_reboot else ""
        mend = "" if met else f"Set {name} to {number(expected.mended(value))}{reboot} (doctor --apply does it)"
        before = next((c for c in checks if c.name == label), None)
        if before is not None and (met or before.verdict is Verdict.FAIL):
            continue  # two demands on one parameter: the worse one is told
        if before is not None:
            checks.remove(before)
        checks.append(
            Check(
                name=label, verdict=verdict, actual=number(value), expected=expected.words, why=expected.why, mend=mend
            )
        )
    return checks


def check_time(facts: Facts) -> list[Check]:
    if facts.timesync_round_trip_s is None:
        return [
            Check(
                name="time.sync",
                verdict=Verdict.FAIL,
                actual="TIMESYNC is not answered",
                expected="round trip below 10 ms",
                why="without it stamps of vision and attitude cannot be brought together",
                mend="Use a link that carries both ways; on a serial port at least 460800 baud",
            )
        ]
    checks = []
    trip_ms = facts.timesync_round_trip_s * 1e3
    is_quick = trip_ms < 10
    checks.append(
        Check(
            name="time.sync",
            verdict=Verdict.OK if is_quick else Verdict.WARN,
            actual=f"round trip {trip_ms:.1f} ms",
            expected="below 10 ms",
            why="PX4 uses no exchange slower than that, and stamps vision by its arrival until 500 good ones",
            mend="" if is_quick else "A quicker link, or less on it; seen from here, the companion's own may be better",
        )
    )
    return checks


_RATES = {
    "px4": {"HEARTBEAT": 0.5, "ATTITUDE_QUATERNION": 5.0, "LOCAL_POSITION_NED": 0.5, "ESTIMATOR_STATUS": 0.4},
    "ardupilot": {"HEARTBEAT": 0.5, "ATTITUDE_QUATERNION": 5.0, "EKF_STATUS_REPORT": 0.4},
}


def check_streams(facts: Facts) -> list[Check]:
    checks = []
    for name, least_hz in _RATES.get(facts.autopilot or "", {}).items():
        rate = facts.rates_hz.get(name, 0.0)
        ok = rate >= least_hz
        checks.append(
            Check(
                name=f"stream.{name}",
                verdict=Verdict.OK if ok else Verdict.FAIL,
                actual=f"{rate:.1f} Hz",
                expected=f"at least {least_hz:g} Hz",
                mend="" if ok else "SET_MESSAGE_INTERVAL was refused, or the link is too slow for its streams",
            )
        )
    return checks


# MAV_SYS_STATUS_SENSOR
_SENSORS = {"gyroscope": 1, "accelerometer": 2, "barometer": 8}


def check_sensors(facts: Facts) -> list[Check]:
    """What the autopilot says of its own sensors; one that it does not list is not judged."""
    present, health = facts.sensors_present, facts.sensors_health
    if present is None or health is None:
        return [Check(name="sensors", verdict=Verdict.WARN, actual="SYS_STATUS has not come", mend="Wait, run again")]
    checks = []
    for name, bit in _SENSORS.items():
        if not present & bit:
            continue
        ok = bool(health & bit)
        checks.append(
            Check(
                name=f"sensor.{name}",
                verdict=Verdict.OK if ok else Verdict.FAIL,
                actual="healthy" if ok else "unhealthy",
                mend="" if ok else "Calibrate it, keep the vehicle still, see the autopilot's own messages",
            )
        )
    return checks


def check_battery(facts: Facts) -> list[Check]:
    if facts.battery_ratio is None:
        return []
    share = facts.battery_ratio
    verdict = Verdict.OK if share >= 0.5 else Verdict.WARN if share >= 0.25 else Verdict.FAIL
    return [
        Check(
            name="sensor.battery",
            verdict=verdict,
            actual=f"{share:.0%}",
            expected="at least 50 %, the way back and 30 % above it",
            mend="" if verdict is Verdict.OK else "Charge it",
        )
    ]


def check_origin(facts: Facts) -> list[Check]:
    if facts.has_origin is None:
        return []
    if not facts.has_origin:
        return [
            Check(
                name="origin",
                verdict=Verdict.WARN,
                actual="none yet",
                expected="set by the companion, before vision, at altitude 0",
                why="Hold and Return need a global position; ArduPilot's EKF needs it to arm",
                mend="The companion sets it when it starts; nothing to do",
            )
        ]
    altitude = facts.origin_altitude_m or 0.0
    if facts.autopilot == "px4" and abs(altitude) > 1.0:
        return [
            Check(
                name="origin",
                verdict=Verdict.FAIL,
                actual=f"altitude {altitude:.1f} m",
                expected="altitude 0",
                why="with vision as height reference PX4 takes the vision's height for altitude: local height jumps by it",
                mend="Restart the autopilot and let the companion set the origin",
            )
        ]
    return [Check(name="origin", verdict=Verdict.OK, actual="set")]


def check_lidar(facts: Facts) -> list[Check]:
    if facts.lidar_packets_hz is None:
        return [
            Check(name="lidar", verdict=Verdict.SKIPPED, actual="not listened for (its port is in use, or none given)")
        ]
    if facts.lidar_packets_hz < 1.0:
        return [
            Check(
                name="lidar",
                verdict=Verdict.FAIL,
                actual="no packets",
                expected="packets on its UDP port",
                mend="Power, cable, the sensor's destination address and port, firewall",
            )
        ]
    if len(facts.lidar_sources) > 1:
        return [
            Check(
                name="lidar",
                verdict=Verdict.WARN,
                actual=f"packets from {', '.join(facts.lidar_sources)}",
                expected="one sensor",
                mend="Another sensor sends to this port: give it another",
            )
        ]
    return [Check(name="lidar", verdict=Verdict.OK, actual=f"{facts.lidar_packets_hz:.0f} packets/s")]


def check_computer(facts: Facts) -> list[Check]:
    checks = []
    if facts.clock_drift_s is not None:
        steps = abs(facts.clock_drift_s) > 0.1
        checks.append(
            Check(
                name="computer.clock",
                verdict=Verdict.WARN if steps or (facts.clock_year or 9999) < 2024 else Verdict.OK,
                actual=f"year {facts.clock_year}, stepped {facts.clock_drift_s * 1e3:.0f} ms while looking",
                expected="right and steady",
                why="it only labels the recordings: control never uses it",
                mend="Let the clock be set before the flight" if steps else "",
            )
        )
    if facts.disk_free_gib is not None:
        ok = facts.disk_free_gib > facts.disk_reserve_gib
        checks.append(
            Check(
                name="computer.disk",
                verdict=Verdict.OK if ok else Verdict.FAIL,
                actual=f"{facts.disk_free_gib:.1f} GiB free",
                expected=f"more than {facts.disk_reserve_gib:g} GiB",
                mend="" if ok else "Move old runs away: the recording would stop at once",
            )
        )
    return checks


def number(value: float) -> str:
    """Short, but whole numbers in full: 5000000, not 5e+06."""
    return f"{int(value)}" if value == int(value) else f"{value:g}"
