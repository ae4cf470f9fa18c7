"""`stockpilot info`: what is in a recording, and whether it is sound."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import typer

from companion.lidar.pcap import PcapReader
from companion.recording import manifest
from companion.recording.mcap_read import Attachment, Message, Metadata, open_mcap
from companion.recording.recover import RECOVERED
from companion.recording.run_files import read_run
from companion.recording.tlog import read_tlog
from stockpilot.carmen import carmen_lines
from stockpilot.file_kinds import FileKind, file_kind
from stockpilot.ros_scans import open_bag
from stockpilot.scan_files import decoder_of, metadata_beside

GAP_FACTOR = 5.0  # a gap this many times the usual interval of a steady stream is told
GAP_LEAST_NS = 500_000_000
STOP_AND_GO = ("navigator/setpoint", "guard/setpoint")  # steady only while the companion is in control


@dataclass(slots=True)
class Stream:
    """One topic, port or message type as it came in time."""

    name: str
    kind: str = ""
    times_ns: list[int] = field(default_factory=list)
    size: int = 0

    def add(self, t_ns: int, size: int) -> None:
        self.times_ns.append(t_ns)
        self.size += size

    def as_dict(self) -> dict[str, Any]:
        times = sorted(self.times_ns)
        steps = sorted(b - a for a, b in pairwise(times))
        span_s = (times[-1] - times[0]) * 1e-9 if times else 0.0
        longest_s = steps[-1] * 1e-9 if steps else None
        return {
            "name": self.name,
            "type": self.kind,
            "count": len(times),
            "bytes": self.size,
            "rate_hz": round((len(times) - 1) / span_s, 3) if span_s > 0 else None,
            "longest_gap_s": None if longest_s is None else round(longest_s, 6),
            "has_gap": self.name not in STOP_AND_GO and _has_gap(steps),
        }


def _has_gap(steps_ns: list[int]) -> bool:
    """Whether a steady stream (nine in ten intervals alike) was interrupted. steps_ns: its intervals, shortest first."""
    if len(steps_ns) < 20:
        return False
    median, tenth = steps_ns[len(steps_ns) // 2], steps_ns[len(steps_ns) * 9 // 10]
    return tenth <= 2 * median and steps_ns[-1] > max(GAP_FACTOR * median, GAP_LEAST_NS)


@dataclass(slots=True)
class Contents:
    """labels: what is said of the recording (mission, seed, state). problems: why its verdict is not "sound"."""

    path: Path
    kind: FileKind
    streams: dict[str, Stream] = field(default_factory=dict)
    labels: dict[str, str] = field(default_factory=dict)
    drops: dict[str, int] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    def stream(self, name: str, kind: str = "") -> Stream:
        return self.streams.setdefault(name, Stream(name, kind))

    def as_dict(self) -> dict[str, Any]:
        streams = [s.as_dict() for s in sorted(self.streams.values(), key=lambda s: s.name)]
        times = [t for s in self.streams.values() for t in s.times_ns]
        gaps = [f"gap of {s['longest_gap_s']:.3f} s in {s['name']}" for s in streams if s["has_gap"]]
        drops = [f"{n} dropped: {why}" for why, n in sorted(self.drops.items()) if n]
        problems = self.problems + drops + gaps
        if not times:
            problems.insert(0, "nothing is in it")
        return {
            "file": str(self.path),
            "kind": self.kind.value,
            "duration_s": (max(times) - min(times)) * 1e-9 if times else 0.0,
            "labels": self.labels,
            "topics": streams,
            "drops": self.drops,
            "problems": problems,
            "verdict": "sound" if not problems else "not sound",
        }


def contents_of(path: Path) -> Contents:
    """Read a recording through. Raises: FileFormatError: it is none that is known."""
    kind, file = file_kind(path)
    found = Contents(file, kind)
    readers = {
        FileKind.MCAP: _read_mcap,
        FileKind.PACKED: _read_packed,
        FileKind.PCAP: _read_pcap,
        FileKind.TLOG: _read_tlog,
        FileKind.ROS1: _read_bag,
        FileKind.ROS2: _read_bag,
        FileKind.CARMEN: _read_carmen,
    }
    readers[kind](found)
    folder = path if path.is_dir() else path.parent
    found.problems += [f"{m.name} {m.what}" for m in manifest.compare(folder)]
    return found


def info_command(
    file: Annotated[
        Path, typer.Argument(help="MCAP, run folder, pcap, tlog, ROS bag or CARMEN log", show_default=False)
    ],
    as_json: Annotated[bool, typer.Option("--json", help="print the result as JSON on stdout")] = False,
) -> None:
    """Say what is in a recording: topics, rates, gaps, drops, duration, mission, and a verdict.

    Exit codes: 0 sound, 1 readable but not sound (gaps, drops, damage, altered files), 2 not a recording.
    """
    said = contents_of(file).as_dict()
    typer.echo(json.dumps(said, indent=2) if as_json else describe(said))
    raise typer.Exit(0 if said["verdict"] == "sound" else 1)


def describe(said: dict[str, Any]) -> str:
    """The same for people."""
    lines = [f"{said['file']}: {said['kind']}, {said['duration_s']:.3f} s"]
    lines += [f"  {key}: {value}" for key, value in said["labels"].items()]
    width = max([len(s["name"]) for s in said["topics"]], default=0)
    lines.append(f"  {'topic':<{width}}  {'messages':>9}  {'rate, Hz':>9}  {'longest gap, s':>14}  {'MB':>8}  type")
    for s in said["topics"]:
        rate = "" if s["rate_hz"] is None else f"{s['rate_hz']:.2f}"
        gap = "" if s["longest_gap_s"] is None else f"{s['longest_gap_s']:.3f}"
        size = f"{s['bytes'] / 1e6:.3f}"
        lines.append(f"  {s['name']:<{width}}  {s['count']:>9}  {rate:>9}  {gap:>14}  {size:>8}  {s['type']}".rstrip())
    lines += [f"  problem: {p}" for p in said["problems"]]
    lines.append(f"verdict: {said['verdict']}")
    return "\n".join(lines)


# ---- readers ---------------------------------------------------------------------------------------------------------


def _read_mcap(found: Contents) -> None:
    scan = open_mcap(found.path)
    for item in scan:
        if isinstance(item, Message):
            schema = scan.schemas.get(item.channel.schema_id)
            kind = item.channel.metadata.get("message") or (
                schema.name if schema is not None else item.channel.encoding
            )
            found.stream(item.channel.topic, kind).add(item.t_ns, len(item.data))
        elif isinstance(item, Metadata):
            values = {k: v for k, v in item.values.items() if len(v) <= 200}
            if item.name == RECOVERED:
                found.problems += [f"lost before it was recovered, {where}: {what}" for where, what in values.items()]
            elif item.name == "recorder":
                found.drops.update({f"recorder: {k}": int(v) for k, v in values.items() if v.isdigit()})
            else:
                found.labels.update({k if item.name == "run" else f"{item.name} {k}": v for k, v in values.items()})
        elif isinstance(item, Attachment):
            found.labels[f"attachment {item.name}"] = f"{len(item.data)} bytes"
    found.problems += [f"damage at byte {d.offset}: {d.what}" for d in scan.damage]
    if not scan.is_finished:
        found.problems.append("it was not closed: stockpilot recover rebuilds it")


def _read_packed(found: Contents) -> None:
    run = read_run(found.path)
    for item in run.inputs:
        found.stream("in/" + item.kind, "input").add(item.t_ns, len(item.data))
    found.labels.update(run.metadata.get("run", {}))


def _read_pcap(found: Contents) -> None:
    reader = PcapReader(found.path)
    metadata = metadata_beside(found.path)
    decoder = None if metadata is None else decoder_of(metadata)
    scans = Stream("scans (Ouster)", "LidarScan")
    for packet in reader:
        found.stream(f"udp {packet.destination[1]}", f"{len(packet.data)} byte datagrams").add(
            packet.t_ns, len(packet.data)
        )
        if decoder is not None:
            for scan in decoder.receive(packet.data, packet.t_ns, packet.source):
                scans.add(scan.t_ns, int(scan.range_m.nbytes))
    if decoder is not None and metadata is not None:
        found.labels["metadata"] = metadata.name
        found.labels["sensor"] = f"{decoder.info.prod_line} {decoder.info.sn}, {decoder.info.h} x {decoder.info.w}"
        found.streams[scans.name] = scans
        found.drops.update({f"LiDAR packet, {k}": n for k, n in decoder.dropped.items() if k != "size"})
    if reader.is_cut:
        found.problems.append("it ends within a record")
    if reader.incomplete:
        found.problems.append(f"{reader.incomplete} datagrams lack fragments")


def _read_tlog(found: Contents) -> None:
    from pymavlink.dialects.v20 import common

    expected: dict[tuple[int, int], int] = {}
    lost = 0
    data = found.path.read_bytes()
    read = 0
    for t_us, frame in read_tlog(data):
        read += 8 + len(frame)
        if frame[0] == 0xFD:
            sequence, system, component, message = frame[4], frame[5], frame[6], int.from_bytes(frame[7:10], "little")
        else:
            sequence, system, component, message = frame[2], frame[3], frame[4], frame[5]
        sender = (system, component)
        lost += (sequence - expected.get(sender, sequence)) % 256
        expected[sender] = (sequence + 1) % 256
        known = common.mavlink_map.get(message)
        name = f"id {message}" if known is None else known.msgname
        found.stream(f"{system}/{component} {name}").add(t_us * 1000, len(frame))
    if lost:
        found.drops["MAVLink frames missing by sequence number"] = lost
    if read < len(data):
        found.problems.append(f"the last {len(data) - read} bytes are not MAVLink")


def _read_bag(found: Contents) -> None:
    with open_bag(found.path) as reader:
        for connection, t_ns, raw in reader.messages():
            found.stream(connection.topic, connection.msgtype).add(t_ns, len(raw))


def _read_carmen(found: Contents) -> None:
    for word, t_ns, size in carmen_lines(found.path, found.drops):
        found.stream(word).add(t_ns, size)
