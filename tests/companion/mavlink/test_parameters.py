"""FAULTS 26: the autopilot's parameters are read and compared with the manifest before arming."""

from __future__ import annotations

import json

import pytest

from companion.mavlink.checks import Facts, Verdict, check_parameters
from companion.mavlink.manifest import ARDUPILOT_MANIFEST, MANIFESTS, PX4_MANIFEST
from companion.messages import RequestKind
from tests.companion.mavlink.peer import Peer
from tests.shared_data import shared_data

NEVER_ARM = [
    (12, "EKF2_EV_CTRL", 0),
    (12, "EKF2_EV_CTRL", 6),
    (12, "EKF2_HGT_REF", 1),
    (12, "EKF2_GPS_CTRL", 7),
    (12, "COM_OBL_RC_ACT", 3),
    (12, "COM_OBL_RC_ACT", 0),
    (12, "NAV_DLL_ACT", 2),
    (12, "COM_ARM_WO_GPS", 0),
    (12, "COM_OF_LOSS_T", 30.5),
    (3, "VISO_TYPE", 0),
    (3, "EK3_SRC1_POSXY", 3),
    (3, "EK3_SRC1_YAW", 1),
    (3, "FS_GCS_ENABLE", 1),
    (3, "FS_EKF_ACTION", 2),
]


@pytest.mark.parametrize("autopilot", [12, 3])
def test_good_parameters_do_not_stand_against_arming(autopilot: int) -> None:
    peer = Peer(autopilot)
    peer.make_ready()
    state = peer.session.vehicle_state(peer.t_ns)
    assert state.is_ready_to_arm, state.not_ready_because


@pytest.mark.parametrize(("autopilot", "name", "value"), NEVER_ARM)
def test_a_wrong_parameter_refuses_arming_and_teaches(autopilot: int, name: str, value: float) -> None:
    """Each line: expected, actual, why, how to mend. AUTOPILOTS.md: "EKF2_EV_CTRL (0 = vision off, the default: bits
    hpos 1, vpos 2, vel 4, yaw 8), EKF2_HGT_REF, EKF2_GPS_CTRL 0, EKF2_EV_DELAY". PX4.md: "15 with ODOMETRY; 11 with
    VISION_POSITION_ESTIMATE"."""
    peer = Peer(autopilot)
    peer.parameters[name] = value
    peer.run(6.0)
    reasons = [r for r in peer.session.vehicle_state(peer.t_ns).not_ready_because if r.startswith("parameter")]
    assert len(reasons) == 1
    assert reasons[0].startswith(f"parameter.{name}: is {value:g}, expected ")
    assert f"Set {name} to " in reasons[0]
    peer.request(RequestKind.ARM)
    assert not [c for c in peer.take() if c.get_type() == "COMMAND_LONG" and c.command == 400]


def test_a_parameter_mended_meanwhile_opens_the_gate() -> None:
    peer = Peer()
    peer.parameters["EKF2_EV_CTRL"] = 0
    peer.make_ready()
    assert not peer.session.vehicle_state(peer.t_ns).is_ready_to_arm
    peer.parameters["EKF2_EV_CTRL"] = 15
    peer.say_parameter("EKF2_EV_CTRL")
    assert peer.session.vehicle_state(peer.t_ns).is_ready_to_arm


def test_an_autopilot_that_answers_no_parameter_is_not_armed() -> None:
    peer = Peer()
    peer.answers_parameters = False
    peer.run(20.0)
    reasons = peer.session.vehicle_state(peer.t_ns).not_ready_because
    assert any("answers no request" in r for r in reasons)


def test_an_older_name_of_a_parameter_serves() -> None:
    peer = Peer(3)
    del peer.parameters["GPS1_TYPE"]
    peer.parameters["GPS_TYPE"] = 1
    peer.run(12.0)
    reasons = [r for r in peer.session.vehicle_state(peer.t_ns).not_ready_because if r.startswith("parameter")]
    assert [r.split(":")[0] for r in reasons] == ["parameter.GPS_TYPE"]


def test_return_on_a_lost_transmitter_matters_only_where_there_is_one() -> None:
    """PX4.md 3: NAV_RCL_ACT also decides the fallback when COM_OBL_RC_ACT asks for a manual mode."""
    for sticks, lost, verdict in ((4, 4, Verdict.WARN), (3, 4, Verdict.FAIL), (4, 0, Verdict.FAIL)):
        values = {"NAV_RCL_ACT": 2.0, "COM_RC_IN_MODE": float(sticks), "COM_OBL_RC_ACT": float(lost)}
        found = {c.name: c.verdict for c in check_parameters(Facts(autopilot="px4", parameters=values))}
        assert found["parameter.NAV_RCL_ACT"] is verdict


@pytest.mark.parametrize("manifest", [PX4_MANIFEST, ARDUPILOT_MANIFEST], ids=lambda m: m.firmware)
def test_what_apply_sets_satisfies_the_manifest(manifest: object) -> None:
    assert manifest in (PX4_MANIFEST, ARDUPILOT_MANIFEST)
    for expected in (PX4_MANIFEST if manifest is PX4_MANIFEST else ARDUPILOT_MANIFEST).parameters:
        assert expected.is_met(expected.mended(None)), expected.name
        assert expected.is_met(expected.mended(64.0)), expected.name
        assert expected.why
        assert not expected.is_met(float("nan"))


def recorded(autopilot: str) -> dict[str, float | None]:
    entries = json.loads(shared_data("autopilots", autopilot, "params.json").read_text())
    entries = entries["params"] if isinstance(entries, dict) else entries
    return {entry["name"]: float(entry["value"]) for entry in entries}


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_every_name_is_one_that_the_real_firmware_has(autopilot: str) -> None:
    names = recorded(autopilot)
    for expected in MANIFESTS[autopilot].parameters:
        assert expected.name in names or set(expected.other_names) & set(names), expected.name


def test_px4_as_it_comes_out_of_the_box_is_red_where_it_must_be() -> None:
    """AUTOPILOTS.md: EKF2_EV_CTRL 0 = vision off, the default; defaults wrong for a hall."""
    checks = {c.name: c for c in check_parameters(Facts(autopilot="px4", parameters=recorded("px4")))}
    red = {name for name, check in checks.items() if check.verdict is Verdict.FAIL}
    assert {"parameter.EKF2_EV_CTRL", "parameter.COM_OBL_RC_ACT", "parameter.NAV_RCL_ACT"} <= red
    assert {"parameter.EKF2_HGT_REF", "parameter.EKF2_GPS_CTRL"} <= red
    assert checks["parameter.RTL_RETURN_ALT"].verdict is Verdict.WARN
    assert checks["parameter.GF_MAX_HOR_DIST"].verdict is Verdict.WARN


def test_ardupilot_as_it_flew_without_gps_is_green() -> None:
    """ARDUPILOT.md: parameters it flew with."""
    checks = check_parameters(Facts(autopilot="ardupilot", parameters=recorded("ardupilot")))
    assert len(checks) > 12
    assert [c.name for c in checks if c.verdict is Verdict.FAIL] == []


@pytest.mark.parametrize(
    ("name", "right", "wrong", "verdict"),
    [
        ("FS_GCS_ENABLE", 5, 0, Verdict.WARN),
        ("FS_GCS_ENABLE", 5, 2, Verdict.FAIL),
        ("MAV_GCS_SYSID", 1, 255, Verdict.WARN),
        ("SYSID_MYGCS", 1, 255, Verdict.WARN),
        ("FS_GCS_TIMEOUT", 2, 5, Verdict.WARN),
        ("GUID_TIMEOUT", 1, 3, Verdict.WARN),
    ],
)
def test_an_arducopter_that_would_not_miss_the_companion_is_told(
    name: str, right: float, wrong: float, verdict: Verdict
) -> None:
    """As it comes out of the box it flies on for 3 s and then drifts, blind from 7 s on, until it lands."""
    (good,) = check_parameters(Facts(autopilot="ardupilot", parameters={name: right}))
    (bad,) = check_parameters(Facts(autopilot="ardupilot", parameters={name: wrong}))
    assert (good.verdict, bad.verdict) == (Verdict.OK, verdict)
    assert bad.why
    assert bad.mend
