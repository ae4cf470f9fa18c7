from __future__ import annotations

from companion.mavlink import wire
from companion.mavlink.texts import Texts

SECOND = 1_000_000_000


def said(texts: Texts, words: bytes, t_s: float) -> list[str]:
    return [e.text for e in texts.on_text(wire.pack(wire.STATUSTEXT, 6, words, 0, 0), round(t_s * SECOND))]


def test_what_is_said_each_second_is_told_once_a_minute() -> None:
    """As real ArduCopter with an origin at altitude 0 does on the ground."""
    texts = Texts()
    told = [t for t in range(150) if said(texts, b"Field Elevation Set: 0m", t)]
    assert told == [0, 60, 120]


def test_another_text_between_is_told_at_once() -> None:
    texts = Texts()
    said(texts, b"Field Elevation Set: 0m", 0.0)
    assert said(texts, b"EKF variance", 0.1) == ["EKF variance"]
    assert said(texts, b"Field Elevation Set: 0m", 0.2) == []
