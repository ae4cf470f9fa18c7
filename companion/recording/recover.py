"""A cut or damaged recording, rebuilt: all that can still be read goes into a new file, the old one is not touched."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from companion.errors import FileFormatError
from companion.recording import channels
from companion.recording.mcap_read import Attachment, Damage, McapScan, Message, Metadata, open_mcap
from companion.recording.mcap_write import Channel, McapWriter, Schema

SUFFIX = ".recovered.mcap"
RECOVERED = "recovered"  # metadata of a rebuilt recording: what was lost, by where


@dataclass(frozen=True, slots=True, kw_only=True)
class Recovery:
    """output: the rebuilt file; None where the original is whole, or nothing could be read."""

    path: Path
    output: Path | None
    is_whole: bool
    messages: int
    first_ns: int | None
    last_ns: int | None
    bytes_total: int
    bytes_lost: int
    orphans: int
    damage: tuple[Damage, ...]

    @property
    def is_empty(self) -> bool:
        return self.messages == 0


def recover(path: Path, output: Path | None = None) -> Recovery:
    """Rebuild path into output (default: beside it). A whole file is only read.

    Raises: FileFormatError: it cannot be read, or the output would be the file itself.
    """
    target = output or path.with_name(path.name.removesuffix(".mcap") + SUFFIX)
    if target.exists() and path.exists() and os.path.samefile(target, path):
        raise FileFormatError(
            f"{target}: is the recording itself; the original is never written to: choose another --out"
        )
    scan = open_mcap(path)
    times = [item.t_ns for item in scan if isinstance(item, Message)]
    is_needed = bool(times) and not scan.is_whole
    if is_needed:
        _rebuild(path, target)
    return Recovery(
        path=path,
        output=target if is_needed else None,
        is_whole=scan.is_whole,
        messages=len(times),
        first_ns=min(times, default=None),
        last_ns=max(times, default=None),
        bytes_total=len(scan.data),
        bytes_lost=sum(d.bytes_lost for d in scan.damage),
        orphans=scan.orphans,
        damage=tuple(scan.damage),
    )


def _rebuild(path: Path, target: Path) -> None:
    """Write all that can be read of path to target, which is complete or not there."""
    temporary = target.with_name(target.name + ".part")
    try:
        with temporary.open("wb") as file:
            writer = McapWriter(file.write)
            scan = open_mcap(path)
            copier = _Copier(scan, writer)
            for item in scan:
                copier.copy(item)
            writer.add_metadata(RECOVERED, _what_was_lost(scan))
            writer.finish()
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(target)
    except OSError as error:
        raise FileFormatError(f"{target}: cannot be written: {error.strerror}") from None
    finally:
        temporary.unlink(missing_ok=True)


def _what_was_lost(scan: McapScan) -> dict[str, str]:
    """Of a recording that was read through: a rebuilt one is closed and sound in itself, but it has holes."""
    lost = {f"at byte {d.offset}": f"{d.bytes_lost} bytes: {d.what}" for d in scan.damage}
    if scan.orphans:
        lost["messages of unknown channels"] = str(scan.orphans)
    return lost or {"end": "it was not closed"}


class _Copier:
    """Writes items as they come; schemas that were lost are taken from what this program would have written."""

    def __init__(self, scan: McapScan, writer: McapWriter) -> None:
        self._scan = scan
        self._writer = writer
        self._known = {s.id: s for s in channels.all_schemas()}
        self._written: dict[int, Channel] = {}
        self._schemas: set[int] = set()

    def copy(self, item: object) -> None:
        if isinstance(item, Message):
            self._channel(self._scan.channels[item.channel.id])
            self._writer.add_message(item.channel.id, item.t_ns, item.data, publish_ns=item.publish_ns)
        elif isinstance(item, Attachment):
            self._writer.add_attachment(item.name, item.media_type, item.data, item.t_ns)
        elif isinstance(item, Metadata):
            self._writer.add_metadata(item.name, item.values)
        elif isinstance(item, Schema):
            self._schema(item.id, item)
        elif isinstance(item, Channel):
            self._channel(item)

    def _schema(self, schema_id: int, schema: Schema | None) -> None:
        if schema is not None and schema_id not in self._schemas:
            self._schemas.add(schema_id)
            self._writer.add_schema(schema)

    def _channel(self, channel: Channel) -> None:
        if self._written.get(channel.id) == channel:
            return
        self._written[channel.id] = channel
        if channel.schema_id:
            self._schema(
                channel.schema_id, self._scan.schemas.get(channel.schema_id) or self._known.get(channel.schema_id)
            )
        self._writer.add_channel(channel)
