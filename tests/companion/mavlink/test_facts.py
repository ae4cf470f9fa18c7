"""What AUTOPILOTS.md and PX4.md ask of our side, where no other test does (docs/facts.md has all of them)."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from pydantic import ValidationError
from pymavlink.dialects.v20 import ardupilotmega as m

import companion
from companion.config import MavlinkConfig
from companion.mavlink import wire
from companion.mavlink.checks import Facts, Verdict, check_parameters
from companion.mavlink.codec import encode
from companion.mavlink.manifest import MANIFESTS
from companion.mavlink.px4 import PX4
from companion.mavlink.vision import Vision
from companion.messages import RequestKind
from simbridge.loop import BOOT_NS
from tests.companion.mavlink import peer as p
from tests.companion.mavlink.peer import MS, SECOND, Peer

ARDUPILOT, PX4_ID = 3, 12


# ---- vision ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("autopilot", [PX4_ID, ARDUPILOT])
def test_vision_leaves_as_odometry_and_nothing_else(autopilot: int) -> None:
    """AUTOPILOTS.md: "ODOMETRY (also carries velocity)"; "ATT_POS_MOCAP and mocap frames never reach EKF2"."""
    peer = Peer(autopilot)
    peer.make_ready()
    peer.run(2.0, vision=True, setpoints=True)
    vision = [
        sent
        for sent in peer.sent
        if any(word in sent.get_type() for word in ("VISION", "MOCAP", "VICON", "ODOMETRY", "GPS_INPUT"))
    ]
    assert {sent.get_type() for sent in vision} == {"ODOMETRY"}
    assert {sent.frame_id for sent in vision}.isdisjoint({14, 15, 16})  # MAV_FRAME_MOCAP_NED and its like


def test_the_estimate_leaves_at_30_to_50_hz() -> None:
    """AUTOPILOTS.md: "docs ask 30 to 50 Hz"; a pause of 200 ms keeps PX4's fusion from starting."""
    assert 30.0 <= MavlinkConfig().odometry_rate_hz <= 50.0
    for rate_hz in (4.0, 51.0):
        with pytest.raises(ValidationError):
            MavlinkConfig(odometry_rate_hz=rate_hz)
    vision, period_ns = Vision(), round(1e9 / MavlinkConfig().odometry_rate_hz)
    left = [vision.payload(p.estimate(n * period_ns), PX4, origin_confirmed=True) for n in range(1, 50)]
    assert None not in left, "at its own rate none is held back as too soon"


@pytest.mark.parametrize(("given", "sent"), [(1, 1), (90, 90), (100, 100), (250, 100), (0, 0)])
def test_quality_is_minus_1_to_100_and_reaches_any_minimum_that_the_manifest_allows(given: int, sent: int) -> None:
    """AUTOPILOTS.md: "-1 failed, 0 unknown, 1..100; must reach `EKF2_EV_QMIN` (0 = off)". PX4.md 3: "if >0,
    ODOMETRY.quality must reach it": a minimum above 50 is told before arming."""
    peer = Peer()
    peer.run(3.0)
    assert peer.session.send_odometry(p.estimate(peer.t_ns, quality=given))
    (message,) = peer.take()
    assert message.quality == sent
    for value, verdict in ((0.0, Verdict.OK), (50.0, Verdict.OK), (51.0, Verdict.WARN)):
        (check,) = check_parameters(Facts(autopilot="px4", parameters={"EKF2_EV_QMIN": value}))
        assert check.verdict is verdict


def test_odometry_hears_nothing_of_the_autopilots_own_position() -> None:
    """AUTOPILOTS.md: seeding registration with the flight controller's own fused position is a loop that hides drift:
    "only gyro and attitude may be used as a prior"."""
    root = Path(companion.__file__).parent
    flight = ast.parse((root / "flight.py").read_text(encoding="utf-8"))
    told = {
        node.func.attr
        for node in ast.walk(flight)
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Attribute)
        and ast.unparse(node.func.value) == "self.odometry"
    }
    assert told == {"on_attitude", "on_rangefinder", "begin", "publish", "predict"}
    files = sorted((root / "odometry").rglob("*.py"))
    assert len(files) > 5
    for path in files:
        names = {node.id for node in ast.walk(ast.parse(path.read_text("utf-8"))) if isinstance(node, ast.Name)}
        assert "VehicleState" not in names, path.name
    assert "AttitudeSample" in (root / "odometry" / "odometry.py").read_text("utf-8")


# ---- origin, setpoints, streams -------------------------------------------------------------------------------------


@pytest.mark.parametrize(("autopilot", "is_refused"), [(PX4_ID, True), (ARDUPILOT, False)])
def test_an_origin_with_an_altitude_refuses_arming_on_px4(autopilot: int, is_refused: bool) -> None:
    """PX4.md 7: "an origin at 489 m made local z jump to 489 m when vision began, still valid": the doctor calls it red,
    and red means no arming."""
    peer = Peer(autopilot)
    peer.run(0.9)
    peer.say(p.heartbeat(autopilot))
    peer.say(m.MAVLink_gps_global_origin_message(474000000, 85000000, 489399, 0))
    peer.make_ready()
    reasons = peer.session.vehicle_state(peer.t_ns).not_ready_because
    assert [r for r in reasons if r.startswith("origin: altitude 489.4 m")] == list(reasons)
    assert bool(reasons) is is_refused
    peer.request(RequestKind.ARM)
    assert bool([c for c in peer.take() if c.get_type() == "COMMAND_LONG" and c.command == 400]) is not is_refused


@pytest.mark.parametrize(
    ("health", "percent", "named"), [(0x3F, 90, ""), (0x3E, 90, "sensor.gyroscope"), (0x3F, 10, "sensor.battery")]
)
def test_what_the_doctor_calls_red_in_sensors_and_battery_refuses_arming(health: int, percent: int, named: str) -> None:
    """Issue 4: the same checks are the gate before arming: red means no arming."""
    peer = Peer()
    peer.make_ready()
    peer.say(m.MAVLink_sys_status_message(0x0F, 0x0F, health, 0, 0, 0, percent, 0, 0, 0, 0, 0, 0))
    peer.run(0.1, vision=True)
    reasons = peer.session.vehicle_state(peer.t_ns).not_ready_because
    assert [reason.split(":")[0] for reason in reasons] == ([named] if named else [])


def test_setpoints_leave_at_more_than_2_hz() -> None:
    """AUTOPILOTS.md: "a setpoint stream >= 2 Hz already running; valid local position (or velocity)". PX4.md 4:
    "anything with gaps under COM_OF_LOSS_T passes (2 Hz is only a documentation rule)": at the lowest rate that may be
    configured the shortest COM_OF_LOSS_T that the manifest allows holds more than one period."""
    assert MavlinkConfig().setpoint_rate_hz >= 10.0
    with pytest.raises(ValidationError):
        MavlinkConfig(setpoint_rate_hz=2.0)
    (loss,) = [e for e in MANIFESTS["px4"].parameters if e.name == "COM_OF_LOSS_T"]
    assert loss.low > 1.0 / MavlinkConfig(setpoint_rate_hz=4.0).setpoint_rate_hz


@pytest.mark.parametrize("autopilot", [PX4_ID, ARDUPILOT])
def test_the_mask_of_a_setpoint_uses_all_of_velocity_and_never_force(autopilot: int) -> None:
    """PX4.md 4: "Not all of pos/vel/acc may be masked; FORCE bit rejected; target_system 0 or own, target_component 0
    or 1"."""
    peer = Peer(autopilot)
    peer.run(1.1)
    assert peer.session.send_setpoint(p.setpoint(peer.t_ns, (0.4, 0.2, 0.1), 0.3))
    (sent,) = peer.take()
    ignored = {name: bool(sent.type_mask & value) for name, value in MASK.items()}
    assert [name for name, off in ignored.items() if not off] == ["vx", "vy", "vz", "force", "yaw_rate"]
    assert not sent.type_mask >> 12
    assert (sent.target_system, sent.target_component) == (1, 1)


MASK = {  # POSITION_TARGET_TYPEMASK: set means ignored, but for FORCE, which means that af is a force
    **{name: 1 << n for n, name in enumerate(("x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az"))},
    "force": 1 << 9,
    "yaw": 1 << 10,
    "yaw_rate": 1 << 11,
}


def test_what_px4_sends_once_a_second_is_asked_for_more_often() -> None:
    """PX4.md 6: "ESTIMATOR_STATUS and HEARTBEAT are 1 Hz on the link, so a MAVLink observer sees the mode change up to
    1 s late": CURRENT_MODE tells the mode sooner."""
    rates = dict(PX4.streams_hz)
    assert rates[230] >= 2.0
    assert rates[436] >= 2.0
    peer = Peer()
    peer.run(2.0)
    payload = wire.pack(wire.CURRENT_MODE, p.PX4_LAND, p.PX4_LAND, 7)  # no message of pymavlink 2.4.50
    peer.hear(encode(wire.CURRENT_MODE, payload, system=1, component=1, sequence=0))
    assert peer.session.vehicle_state(peer.t_ns).mode.value == "land", "before the next heartbeat"


def test_the_simulators_clock_starts_at_about_a_second() -> None:
    """PX4.md 2: HIL_SENSOR's time sets PX4's clock: "Start the stamp at a small value (about 1 s)": with epoch
    microseconds time_boot_ms wraps."""
    assert 500 * MS <= BOOT_NS <= 2 * SECOND


# ---- parameters -----------------------------------------------------------------------------------------------------

# (name, values that PX4.md calls right for a flight on vision, values that it calls wrong, the verdict on those)
SHEET: list[tuple[str, tuple[float, ...], tuple[float, ...], Verdict]] = [
    ("EKF2_EV_CTRL", (15,), (0, 1, 8), Verdict.FAIL),
    ("EKF2_EV_CTRL", (15,), (11, 9), Verdict.WARN),
    ("EKF2_EV_NOISE_MD", (0,), (1,), Verdict.WARN),
    ("EKF2_EV_DELAY", (0, 5), (200,), Verdict.WARN),
    ("EKF2_GPS_CTRL", (0,), (7, 1), Verdict.FAIL),
    ("EKF2_HGT_REF", (3, 0), (1, 2), Verdict.FAIL),
    ("EKF2_MAG_TYPE", (5,), (0, 1), Verdict.WARN),
    ("EKF2_SENS_EN", (8191, 8), (8183, 0), Verdict.FAIL),
    ("EKF2_NOAID_TOUT", (5_000_000,), (10_000_000,), Verdict.WARN),
    ("SYS_HAS_GPS", (0,), (1,), Verdict.WARN),
    ("COM_ARM_WO_GPS", (1, 2), (0,), Verdict.FAIL),
    ("NAV_DLL_ACT", (0, 1, 3), (2, 5), Verdict.FAIL),
    ("NAV_RCL_ACT", (1, 3), (2,), Verdict.FAIL),
    ("COM_OF_LOSS_T", (1.0,), (30.0,), Verdict.FAIL),
    ("COM_OBL_RC_ACT", (4, 5), (0, 1, 2, 3, 6, 7), Verdict.FAIL),
    ("COM_LOW_BAT_ACT", (3,), (0,), Verdict.WARN),
    ("RTL_RETURN_ALT", (5,), (60,), Verdict.WARN),
    ("GF_MAX_HOR_DIST", (100,), (0,), Verdict.WARN),
    ("GF_MAX_VER_DIST", (20,), (0,), Verdict.WARN),
    ("MAV_FWDEXTSP", (1,), (0,), Verdict.FAIL),
]


@pytest.mark.parametrize(("name", "right", "wrong", "verdict"), SHEET)
def test_parameters_of_the_sheet_are_judged_as_it_says(
    name: str, right: tuple[float, ...], wrong: tuple[float, ...], verdict: Verdict
) -> None:
    """PX4.md 3: each parameter's values, as the sheet explains them."""
    for value in right:
        (check,) = check_parameters(Facts(autopilot="px4", parameters={name: value}))
        assert check.verdict is Verdict.OK, value
    for value in wrong:
        (check,) = check_parameters(Facts(autopilot="px4", parameters={name: value}))
        assert check.verdict is verdict, value
        assert check.mend
        assert check.why


def test_every_parameter_of_px4s_manifest_is_judged_above() -> None:
    judged = {name for name, *_ in SHEET} | {"EKF2_EV_QMIN"}
    assert {expected.name for expected in MANIFESTS["px4"].parameters} == judged


def test_arducopters_sources_of_position_are_those_of_the_sheet() -> None:
    """AUTOPILOTS.md: "`VISO_TYPE` 1, `EK3_SRC1_POSXY` 6, `VELXY` 6 or 0, `POSZ` 1 (baro) or 6, `YAW` 6; `GPS1_TYPE` 0"."""
    allowed = {
        "VISO_TYPE": {1},
        "EK3_SRC1_POSXY": {6},
        "EK3_SRC1_VELXY": {6, 0},
        "EK3_SRC1_POSZ": {1, 6},
        "EK3_SRC1_YAW": {6},
        "GPS1_TYPE": {0},
    }
    for name, values in allowed.items():
        verdicts = {
            value: check_parameters(Facts(autopilot="ardupilot", parameters={name: float(value)}))[0].verdict
            for value in range(8)
        }
        assert {value for value, verdict in verdicts.items() if verdict is Verdict.OK} == values, name
        assert set(verdicts.values()) == {Verdict.OK, Verdict.FAIL}
