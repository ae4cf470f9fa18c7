"""What an operator may say over MQTT, and what is refused. Pure: bytes and times in, a verdict out.

A command: {"command": "hold", "id": "a1", "time_s": 1790000000.0}, time_s in seconds since 1970 by the sender's clock.
Abort needs nothing else: also {"command": "abort"} and the bare word are taken, however old, retained or repeated,
since landing is the safe side.
"""

from __future__ import annotations

import json
from collections import OrderedDict
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from companion.messages import OperatorCommandKind

MAX_PAYLOAD_BYTES = 1024
MAX_AGE_S = 10.0
MAX_REMEMBERED_IDS = 256
_MAX_REASON = 120


class CommandPayload(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    command: str = Field(max_length=16)
    id: str = Field(min_length=1, max_length=64)
    time_s: Annotated[float, Field(allow_inf_nan=False)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """kind: what to do; None: refused, or done before (is_repeat). reason: why, for the log and the sender."""

    kind: OperatorCommandKind | None
    id: str = ""
    reason: str = ""
    is_repeat: bool = False

    @property
    def is_accepted(self) -> bool:
        return self.kind is not None or self.is_repeat


class CommandGate:
    """Judges payloads; remembers the ids of those it let through, so that a repeated one acts once."""

    def __init__(self) -> None:
        self._done: OrderedDict[str, None] = OrderedDict()
        self.accepted = 0
        self.refused = 0

    def judge(self, payload: bytes, *, is_retained: bool, wall_s: float) -> Verdict:
        """Never raises.

        Args:
            is_retained: the broker kept it and gives it to every newcomer. wall_s: now, seconds since 1970.
        """
        verdict = self._judge(payload, is_retained, wall_s)
        self.accepted += verdict.is_accepted
        self.refused += not verdict.is_accepted
        return verdict

    def _judge(self, payload: bytes, is_retained: bool, wall_s: float) -> Verdict:
        if len(payload) > MAX_PAYLOAD_BYTES:
            return _refuse(f"{len(payload)} bytes, at most {MAX_PAYLOAD_BYTES} are read")
        content = _parse(payload)
        if _is_abort(content):
            return Verdict(kind=OperatorCommandKind.ABORT, id=_id_of(content))
        if is_retained:
            return _refuse("retained: a command is said once, to who listens now")
        try:
            command = CommandPayload.model_validate(content)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(p) for p in first["loc"]) or "payload"
            return _refuse(f"{where}: {first['msg']}")
        allowed = {k.value: k for k in OperatorCommandKind}
        if command.command not in allowed:
            return _refuse(f"command {command.command!r} is none of {', '.join(allowed)}", command.id)
        age_s = wall_s - command.time_s
        if abs(age_s) > MAX_AGE_S:
            return _refuse(f"said {age_s:.1f} s ago by its own time, at most {MAX_AGE_S:g} s are allowed", command.id)
        if command.id in self._done:
            return Verdict(kind=None, id=command.id, reason="done before", is_repeat=True)
        self._done[command.id] = None
        if len(self._done) > MAX_REMEMBERED_IDS:
            self._done.popitem(last=False)
        return Verdict(kind=allowed[command.command], id=command.id)


def _parse(payload: bytes) -> Any:
    try:
        return json.loads(payload)
    except (ValueError, RecursionError):
        return payload.strip().strip(b'"').lower().decode("ascii", errors="replace")


def _is_abort(content: Any) -> bool:
    word = content.get("command") if isinstance(content, dict) else content
    return isinstance(word, str) and word.strip().lower() == OperatorCommandKind.ABORT.value


def _id_of(content: Any) -> str:
    given = content.get("id") if isinstance(content, dict) else None
    return given if isinstance(given, str) and len(given) <= 64 else ""


def _refuse(reason: str, command_id: str = "") -> Verdict:
    return Verdict(kind=None, id=command_id, reason=reason[:_MAX_REASON])
