from __future__ import annotations

import json

import pytest

from companion.config import MavlinkConfig
from companion.mavlink.manifest import MANIFESTS
from simbridge.config import VehicleConfig
from simbridge.sitl import parameters
from tests.shared_data import shared_data

# Of another version than the recorded one, or shown only when its parent is on.
NOT_IN_THE_RECORDING = {"RNGFND1_ORIENT", "RNGFND1_MIN", "RNGFND1_MAX"}


def recorded(kind: str) -> dict[str, float]:
    rows = json.loads(shared_data("autopilots", kind, "params.json").read_text(encoding="utf-8"))
    rows = rows.get("params", rows.get("parameters", rows)) if isinstance(rows, dict) else rows
    if isinstance(rows, dict):
        return {name: row["value"] if isinstance(row, dict) else row for name, row in rows.items()}
    return {row["name"]: row["value"] for row in rows}


@pytest.mark.parametrize(("kind", "ours"), [("px4", parameters.PX4), ("ardupilot", parameters.ARDUPILOT)])
def test_every_name_is_one_that_the_real_autopilot_has(kind: str, ours: parameters.Parameters) -> None:
    assert set(ours) - set(recorded(kind)) - NOT_IN_THE_RECORDING == set()


def test_arducopter_gets_the_vision_parameters_it_was_recorded_with() -> None:
    real = recorded("ardupilot")
    assert {n: real[n] for n in parameters.ARDUPILOT_VISION} == pytest.approx(parameters.ARDUPILOT_VISION)


@pytest.mark.parametrize(("kind", "ours"), [("px4", parameters.PX4), ("ardupilot", parameters.ARDUPILOT)])
def test_the_doctor_has_nothing_against_them(kind: str, ours: parameters.Parameters) -> None:
    values = recorded(kind) | ours
    for expected in MANIFESTS[kind].parameters:
        name = next(n for n in (expected.name, *expected.other_names) if n in values)
        assert expected.is_met(values[name]) or not expected.applies(values), expected.why


def test_the_thrust_law_told_to_px4_is_the_vehicles() -> None:
    vehicle = VehicleConfig(start=(0.0, 0.0))
    assert parameters.PX4["THR_MDL_FAC"] == vehicle.thrust_curve
    assert {parameters.PX4[f"CA_ROTOR{i}_PX"] for i in range(4)} == {vehicle.arm_m, -vehicle.arm_m}


def test_rotors_are_front_right_rear_left_front_left_rear_right() -> None:
    """PX4.md: "none_iris motor geometry"."""
    places = [(parameters.PX4[f"CA_ROTOR{i}_PX"], parameters.PX4[f"CA_ROTOR{i}_PY"]) for i in range(4)]
    assert places == [(0.2, 0.2), (-0.2, -0.2), (0.2, -0.2), (-0.2, 0.2)]


def test_px4_never_climbs_home_under_a_roof() -> None:
    """Return (2 of NAV_RCL_ACT, 3 of COM_OBL_RC_ACT) climbs to 60 m. AUTOPILOTS.md: "a fallback can choose it once an
    origin is set: a climb under a roof"."""
    assert parameters.PX4["COM_OBL_RC_ACT"] == 4
    assert parameters.PX4["NAV_RCL_ACT"] == 3


def test_arducopter_lands_when_the_companion_falls_silent() -> None:
    """It watches the heartbeat of one system: the vehicle's own is the companion's."""
    ours = parameters.ARDUPILOT
    assert (ours["FS_GCS_ENABLE"], ours["MAV_GCS_SYSID"]) == (5, MavlinkConfig().system_id)
    assert 2 <= ours["FS_GCS_TIMEOUT"] <= 3  # the heartbeat comes once a second
