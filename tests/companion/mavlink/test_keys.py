"""The signing key on disk: refused when it is none, times kept over a restart."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.errors import ConfigError
from companion.mavlink.keys import open_signer


def stamp(data: bytes) -> int:
    return int.from_bytes(data[-12:-6], "little")


def test_times_go_on_after_a_restart(tmp_path: Path) -> None:
    """AUTOPILOTS.md: timestamps must never go back: persist them (a companion has no clock at boot)."""
    key = tmp_path / "key"
    key.write_text("ab" * 32)
    ahead = 1 << 46  # a clock that was once far ahead
    (tmp_path / "key.time").write_text(str(ahead))
    first = stamp(open_signer(key).sign(b"frame", 0))
    assert first > ahead
    assert stamp(open_signer(key).sign(b"frame", 0)) > first


def test_a_damaged_time_file_leaves_the_clock(tmp_path: Path) -> None:
    key = tmp_path / "key"
    key.write_text("ab" * 32 + "\n")
    (tmp_path / "key.time").write_text("not a number")
    assert stamp(open_signer(key).sign(b"frame", 0)) > 0


@pytest.mark.parametrize(("text", "why"), [("zz", "64 hex digits"), ("abcd", "got 2 bytes"), (None, "No such file")])
def test_a_key_that_is_none_is_refused(tmp_path: Path, text: str | None, why: str) -> None:
    key = tmp_path / "key"
    if text is not None:
        key.write_text(text)
    with pytest.raises(ConfigError, match=why):
        open_signer(key)
