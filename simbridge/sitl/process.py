"""Starts a user's own autopilot binary in a fresh folder with our parameters, and ends it. An edge: processes."""

from __future__ import annotations

import contextlib
import ctypes
import os
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from simbridge.sitl import SitlError

STOP_GRACE_S = 3.0
LOG_TAIL_LINES = 15
PR_SET_PDEATHSIG = 1  # prctl(2)
ARDUPILOT_RATE_HZ = 800
UNPACED_SPEEDUP = 1000  # ArduCopter never waits for wall time: the physics does, where a flight is paced


@dataclass(slots=True)
class AutopilotProcess:
    """A running autopilot. log_path has all that it printed; the folder goes away with `stop` if we made it."""

    process: subprocess.Popen[bytes]
    folder: Path
    log_path: Path
    owns_folder: bool
    name: str

    @property
    def is_running(self) -> bool:
        return self.process.poll() is None

    def check(self) -> None:
        """Raise SitlError, with the end of its log, if it has ended."""
        code = self.process.poll()
        if code is not None:
            raise SitlError(f"{self.name} ended with code {code}; the end of its log:\n{self.log_tail()}")

    def log_tail(self, lines: int = LOG_TAIL_LINES) -> str:
        text = self.log_path.read_text(encoding="utf-8", errors="replace") if self.log_path.exists() else ""
        return "\n".join(text.splitlines()[-lines:])

    def kill(self) -> None:
        """End it at once, as a power cut does."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()

    def stop(self) -> None:
        """End it: asked first, forced after STOP_GRACE_S (PX4 hangs when its sensors have stopped)."""
        if self.is_running:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.process.pid, signal.SIGTERM)
            try:
                self.process.wait(STOP_GRACE_S)
            except subprocess.TimeoutExpired:
                self.kill()
        if self.owns_folder:
            shutil.rmtree(self.folder, ignore_errors=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.stop()


def start_px4(
    binary: Path, parameters: Mapping[str, float], folder: Path | None = None, *, instance: int = 0
) -> AutopilotProcess:
    """Start PX4 SITL as a client of our simulator port.

    Args:
        binary: .../bin/px4 of a SITL build; its etc/ (start-up scripts) is looked for beside it.
        parameters: set over the airframe's before its modules start.
        folder: working folder, new or empty; None: a temporary one that `stop` removes.
        instance: 0 to 9, added to each of PX4's port numbers, but not to its system id.
    Raises: SitlError: no such binary, no etc/ with it, folder not empty.
    """
    binary = _executable(binary)
    etc = next(
        (p for p in (binary.parent.parent / "etc", binary.parent / "etc") if (p / "init.d-posix").is_dir()), None
    )
    if etc is None:
        raise SitlError(f"{binary}: no etc/init.d-posix beside it or one folder up: give the px4 of a whole SITL build")
    work, owned = _fresh_folder(folder)
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PX4_")}
    environment |= {"PX4_SIM_MODEL": "none_iris", "PX4_PARAM_MAV_SYS_ID": "1"}
    environment |= {f"PX4_PARAM_{name}": f"{value:g}" for name, value in parameters.items()}
    return _start([str(binary), "-d", "-i", str(instance), "-w", str(work), str(etc)], work, owned, environment)


def start_arducopter(
    binary: Path,
    parameters: Mapping[str, float],
    folder: Path | None = None,
    *,
    physics_port: int = 9002,
    offboard_port: int = 14540,
    ground_port: int = 14550,
    instance: int = 0,
    speedup: float = UNPACED_SPEEDUP,
    home: tuple[float, float, float] = (47.4, 8.5, 0.0),
) -> AutopilotProcess:
    """Start ArduCopter SITL as a client of our JSON physics; its MAVLink goes to two UDP ports of this machine.

    Args as for `start_px4`. instance: ten times it is added to the numbers of the ports that are not given here.
    home: latitude, longitude (degrees), altitude (metres) that its own sensors are made for.
    """
    binary = _executable(binary)
    work, owned = _fresh_folder(folder)
    defaults = work / "stockpilot.parm"
    defaults.write_text("".join(f"{name} {value:g}\n" for name, value in parameters.items()), encoding="ascii")
    command = [
        str(binary), "--instance", str(instance), "--model", "JSON:127.0.0.1", "--sim-port-out", str(physics_port),
        "--defaults", str(defaults), "--wipe",
        "--speedup", f"{speedup:g}", "--rate", str(ARDUPILOT_RATE_HZ),
        "--home", f"{home[0]},{home[1]},{home[2]},0",
        "--serial0", f"udpclient:127.0.0.1:{offboard_port}", "--serial1", f"udpclient:127.0.0.1:{ground_port}",
    ]  # fmt: skip
    return _start(command, work, owned, dict(os.environ))


def _executable(binary: Path) -> Path:
    path = binary.expanduser().resolve()
    if not path.is_file() or not os.access(path, os.X_OK):
        raise SitlError(f"{binary}: not an executable file; give the SITL binary that your build of the autopilot made")
    return path


def _fresh_folder(folder: Path | None) -> tuple[Path, bool]:
    if folder is None:
        return Path(tempfile.mkdtemp(prefix="stockpilot-sitl-")), True
    if folder.exists() and any(folder.iterdir()):
        raise SitlError(f"{folder}: is not empty; an autopilot starts in a new folder, without old parameters or logs")
    folder.mkdir(parents=True, exist_ok=True)
    return folder.resolve(), False


def _die_with_parent() -> None:
    """Linux: an autopilot left over would hold its ports, and the next one would not start."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def _start(command: list[str], folder: Path, owned: bool, environment: dict[str, str]) -> AutopilotProcess:
    log_path = folder / "autopilot.txt"
    with log_path.open("wb") as log:
        process = subprocess.Popen(
            command, cwd=folder, env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT,
            start_new_session=True, preexec_fn=_die_with_parent,
        )  # fmt: skip
    return AutopilotProcess(process=process, folder=folder, log_path=log_path, owns_folder=owned, name=command[0])
