"""What a recording holds, read back: the calls into the flight core in their order, messages, configuration."""

from __future__ import annotations

import lzma
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from companion.errors import FileFormatError
from companion.recording import channels
from companion.recording.log import MCAP_NAME
from companion.recording.mcap_read import Attachment, McapScan, Message, Metadata, open_mcap


class Input(NamedTuple):
    """One call into the flight core. kind: one of channels.INPUTS."""

    kind: str
    t_ns: int
    data: bytes
    source: tuple[str, int] | None = None


@dataclass(slots=True)
class RunRecording:
    """inputs, and outputs and topics as (time, bytes) for comparison; metadata by name; attachments by name."""

    inputs: list[Input] = field(default_factory=list)
    topics: dict[str, list[tuple[int, bytes]]] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    is_whole: bool = True
    damage: list[str] = field(default_factory=list)


def recording_path(path: Path) -> Path:
    """The MCAP file of a run: path itself, or the recording in that folder. Raises: FileFormatError: there is none."""
    if not path.is_dir():
        if not path.exists():
            raise FileFormatError(f"{path}: no such file or folder; expected a run's folder or its {MCAP_NAME}")
        return path
    for name in (MCAP_NAME, MCAP_NAME + ".xz"):
        if (path / name).exists():
            return path / name
    raise FileFormatError(f"{path}: has no {MCAP_NAME}; was the run recorded?")


def scan_of(path: Path) -> McapScan:
    """The scan of an MCAP file, which may be packed with xz (as the small recordings under missions/replays are)."""
    if path.suffix == ".xz":
        try:
            return McapScan(lzma.decompress(path.read_bytes()))
        except (lzma.LZMAError, OSError) as error:
            raise FileFormatError(f"{path}: expected a file packed with xz: {error}") from None
    return open_mcap(path)


def iter_inputs(path: Path) -> Iterator[Input]:
    """The calls into the flight core, in the order in which they were made."""
    for item in scan_of(recording_path(path)):
        if isinstance(item, Message) and item.channel.topic.startswith(channels.INPUT_PREFIX):
            yield _input(item)


def read_run(path: Path) -> RunRecording:
    """All of a recording. Raises: FileFormatError: it is none of ours."""
    run = RunRecording()
    scan = scan_of(recording_path(path))
    for item in scan:
        if isinstance(item, Message):
            topic = item.channel.topic
            if topic.startswith(channels.INPUT_PREFIX):
                run.inputs.append(_input(item))
            else:
                run.topics.setdefault(topic, []).append((item.t_ns, item.data))
        elif isinstance(item, Metadata):
            run.metadata[item.name] = dict(item.values)
        elif isinstance(item, Attachment):
            run.attachments[item.name] = item.data
    if "run" not in run.metadata and not run.inputs:
        raise FileFormatError(f"{path}: not a recording of a flight (no input was recorded); see stockpilot info")
    run.is_whole = scan.is_whole
    run.damage = [f"at byte {d.offset}: {d.what}" for d in scan.damage]
    return run


def _input(message: Message) -> Input:
    try:
        data, source = channels.unpack_raw(message.data)
    except (struct.error, UnicodeDecodeError) as error:
        raise FileFormatError(f"recording: an input on {message.channel.topic} is not readable: {error}") from None
    return Input(message.channel.topic.removeprefix(channels.INPUT_PREFIX), message.t_ns, data, source)
