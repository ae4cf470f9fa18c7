"""What an operator may say over MQTT."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.messages import OperatorCommandKind
from companion.telemetry.commands import MAX_AGE_S, MAX_PAYLOAD_BYTES, CommandGate

NOW_S = 1_790_000_000.0


def payload(**changes: object) -> bytes:
    return json.dumps({"command": "hold", "id": "a1", "time_s": NOW_S, **changes}).encode()


def judge(data: bytes, *, is_retained: bool = False):
    return CommandGate().judge(data, is_retained=is_retained, wall_s=NOW_S)


@pytest.mark.parametrize("kind", list(OperatorCommandKind))
def test_every_command_is_let_through_when_all_is_right(kind: OperatorCommandKind) -> None:
    assert judge(payload(command=kind.value)).kind is kind


@pytest.mark.parametrize(
    "data",
    [
        b'{"command": "abort"}',
        b"abort",
        b' "ABORT" \n',
        payload(command="abort", time_s=0.0),
        payload(command="abort", surplus=[1, 2]),
        payload(command="Abort", id=None),
    ],
)
@pytest.mark.parametrize("is_retained", [False, True])
def test_abort_is_always_accepted(data: bytes, is_retained: bool) -> None:
    assert judge(data, is_retained=is_retained).kind is OperatorCommandKind.ABORT


def test_abort_is_accepted_again_and_again() -> None:
    gate = CommandGate()
    kinds = [gate.judge(payload(command="abort"), is_retained=False, wall_s=NOW_S).kind for _ in range(3)]
    assert kinds == [OperatorCommandKind.ABORT] * 3


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "payload"),
        (b"{", "payload"),
        (b"[]", "payload"),
        (b"hold", "payload"),
        (b"[" * 1000, "payload"),
        (payload(id=""), "id"),
        (payload(id="x" * 65), "id"),
        (payload(id=7), "id"),
        (payload(command="disarm"), "none of"),
        (payload(command=1), "command"),
        (payload(time_s="now"), "time_s"),
        (payload(time_s=float("nan")), "time_s"),
        (payload(surplus=1), "surplus"),
        (payload(time_s=NOW_S - MAX_AGE_S - 1), "ago"),
        (payload(time_s=NOW_S + MAX_AGE_S + 1), "ago"),
        (payload(id="x" * MAX_PAYLOAD_BYTES), "bytes"),
        (b"abort" + b" " * MAX_PAYLOAD_BYTES, "bytes"),
    ],
)
def test_wrong_payload_is_refused_with_its_reason(data: bytes, why: str) -> None:
    verdict = judge(data)
    assert verdict.kind is None
    assert not verdict.is_accepted
    assert why in verdict.reason


def test_retained_command_is_refused() -> None:
    assert "retained" in judge(payload(), is_retained=True).reason


def test_repeated_id_is_acknowledged_but_acts_once() -> None:
    gate = CommandGate()
    first = gate.judge(payload(), is_retained=False, wall_s=NOW_S)
    second = gate.judge(payload(), is_retained=False, wall_s=NOW_S + 1)
    assert first.kind is OperatorCommandKind.HOLD
    assert second.kind is None
    assert second.is_accepted


@given(st.binary(max_size=2000), st.booleans())
def test_no_payload_makes_the_gate_raise_or_act_but_a_plain_abort(data: bytes, is_retained: bool) -> None:
    verdict = judge(data, is_retained=is_retained)
    assert verdict.kind in (None, OperatorCommandKind.ABORT)
    assert verdict.kind is None or b"abort" in data.lower()
