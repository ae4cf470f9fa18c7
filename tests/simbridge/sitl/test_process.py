from __future__ import annotations

import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from simbridge.sitl import SitlError
from simbridge.sitl.process import AutopilotProcess, start_arducopter, start_px4


def script(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("#!/bin/sh\n" + text, encoding="ascii")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return path


def px4_build(tmp_path: Path, text: str) -> Path:
    (tmp_path / "build" / "etc" / "init.d-posix").mkdir(parents=True)
    return script(tmp_path / "build" / "bin" / "px4", text)


def is_running(pid: int) -> bool:
    try:
        return bool(Path(f"/proc/{pid}/cmdline").read_bytes())  # of one that has ended: empty, then gone
    except FileNotFoundError:
        return False


def log_of(process: AutopilotProcess, until: str) -> str:
    deadline = time.monotonic() + 5.0
    while until not in (text := process.log_tail(100)) and time.monotonic() < deadline:
        time.sleep(0.02)
    return text


def test_px4_gets_our_parameters_its_etc_and_a_fresh_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PX4_PARAM_EKF2_EV_CTRL", "0")  # what lies in the environment does not count
    binary = px4_build(tmp_path, 'echo "$@"; pwd; env | grep ^PX4_ | sort; echo done; sleep 60')
    with start_px4(binary, {"EKF2_EV_CTRL": 15, "THR_MDL_FAC": 0.65}) as process:
        text = log_of(process, "done")
        assert f"-d -i 0 -w {process.folder} {tmp_path / 'build' / 'etc'}" in text
        assert text.splitlines()[1] == str(process.folder)
        assert (
            "PX4_PARAM_EKF2_EV_CTRL=15\nPX4_PARAM_MAV_SYS_ID=1\nPX4_PARAM_THR_MDL_FAC=0.65\nPX4_SIM_MODEL=none_iris"
            in text
        )
        assert process.is_running
    assert not process.is_running
    assert not process.folder.exists()


def test_arducopter_gets_a_file_of_parameters_and_both_links(tmp_path: Path) -> None:
    binary = script(tmp_path / "arducopter", 'echo "$@"; cat stockpilot.parm; echo done; sleep 60')
    with start_arducopter(binary, {"VISO_TYPE": 1, "RNGFND1_MIN": 0.05}, tmp_path / "work") as process:
        text = log_of(process, "done")
    assert "--model JSON:127.0.0.1" in text
    assert "--serial0 udpclient:127.0.0.1:14540 --serial1 udpclient:127.0.0.1:14550" in text
    assert "VISO_TYPE 1\nRNGFND1_MIN 0.05\n" in text
    assert (tmp_path / "work").exists()  # a folder that the caller gave stays, with the log


def test_one_that_ignores_the_signal_is_ended_all_the_same(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("simbridge.sitl.process.STOP_GRACE_S", 0.2)
    binary = px4_build(tmp_path, "trap '' TERM; echo ready; while true; do sleep 0.1; done")
    process = start_px4(binary, {})
    log_of(process, "ready")
    process.stop()
    assert not process.is_running


@pytest.mark.skipif(sys.platform != "linux", reason="asked of the Linux kernel")
def test_one_whose_simulation_is_killed_ends_too(tmp_path: Path) -> None:
    """Left over it would hold its ports, and the next flight would not start."""
    binary = px4_build(tmp_path, "sleep 60")
    program = (
        "from pathlib import Path; from simbridge.sitl.process import start_px4\n"
        f"p = start_px4(Path({str(binary)!r}), {{}}); print(p.process.pid, flush=True); p.process.wait()"
    )
    simulation = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE)
    assert simulation.stdout is not None
    pid = int(simulation.stdout.readline())
    simulation.kill()
    simulation.communicate()
    deadline = time.monotonic() + 5.0
    while is_running(pid):
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_one_that_ends_by_itself_is_told_with_the_end_of_its_log(tmp_path: Path) -> None:
    binary = px4_build(tmp_path, "echo starting; echo no such thing; exit 3")
    with start_px4(binary, {}) as process:
        process.process.wait(5.0)
        with pytest.raises(SitlError, match=r"px4 ended with code 3; .*\nstarting\nno such thing"):
            process.check()


def test_a_binary_that_is_none_is_told(tmp_path: Path) -> None:
    with pytest.raises(SitlError, match="not an executable file"):
        start_arducopter(tmp_path / "arducopter", {})


def test_px4_without_its_start_scripts_is_told(tmp_path: Path) -> None:
    with pytest.raises(SitlError, match=r"no etc/init\.d-posix beside it"):
        start_px4(script(tmp_path / "px4", "exit 0"), {})


def test_a_folder_with_old_parameters_in_it_is_refused(tmp_path: Path) -> None:
    (tmp_path / "parameters.bson").touch()
    binary = px4_build(tmp_path / "build", "exit 0")
    with pytest.raises(SitlError, match="is not empty"):
        start_px4(binary, {}, tmp_path)
