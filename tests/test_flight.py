"""The main job, whole: both sides in lockstep, only bytes between them."""

from __future__ import annotations

import json
from contextlib import closing
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from pymavlink import mavutil

from companion.messages import RequestKind
from simbridge.streams import stream
from stockpilot.leave import write_results
from stockpilot.lockstep import Lockstep
from stockpilot.mission import Mission
from stockpilot.recorded import LockstepRecorder
from stockpilot.run import Flown, fly_lockstep, prepare
from tests.flights import small_mission

REPORT_KEYS = {
    "mission", "seed", "autopilot", "state", "forward_speed_mps", "scan_period_s", "flight_time_s", "wall_time_s",
    "real_time_factor", "peak_rss_mb", "scans", "keyframes", "lap_closed", "collision", "min_clearance_m",
    "wall_distance_rms_m", "volume_m3", "volume_interval_m3", "seen_ratio", "interpolated_ratio", "unseen_ratio",
    "odometry_max_gap_s", "truth_volume_m3", "e_v_percent", "e_p_m", "e_yaw_deg", "paper",
}  # fmt: skip

pytestmark = pytest.mark.xdist_group("flight")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("flown")


@pytest.fixture(scope="module")
def flown(folder: Path) -> Flown:
    mission = small_mission()
    with LockstepRecorder(folder, mission, "emulated") as recorder:
        return fly_lockstep(mission, with_perfect_poses=True, attach=recorder.attach)


@pytest.mark.timeout(300)
def test_mission_ends_at_its_start_with_the_lap_closed_and_nothing_touched(flown: Flown) -> None:
    report = flown.scored.report
    assert report["state"] == "completed", report["reason"]
    assert report["lap_closed"]
    assert not report["collision"]
    assert report["landed_from_start_m"] < 1.0
    assert report["min_clearance_m"] > 1.0


@pytest.mark.timeout(300)
def test_walls_are_followed_at_their_distance(flown: Flown) -> None:
    assert flown.scored.report["wall_distance_rms_m"] <= 0.4


@pytest.mark.timeout(300)
def test_position_and_volume_are_near_the_truth_and_the_interval_holds_it(flown: Flown) -> None:
    report = flown.scored.report
    assert report["e_p_m"] <= 0.05
    assert report["e_yaw_deg"] <= 0.3
    assert abs(report["e_v_percent"]) <= 3.0
    assert report["truth_in_interval"]
    assert report["seen_ratio"] + report["interpolated_ratio"] + report["unseen_ratio"] == pytest.approx(1.0)


@pytest.mark.timeout(300)
def test_a_sensor_that_reads_too_far_moves_the_volume_as_the_interval_says(flown: Flown) -> None:
    """The same flight with 30 mm more in all ranges: the odometry bends the map with it, and the volume follows that."""
    offset_m = 0.03
    drawn = float(stream(flown.mission.seed, "lidar offset").standard_normal())
    assert drawn < 0.0
    off = fly_lockstep(small_mission(lidar={"offset_sigma_m": -offset_m / drawn}))
    assert flown.mission.sim is not None
    own_m = flown.mission.sim.lidar.offset_sigma_m * drawn
    assert off.scored.volume is not None
    assert flown.scored.volume is not None
    moved_m3 = off.scored.volume.volume_m3 - flown.scored.volume.volume_m3
    sigma_m3 = dict(flown.scored.volume.error_budget_m3)["range"]
    told_m2 = sigma_m3 / flown.mission.companion.volume.range_offset_sigma_m
    assert abs(moved_m3) / (offset_m + own_m) == pytest.approx(told_m2, rel=0.35)


@pytest.mark.timeout(300)
def test_the_papers_pipeline_is_scored_beside_on_the_same_flight(flown: Flown) -> None:
    paper = flown.scored.report["paper"]
    assert paper["c_c"] > flown.scored.report["c_c"]
    assert paper["e_p_m"] > flown.scored.report["e_p_m"]
    assert np.isfinite(paper["volume_m3"])


@pytest.mark.timeout(300)
def test_odometry_leaves_without_a_gap_that_px4_would_notice(flown: Flown) -> None:
    """AUTOPILOTS.md: "starts only if two samples are < 200 ms apart and the newest is < 200 ms old"."""
    assert 0.0 < flown.scored.report["odometry_max_gap_s"] <= 0.2


@pytest.mark.timeout(300)
def test_results_are_written_whole(flown: Flown, tmp_path: Path) -> None:
    write_results(tmp_path, flown)
    report = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert set(report) >= REPORT_KEYS
    for name in ("map.ply", "map.laz", "trajectory.tum", "report.html", "trajectory.png", "map.png", "surface.png"):
        assert (tmp_path / name).stat().st_size > 1000, name
    tum = np.loadtxt(tmp_path / "trajectory.tum")
    assert tum.shape[1] == 8
    assert np.all(np.diff(tum[:, 0]) > 0)
    np.testing.assert_allclose(np.linalg.norm(tum[:, 4:], axis=1), 1.0, atol=1e-12)


@pytest.mark.timeout(300)
def test_qgroundcontrol_can_draw_track_height_and_speed_from_the_tlog(flown: Flown, folder: Path) -> None:
    """It takes the vehicle's kind from its first HEARTBEAT, its place from GLOBAL_POSITION_INT, its speed from VFR_HUD,
    and its height from ALTITUDE for good once it has seen one."""
    wanted = ["HEARTBEAT", "GLOBAL_POSITION_INT", "VFR_HUD", "ALTITUDE"]
    with closing(mavutil.mavlogfile(str(folder / "telemetry.tlog"))) as log:
        heard = list(iter(partial(log.recv_match, type=wanted), None))
    vehicle = [m for m in heard if m.get_srcComponent() == 1]
    assert next(m for m in vehicle if m.get_type() == "HEARTBEAT").autopilot == 12
    places = [m for m in vehicle if m.get_type() == "GLOBAL_POSITION_INT"]
    assert max(m.relative_alt for m in places) == pytest.approx(4500, abs=300)
    north_m = np.ptp([m.lat for m in places]) * 1e-7 * 111_320
    assert 7 < north_m < 17  # of a hall of 17 m by 22 m, flown round 5 m off its walls
    assert len(places) == pytest.approx(2.0 * flown.outcome.simulated_s, rel=0.2)
    heights = [m.altitude_relative for m in vehicle if m.get_type() == "ALTITUDE"]
    assert max(heights) == pytest.approx(4.5, abs=0.3)
    assert heights[-1] == pytest.approx(0.0, abs=0.3), "to the end, landed"
    assert max(m.groundspeed for m in vehicle if m.get_type() == "VFR_HUD") == pytest.approx(0.8, abs=0.3)


def crossed(mission: Mission, steps: int) -> str:
    """The hash of all bytes that crossed in the first steps."""
    prepared = prepare(mission)
    runner = Lockstep(simulation=prepared.simulation, wire=prepared.wire, flight=prepared.flight)
    for _ in range(steps):
        runner.step()
    return runner.crossed_sha256


@pytest.mark.timeout(300)
def test_one_seed_gives_the_same_bytes_and_another_gives_others() -> None:
    steps = 250 * 66  # past time sync, take-off and the climb
    first = crossed(small_mission(), steps)
    assert crossed(small_mission(), steps) == first
    assert crossed(small_mission(seed=4), 500) != crossed(small_mission(), 500)


@pytest.mark.timeout(300)
def test_abort_in_flight_lands_where_it_is() -> None:
    prepared = prepare(small_mission())
    runner = Lockstep(simulation=prepared.simulation, wire=prepared.wire, flight=prepared.flight, max_simulated_s=200)
    while prepared.simulation.truth().position_world_m[2] < 3.0:
        runner.step()
    began_ns = prepared.simulation.t_ns
    where = prepared.simulation.truth().position_world_m.copy()
    runner.abort("test")
    asked_ns = None
    requests: list[tuple[int, RequestKind]] = []
    prepared.flight.tap = lambda topic, t_ns, message: (
        requests.append((prepared.simulation.t_ns, message.kind)) if topic.name == "navigator/request" else None
    )
    outcome = runner.run()
    asked_ns = next(t for t, kind in requests if kind is RequestKind.LAND)
    assert (asked_ns - began_ns) * 1e-9 <= 1.0
    assert outcome.state == "aborted"
    assert not prepared.simulation.collision
    assert np.hypot(*(outcome.truth.position_world_m[-1] - where)[:2]) < 1.5
    assert outcome.truth.position_world_m[-1, 2] < 0.5
