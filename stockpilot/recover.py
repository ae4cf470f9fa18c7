"""`stockpilot recover`: a recording that was cut or damaged, rebuilt beside the original."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from companion.errors import FileFormatError
from companion.recording.recover import Recovery, recover
from companion.recording.run_files import recording_path
from stockpilot.file_kinds import FileKind, file_kind

EXIT_WHOLE, EXIT_NOTHING, EXIT_LOSS = 0, 1, 3


def recover_command(
    file: Annotated[Path, typer.Argument(help="recording (MCAP) or the folder of a run", show_default=False)],
    out: Annotated[Path | None, typer.Option(help="where to write; default: beside it, NAME.recovered.mcap")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print the result as JSON on stdout")] = False,
) -> None:
    """Rebuild a recording that was cut (power, kill, full disk) or damaged. The original is never touched.

    Exit codes: 0 the file is whole (nothing is written), 3 recovered with loss, 1 nothing in it can be read.
    """
    found = recover(recording_path(file), out)
    typer.echo(json.dumps(as_dict(found), indent=2) if as_json else describe(found))
    if found.is_empty and not found.is_whole:
        raise typer.Exit(EXIT_NOTHING)
    raise typer.Exit(EXIT_WHOLE if found.is_whole else EXIT_LOSS)


def as_dict(found: Recovery) -> dict[str, object]:
    span_s = None if found.first_ns is None or found.last_ns is None else (found.last_ns - found.first_ns) * 1e-9
    state = "whole" if found.is_whole else "nothing" if found.is_empty else "recovered"
    return {
        "file": str(found.path),
        "state": state,
        "output": None if found.output is None else str(found.output),
        "messages": found.messages,
        "duration_s": span_s,
        "bytes": found.bytes_total,
        "bytes_lost": found.bytes_lost,
        "messages_of_unknown_channels": found.orphans,
        "why_nothing": other_kind(found) if found.is_empty and not found.is_whole else [],
        "damage": [{"offset": d.offset, "bytes": d.bytes_lost, "what": d.what} for d in found.damage],
    }


def other_kind(found: Recovery) -> list[str]:
    """Why there is nothing in it, where the file is no MCAP at all."""
    if not found.bytes_total:
        return ["it is empty"]
    try:
        kind, _ = file_kind(found.path)
    except FileFormatError:
        return []
    return [] if kind is FileKind.MCAP else [f"it is a {kind.value}: only MCAP is rebuilt"]


def describe(found: Recovery) -> str:
    """The same for people."""
    said = as_dict(found)
    if found.is_whole:
        return f"{found.path}: whole, {found.messages} messages; nothing to do"
    lines = [f"{found.path}: {'nothing can be read' if found.is_empty else 'damaged'}"]
    if found.is_empty:
        lines += [f"  {line}" for line in other_kind(found)]
    lines += [f"  at byte {d.offset}: {d.what} ({d.bytes_lost} bytes not read)" for d in found.damage]
    if not found.damage and found.bytes_total:
        lines.append("  the end is missing: it was not closed")
    if found.output is not None:
        duration = said["duration_s"]
        lines.append(f"recovered {found.messages} messages over {duration:.3f} s into {found.output}")
    return "\n".join(lines)
