"""Makes the small recordings of missions/replays: flies emulated missions and cuts windows out of them.

Run as python -m stockpilot.replay_record [NAME ...] (minutes each). A cut keeps what the flight controller said from the
start as far as the link needs it (heartbeats, time sync, versions), all of it within the window, and the LiDAR's packets
of the window only: so odometry begins where the window begins, and a cut stays under 1 MB. Truth goes into truth.csv,
for scoring alone.
"""

from __future__ import annotations

import argparse
import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from companion.geometry import yaw_from_quat
from companion.recording.packed import pack
from companion.recording.run_files import PACKED_NAME, Input, RunRecording, read_run
from simbridge.loop import Truth
from stockpilot.lockstep import COMPANION_CLOCK_AHEAD_NS, Lockstep
from stockpilot.mission import load_mission
from stockpilot.recorded import LockstepRecorder
from stockpilot.replay_check import REPLAYS, ROOT, TRUTH_NAME
from stockpilot.replay_edit import message_ids
from stockpilot.run import prepare

MAX_BYTES = 1_000_000
LEAD_NS = 1_000_000_000  # attitude of this long before the first packet
LINK_MESSAGES = {
    0,
    22,
    49,
    77,
    111,
    148,
    242,
    245,
}  # heartbeat, parameters, origin, acks, timesync, version, home, landed
TRUTH_STEPS = 5
TRUTH_PERIOD_NS = 100_000_000


@dataclass(frozen=True, slots=True)
class Scenario:
    """mission: below missions/. window_s: from boot."""

    mission: str
    window_s: tuple[float, float]
    settings: tuple[str, ...] = ()
    seed: int = 0


SCENARIOS = {
    "straight_wall": Scenario("cement_store.yaml", (110.0, 124.0)),
    "corner": Scenario("cement_store.yaml", (186.0, 200.0)),
    "turn_on_the_spot": Scenario("cement_store.yaml", (76.5, 88.5)),
    "dust": Scenario("cement_store.yaml", (110.0, 122.0), ("lidar.dust.visibility_m=15",)),
    "long_corridor": Scenario(
        "cement_store.yaml",
        (84.0, 98.0),
        (
            "world.footprint=[[0,0],[80,0],[80,14],[0,14]]",
            "world.piles=[]",
            "vehicle.start=[50, 7, 180]",
            "navigator.height_m=5",
        ),
    ),
}


def fly(scenario: Scenario, folder: Path) -> list[Truth]:
    """Fly until the window has passed, recorded into folder; truth every 20 ms."""
    mission = load_mission(ROOT / "missions" / scenario.mission, scenario.settings, seed=scenario.seed)
    prepared = prepare(mission)
    runner = Lockstep(
        simulation=prepared.simulation, wire=prepared.wire, flight=prepared.flight, keep_scans=False
    )  # fmt: skip
    truth: list[Truth] = []
    with prepared.closing, LockstepRecorder(folder, mission, "emulated") as recorder:
        recorder.attach(runner)
        began_ns = runner.t_ns
        n = 0
        while runner.t_ns - began_ns <= scenario.window_s[1] * 1e9:
            runner.step()
            n += 1
            if n % TRUTH_STEPS == 0:
                truth.append(prepared.simulation.truth())
    return truth


def cut(recording: RunRecording, window_s: tuple[float, float]) -> list[Input]:
    """The inputs of a window, with what the link needs from before."""
    began_ns = recording.inputs[0].t_ns
    since_ns, until_ns = (began_ns + round(s * 1e9) for s in window_s)
    kept = []
    for item in recording.inputs:
        if item.t_ns >= until_ns:
            break
        if item.kind in ("begin", "accept"):
            continue
        is_link = item.kind == "mavlink" and not LINK_MESSAGES.isdisjoint(message_ids(item.data))
        lead_ns = 0 if item.kind == "lidar" else LEAD_NS
        if item.t_ns >= since_ns - lead_ns or is_link or item.kind == "poll":
            kept.append(item)
    return kept


def truth_lines(truth: Sequence[Truth], start_ns: int, until_ns: int) -> str:
    """CSV: seconds from start_ns, place and heading in the world, every TRUTH_PERIOD_NS."""
    times = [t.t_ns for t in truth]
    places = np.array([t.position_world_m for t in truth])
    yaws = np.unwrap([yaw_from_quat(t.q_world_body_wxyz) for t in truth])
    lines = ["t_s,x_m,y_m,z_m,yaw_deg"]
    for t_ns in range(start_ns, until_ns + TRUTH_PERIOD_NS, TRUTH_PERIOD_NS):
        x, y, z = (float(np.interp(t_ns, times, places[:, k])) for k in range(3))
        yaw_deg = math.degrees(float(np.interp(t_ns, times, yaws)))
        lines.append(f"{(t_ns - start_ns) * 1e-9:.1f},{x:.4f},{y:.4f},{z:.4f},{yaw_deg:.3f}")
    return "\n".join(lines) + "\n"


def write(name: str, recording: RunRecording, truth: Sequence[Truth], clock_ahead_ns: int) -> str:
    """Cut one recording out of a flight and write its folder; returns a line about it.

    clock_ahead_ns: companion time minus simulated time.
    """
    inputs = cut(recording, SCENARIOS[name].window_s)
    attachments = {k: recording.attachments[k] for k in ("companion.json", "lidar.json")}
    data = pack(inputs, {"run": recording.metadata["run"]}, attachments)
    if len(data) > MAX_BYTES:
        raise ValueError(f"{name}: {len(data)} bytes, at most {MAX_BYTES}: shorten its window")
    folder = REPLAYS / name
    folder.mkdir(parents=True, exist_ok=True)
    (folder / PACKED_NAME).write_bytes(data)
    lidar_ns = [i.t_ns - clock_ahead_ns for i in inputs if i.kind == "lidar"]
    (folder / TRUTH_NAME).write_text(truth_lines(truth, lidar_ns[0], lidar_ns[-1]), encoding="utf-8")
    return f"{name}: {len(data)} bytes, {len(lidar_ns)} LiDAR packets"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m stockpilot.replay_record", description=__doc__)
    parser.add_argument("names", nargs="*", help=f"of {', '.join(SCENARIOS)}; default: all")
    names = parser.parse_args().names or list(SCENARIOS)
    flights: dict[tuple[str, tuple[str, ...], int], list[str]] = {}
    for name in names:
        scenario = SCENARIOS[name]
        flights.setdefault((scenario.mission, scenario.settings, scenario.seed), []).append(name)
    for together in flights.values():
        longest = max((SCENARIOS[name] for name in together), key=lambda s: s.window_s[1])
        with tempfile.TemporaryDirectory() as temporary:
            truth = fly(longest, Path(temporary))
            recording = read_run(Path(temporary))
        for name in together:
            print(write(name, recording, truth, COMPANION_CLOCK_AHEAD_NS), flush=True)


if __name__ == "__main__":
    main()
