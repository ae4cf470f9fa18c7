"""How this computer fares: load, memory, disk, temperature. An edge: asks the operating system."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import psutil

from companion.mavlink.computer import ComputerStatus

MIB = 1 << 20


def read_computer(t_ns: int, folder: Path) -> ComputerStatus:
    """Now; the disk is that of `folder`. What the system does not tell is None or empty."""
    memory, disk = psutil.virtual_memory(), psutil.disk_usage(str(folder))
    cores = tuple(share / 100 for share in psutil.cpu_percent(percpu=True))
    return ComputerStatus(
        t_ns=t_ns,
        uptime_s=time.monotonic(),
        cpu_core_ratios=cores,
        ram_used_mib=int(memory.used // MIB),
        ram_total_mib=int(memory.total // MIB),
        disk_used_mib=int((disk.total - disk.free) // MIB),  # what is kept for root is no more free than the rest
        disk_total_mib=int(disk.total // MIB),
        temperature_c=_temperature(),
    )


def _temperature() -> float | None:
    """Of the hottest sensor, where the system has any."""
    sensors: dict[str, list[Any]] = getattr(psutil, "sensors_temperatures", dict)()
    readings = [float(reading.current) for group in sensors.values() for reading in group]
    return max(readings, default=None)
