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
    temporary = target.with_name(target.name + ".part")
    messages, first_ns, last_ns = 0, None, None
    try:
        with temporary.open("wb") as file:
            writer = McapWriter(file.write)
            copier = _Copier(scan, writer)
            for item in scan:
                if isinstance(item, Message):
                    messages += 1
                    first_ns = item.t_ns if first_ns is None else min(first_ns, item.t_ns)
                    last_ns = item.t_ns if last_ns is None else max(last_ns, item.t_ns)
                copier.copy(item)
            writer.finish()
            file.flush()
            os.fsync(file.fileno())
        is_written = messages > 0 and not scan.is_whole
        if is_written:
            temporary.replace(target)
    except OSError as error:
        raise FileFormatError(f"{target}: cannot be written: {error.strerror}") from None
    finally:
        temporary.unlink(missing_ok=True)
    return Recovery(
        path=path,
        output=target if is_written else None,
        is_whole=scan.is_whole,
        messages=messages,
        first_ns=first_ns,
        last_ns=last_ns,
        bytes_total=len(scan.data),
        bytes_lost=sum(d.bytes_lost for d in scan.damage),
        orphans=scan.orphans,
        damage=tuple(scan.damage),
    )


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
