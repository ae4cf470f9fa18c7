"""How steady are ODOMETRY and setpoints in real time, while mapping runs?

    python -m benchmarks.cadence [--seconds 40] [--json]

Starts `stockpilot sim` and `stockpilot fly` on this machine, lets the vehicle follow the wall of the cement store for some
seconds, lands it by SIGTERM, and prints the intervals as the companion measured them: median, 99th percentile, longest,
and the percentile's excess over the nominal interval. Both programs share the machine, as they would not on a vehicle.
"""

from __future__ import annotations

import argparse
import json
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from companion.config import MavlinkConfig

MISSION = Path(__file__).resolve().parents[1] / "missions" / "cement_store.yaml"
UNTIL_FOLLOW_S = 240.0


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def fly(seconds: float) -> dict[str, dict[str, float]]:
    """The companion's own measurement. Raises: RuntimeError: it never followed a wall."""
    mavlink, lidar, ground = free_port(), free_port(), free_port()
    program = [sys.executable, "-m", "stockpilot.cli"]
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "fly.log"
        world = subprocess.Popen(
            [*program, "sim", str(MISSION), "--offboard", f"udpout://127.0.0.1:{mavlink}",
             "--ground", f"udpout://127.0.0.1:{ground}", "--lidar", f"udp://127.0.0.1:{lidar}"],
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            with log.open("w") as errors:
                companion = subprocess.Popen(
                    [*program, "fly", str(MISSION), "--connect", f"udpin://127.0.0.1:{mavlink}",
                     "--lidar", f"udp://127.0.0.1:{lidar}", "--out", folder, "--json"],
                    stdout=subprocess.DEVNULL, stderr=errors,
                )  # fmt: skip
                deadline = time.monotonic() + UNTIL_FOLLOW_S
                while "at the wall" not in log.read_text() and time.monotonic() < deadline:
                    if companion.poll() is not None:
                        break
                    time.sleep(0.5)
                else:
                    time.sleep(seconds)
                companion.send_signal(signal.SIGTERM)
                companion.wait(180)
        finally:
            world.terminate()
            world.wait(60)
        report = Path(folder) / "report.json"
        if not report.exists():
            raise RuntimeError(f"the companion left no report; it said:\n{log.read_text()[-2000:]}")
        cadence: dict[str, dict[str, float]] = json.loads(report.read_text())["cadence"]
        return cadence


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=40.0, help="of following the wall")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    cadence = fly(arguments.seconds)
    config = MavlinkConfig()
    nominal = {"odometry": 1 / config.odometry_rate_hz, "setpoint": 1 / config.setpoint_rate_hz}
    for name, figures in cadence.items():
        figures["nominal_s"] = nominal[name]
        figures["p99_over_nominal_percent"] = 100 * (figures["p99_s"] / nominal[name] - 1)
    if arguments.json:
        print(json.dumps(cadence, indent=2))
        return
    print(
        "| stream | nominal, ms | median, ms | p99, ms | p99 over nominal, % | longest, ms |\n|---|---|---|---|---|---|"
    )
    for name, f in cadence.items():
        print(
            f"| {name} | {1e3 * f['nominal_s']:.1f} | {1e3 * f['median_s']:.1f} | {1e3 * f['p99_s']:.1f} | "
            f"{f['p99_over_nominal_percent']:.0f} | {1e3 * f['max_s']:.0f} |"
        )


if __name__ == "__main__":
    main()
