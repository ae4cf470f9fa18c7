"""Our session listening to real autopilots: the recorded streams must bring it to the right states at the right
times. Times are seconds from the first record (PX4) or of boot (ArduPilot), as the recordings' own notes give them."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import pytest

from companion.config import MavlinkConfig
from companion.mavlink.session import MavlinkSession
from companion.messages import AttitudeSample, Event, FlightMode, LandedState, VehicleState
from tests.companion.mavlink.tlog import read_tlog
from tests.shared_data import shared_data

SECOND = 1_000_000_000
START_NS = 1_000 * SECOND
BOOT_OFFSET_US = {
    "ev_guided": 1795317317660194,
    "setpoint_loss": 1795316711717733,
    "vision_loss": 1795316773241071,
    "wrong_input": 1795316992590792,
    "handshake": 1795316845490802,
    "json_physics": 1795316992983035,
}


@dataclass
class Heard:
    session: MavlinkSession
    states: list[tuple[float, VehicleState]] = field(default_factory=list)
    events: list[tuple[float, Event]] = field(default_factory=list)
    attitudes: list[AttitudeSample] = field(default_factory=list)

    def modes(self) -> list[tuple[float, FlightMode]]:
        """Each change of mode with its time."""
        changes: list[tuple[float, FlightMode]] = []
        for t, state in self.states:
            if state.mode is not FlightMode.UNKNOWN and (not changes or changes[-1][1] is not state.mode):
                changes.append((t, state.mode))
        return changes

    def first(self, name: str, text: str = "") -> float:
        return next(t for t, event in self.events if event.name == name and text in event.text)

    def at(self, t: float) -> VehicleState:
        return [state for when, state in self.states if when <= t][-1]


def listen(autopilot: str, name: str) -> Heard:
    """Play what the autopilot said into a session, on a clock of ours that is far from its own."""
    records = read_tlog(shared_data("autopilots", autopilot, f"{name}.from_fc.tlog"))
    zero_us = records[0][0] if autopilot == "px4" else BOOT_OFFSET_US[name]
    heard = Heard(MavlinkSession(MavlinkConfig()))
    session = heard.session
    for t_us, frame in records:
        seconds = (t_us - zero_us) / 1e6
        t_ns = START_NS + (t_us - zero_us) * 1000
        while 0 < session.next_deadline_ns() <= t_ns:
            session.poll(session.next_deadline_ns())
        session.poll(t_ns)
        session.data_to_send()
        for message in session.receive(frame, t_ns):
            if isinstance(message, Event):
                heard.events.append((seconds, message))
            elif isinstance(message, VehicleState):
                heard.states.append((seconds, message))
            elif isinstance(message, AttitudeSample):
                heard.attitudes.append(message)
        heard.states.append((seconds, session.vehicle_state(t_ns)))
    assert not [key for key in session.counts if key.startswith("frame.")]
    return heard


ALL = [
    *(("px4", n) for n in ("ev_offboard", "setpoint_loss", "vision_loss", "wrong_input", "handshake")),
    ("px4", "origin_altitude"),
    *(("ardupilot", n) for n in BOOT_OFFSET_US),
]


@pytest.mark.parametrize(("autopilot", "name"), ALL)
def test_the_autopilot_is_told_by_its_heartbeat_and_no_restart_is_imagined(autopilot: str, name: str) -> None:
    heard = listen(autopilot, name)
    assert heard.session.autopilot == autopilot
    assert not [event for _, event in heard.events if event.name in ("autopilot_rebooted", "security")]
    assert not heard.session.vehicle_state(START_NS + 10_000 * SECOND).is_connected


@pytest.mark.parametrize(
    ("autopilot", "name", "armed_s"),
    [("px4", "ev_offboard", 55.0), ("px4", "vision_loss", 0.0), ("ardupilot", "ev_guided", 0.0)],
)
def test_sensors_and_battery_of_real_ones_that_flew_do_not_stand_against_arming(
    autopilot: str, name: str, armed_s: float
) -> None:
    """The doctor's checks, in front of arming: what really armed must pass those that look at the vehicle itself."""
    heard = listen(autopilot, name)
    armed = armed_s or heard.first("armed")
    before = [state for t, state in heard.states if armed - 2.0 < t < armed]
    assert before
    reasons = {reason.split(":")[0] for state in before for reason in state.not_ready_because}
    assert not {reason for reason in reasons if reason.startswith("sensor") or reason == "origin"}


def test_px4_ev_offboard_goes_hold_offboard_land_and_back_to_offboard_disarmed() -> None:
    """PX4.md 7: after landing and disarming the heartbeat goes back to OFFBOARD."""
    heard = listen("px4", "ev_offboard")
    expected = [
        (1.0, FlightMode.HOLD),
        (55.0, FlightMode.OFFBOARD),
        (104.0, FlightMode.LAND),
        (114.0, FlightMode.OFFBOARD),
    ]
    for (t, mode), (t_expected, mode_expected) in zip(heard.modes(), expected, strict=True):
        assert mode is mode_expected
        assert t == pytest.approx(t_expected, abs=0.1)
    assert heard.first("armed") == pytest.approx(55.0, abs=0.1)
    assert heard.first("disarmed") == pytest.approx(114.0, abs=0.1)
    assert heard.first("origin_confirmed") == pytest.approx(4.2, abs=0.1)
    assert heard.first("vision_fused") == pytest.approx(48.5, abs=0.1)
    assert heard.at(80.0).landed_state is LandedState.IN_AIR
    assert not heard.at(80.0).is_failsafe


def test_px4_position_between_origin_and_vision_is_told_invalid() -> None:
    """PX4.md 7: LOCAL_POSITION_NED streams millions of metres; only the flags say so."""
    heard = listen("px4", "ev_offboard")
    before, after = heard.at(40.0), heard.at(49.0)
    assert before.position_map_m is not None
    assert abs(before.position_map_m[0]) > 5e6
    assert not before.is_position_valid
    assert after.position_map_m is not None
    assert abs(after.position_map_m[0]) < 1.0
    assert after.is_position_valid


def test_px4_setpoint_loss_is_heard_as_failsafe_land() -> None:
    """AUTOPILOTS.md: "COM_OBL_RC_ACT (default 0 = Position; 4 = Land, 5 = Hold)". PX4.md: "Hold and Return need a
    global position. Without one, loss of setpoints ends in AUTO_LAND, loss of vision in DESCEND"."""
    heard = listen("px4", "setpoint_loss")
    assert heard.first("autopilot_failsafe", "offboard to land") == pytest.approx(80.0, abs=0.1)
    assert heard.first("autopilot_event", "Failsafe activated") == pytest.approx(79.53, abs=0.1)
    assert not heard.at(79.5).is_failsafe
    assert heard.at(79.6).is_failsafe, (
        "the event says so before the heartbeat, and before CURRENT_MODE where that comes"
    )
    assert heard.at(80.1).is_failsafe
    assert heard.at(82.0).mode is FlightMode.LAND
    assert not heard.at(90.9).is_failsafe
    assert "pilot_took_control" not in [event.name for _, event in heard.events]


def test_px4_vision_loss_is_heard_within_a_report_and_ends_in_descend() -> None:
    """PX4.md 6: 383 to 127 at once, 101 after 4.5 s, DESCEND which the heartbeat calls AUTO.LAND. AUTOPILOTS.md: "dead
    reckoning until EKF2_NOAID_TOUT 5 s, then local position invalid, then failsafe"."""
    heard = listen("px4", "vision_loss")
    assert heard.first("vision_not_fused") == pytest.approx(82.5, abs=0.1)
    assert heard.at(84.0).is_position_valid, "dead reckoning"
    assert not heard.at(86.6).is_position_valid
    assert heard.first("autopilot_failsafe") == pytest.approx(87.0, abs=0.1)
    assert heard.first("autopilot_failsafe", "to descend") == pytest.approx(87.5, abs=0.1), "the next landed state"
    assert heard.at(88.5).mode is FlightMode.DESCEND
    assert heard.first("autopilot_event", "descending blind") == pytest.approx(86.53, abs=0.05)


def test_px4_origin_with_altitude_is_warned_of() -> None:
    heard = listen("px4", "origin_altitude")
    assert heard.first("origin_altitude", "489.4 m") == pytest.approx(4.25, abs=0.1)


def test_px4_says_a_refused_estimator_type_in_text_and_event() -> None:
    """AUTOPILOTS.md: LIDAR refused with a critical text, which only a link with a ground station's heartbeat gets."""
    heard = listen("px4", "wrong_input")
    assert heard.first("autopilot_text", "estimator_type 7 unsupported") == pytest.approx(10.4, abs=0.2)
    assert heard.first("autopilot_event", "estimator type is not supported") == pytest.approx(10.4, abs=0.2)
    assert heard.first("autopilot_text", "coordinate frame 7 unsupported") == pytest.approx(49.0, abs=0.3)


def test_px4_gives_no_text_to_a_companion_alone() -> None:
    """PX4.md 7: STATUSTEXT goes only to a link with a ground station's heartbeat; a companion gets EVENT."""
    heard = listen("px4", "ev_offboard")
    names = [event.name for _, event in heard.events]
    assert "autopilot_text" not in names
    assert "autopilot_event" in names


def test_px4_timesync_questions_are_counted_to_500() -> None:
    """PX4's 500th exchange came at 50.0 s. PX4.md: "uses the timesync offset only after 500 good exchanges"."""
    heard = listen("px4", "ev_offboard")

    def waits(t: float) -> bool:
        return any("exchanges it wants" in r or "answered in time" in r for r in heard.at(t).not_ready_because)

    assert heard.session._hearing.timesync.answered > 1000
    assert waits(40.0)


def test_ardupilot_ev_guided_goes_through_guided_and_land() -> None:
    heard = listen("ardupilot", "ev_guided")
    modes = heard.modes()
    assert [mode for _, mode in modes] == [FlightMode.MANUAL, FlightMode.OFFBOARD, FlightMode.LAND]
    assert modes[1][0] == pytest.approx(27.0, abs=0.1)
    assert modes[2][0] == pytest.approx(52.46, abs=0.1)
    assert heard.first("origin_confirmed") == pytest.approx(4.45, abs=0.1)
    assert heard.first("vision_fused") == pytest.approx(19.18, abs=0.1)
    assert heard.first("armed") == pytest.approx(27.03, abs=0.1)
    assert heard.first("disarmed") == pytest.approx(61.03, abs=0.1)
    landed = [
        (3.0, LandedState.ON_GROUND),
        (31.0, LandedState.TAKEOFF),
        (40.0, LandedState.IN_AIR),
        (54.0, LandedState.LANDING),
    ]
    for t, state in landed:
        assert heard.at(t).landed_state is state


def test_ardupilot_attitudes_come_stamped_in_our_clock_in_order() -> None:
    heard = listen("ardupilot", "ev_guided")
    stamps = [sample.t_ns for sample in heard.attitudes]
    assert len(stamps) > 1800
    assert stamps == sorted(set(stamps))
    flying = [s for s in stamps if s > START_NS + 5 * SECOND]
    gaps = sorted(b - a for a, b in pairwise(flying))
    assert gaps[len(gaps) // 2] == pytest.approx(SECOND / 30, rel=0.15)
    assert flying[-1] == pytest.approx(START_NS + 63.0 * SECOND, abs=0.1 * SECOND)


def test_ardupilot_vision_loss_is_silent_for_7_s_then_failsafe_land() -> None:
    """ARDUPILOT.md: flags look healthy up to 7 s: the companion must watch the age of its own vision. AUTOPILOTS.md:
    "EKF failsafe after about 1 s over threshold: Land"."""
    heard = listen("ardupilot", "vision_loss")
    assert heard.first("vision_not_fused") == pytest.approx(43.57, abs=0.1)
    assert heard.at(43.0).is_position_valid
    assert heard.first("autopilot_failsafe", "offboard to land") == pytest.approx(44.45, abs=0.1)
    assert heard.first("autopilot_text", "EKF Failsafe") == pytest.approx(44.45, abs=0.1)
    assert not heard.at(45.0).is_position_valid


def test_ardupilot_arming_reasons_are_shown() -> None:
    """ARDUPILOT.md: arming is refused for the first 20 to 30 s: try again, with the text shown."""
    heard = listen("ardupilot", "handshake")
    assert heard.first("autopilot_text", "waiting for home") == pytest.approx(20.1, abs=0.3)
    assert heard.first("autopilot_text", "Gyros inconsistent") == pytest.approx(20.1, abs=0.3)


def test_ardupilot_flags_without_origin_are_not_taken_for_ready() -> None:
    """ARDUPILOT.md: the EKF flags read 0x33f without an origin: only GPS_GLOBAL_ORIGIN proves it."""
    heard = listen("ardupilot", "handshake")
    assert heard.first("vision_fused") < 30.0
    assert any(reason.startswith("origin:") for reason in heard.at(40.0).not_ready_because)
    assert not any(reason.startswith("origin:") for reason in heard.at(45.0).not_ready_because)


def test_ardupilot_leap_of_its_clock_is_no_restart() -> None:
    """json_physics: the autopilot's clock leaps 5 s forward: our stamps stay in order and never in the future."""
    heard = listen("ardupilot", "json_physics")
    stamps = [sample.t_ns for sample in heard.attitudes]
    assert stamps == sorted(set(stamps))
