"""ONBOARD_COMPUTER_STATUS: how the companion's computer fares."""

from __future__ import annotations

from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as dialect

from companion.mavlink import wire

_UNKNOWN_8, _UNKNOWN_32, _UNKNOWN_TEMPERATURE, _UNKNOWN_FAN = 0xFF, 0xFFFFFFFF, 127, 32767


@dataclass(frozen=True, slots=True, kw_only=True)
class ComputerStatus:
    """Shares are 0 to 1; sizes in MiB; None where it cannot be read."""

    t_ns: int
    uptime_s: float
    cpu_core_ratios: tuple[float, ...]
    ram_used_mib: int
    ram_total_mib: int
    disk_used_mib: int
    disk_total_mib: int
    temperature_c: float | None


def pack_computer_status(status: ComputerStatus) -> bytes:
    """The payload; what we do not know is marked so, as common.xml wants."""
    cores = [min(100, max(0, round(r * 100))) for r in status.cpu_core_ratios[:8]]
    combined = round(sum(cores) / len(cores)) if cores else _UNKNOWN_8
    temperature = _UNKNOWN_TEMPERATURE if status.temperature_c is None else round(status.temperature_c)
    fields = {
        "time_usec": status.t_ns // 1000,
        "uptime": int(status.uptime_s * 1000) & _UNKNOWN_32,
        "type": 0,
        "cpu_cores": [*cores, *[_UNKNOWN_8] * (8 - len(cores))],
        "cpu_combined": [combined, *[_UNKNOWN_8] * 9],
        "gpu_cores": [_UNKNOWN_8] * 4,
        "gpu_combined": [_UNKNOWN_8] * 10,
        "temperature_board": max(-126, min(126, temperature)) if status.temperature_c is not None else temperature,
        "temperature_core": [_UNKNOWN_TEMPERATURE] * 8,
        "fan_speed": [_UNKNOWN_FAN] * 4,
        "ram_usage": status.ram_used_mib,
        "ram_total": status.ram_total_mib,
        "storage_type": [2, *[_UNKNOWN_32] * 3],
        "storage_usage": [status.disk_used_mib, *[_UNKNOWN_32] * 3],
        "storage_total": [status.disk_total_mib, *[_UNKNOWN_32] * 3],
        "link_type": [_UNKNOWN_32] * 6,
        "link_tx_rate": [_UNKNOWN_32] * 6,
        "link_rx_rate": [_UNKNOWN_32] * 6,
        "link_tx_max": [_UNKNOWN_32] * 6,
        "link_rx_max": [_UNKNOWN_32] * 6,
    }
    message = dialect.MAVLink_onboard_computer_status_message
    ordered: list[int] = []
    for name in message.ordered_fieldnames:
        value = fields.get(name, 0)
        ordered.extend(value if isinstance(value, list) else [value])  # type: ignore[list-item]
    payload: bytes = wire.layout(wire.ONBOARD_COMPUTER_STATUS).pack(*ordered)
    return payload
