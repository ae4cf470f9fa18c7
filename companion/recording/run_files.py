"""What a recording holds, read back: the calls into the flight core in their order, messages, configuration."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

from companion.errors import FileFormatError
from companion.recording import channels
from companion.recording.log import MCAP_NAME
from companion.recording.mcap_read import Attachment, Message, Metadata, open_mcap
from companion.recording.packed import SUFFIX, unpack
from companion.recording.run_types import Input, RunRecording

__all__ = ["PACKED_NAME", "Input", "RunRecording", "iter_inputs", "read_run", "recording_path"]

PACKED_NAME = "recording" + SUFFIX


def recording_path(path: Path) -> Path:
    """The MCAP file of a run: path itself, or the recording in that folder. Raises: FileFormatError: there is none."""
    if not path.is_dir():
        if not path.exists():
            raise FileFormatError(f"{path}: no such file or folder; expected a run's folder or its {MCAP_NAME}")
        return path
    for name in (MCAP_NAME, PACKED_NAME):
        if (path / name).exists():
            return path / name
    raise FileFormatError(f"{path}: has no {MCAP_NAME}; was the run recorded?")


def iter_inputs(path: Path) -> Iterator[Input]:
    """The calls into the flight core, in the order in which they were made."""
    file = recording_path(path)
    if file.name.endswith(SUFFIX):
        yield from unpack(file.read_bytes()).inputs
        return
    for item in open_mcap(file):
        if isinstance(item, Message) and item.channel.topic.startswith(channels.INPUT_PREFIX):
            yield _input(item)


def read_run(path: Path, *, with_topics: bool = True) -> RunRecording:
    """All of a recording; with_topics False: without the messages between the stages, which replay makes again.

    Raises: FileFormatError: it is none of ours.
    """
    file = recording_path(path)
    if file.name.endswith(SUFFIX):
        return unpack(file.read_bytes())
    run = RunRecording()
    scan = open_mcap(file)
    inputs, topics = run.inputs, run.topics
    for item in scan:
        if isinstance(item, Message):
            topic = item.channel.topic
            if topic.startswith(channels.INPUT_PREFIX):
                inputs.append(_input(item))
            elif with_topics:
                topics.setdefault(topic, []).append((item.t_ns, item.data))
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
    return Input(message.channel.topic[len(channels.INPUT_PREFIX) :], message.t_ns, data, source)
