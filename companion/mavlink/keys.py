"""The signing key and the newest signature time on disk (edge): times must never go back, and a companion has no clock
at boot."""

from __future__ import annotations

import contextlib
import os
import time
from pathlib import Path

from companion.errors import ConfigError
from companion.mavlink.signing import Signer

_EPOCH_2015_S = 1_420_070_400  # signature times count from here (MAVLink, message signing)
_TICKS_PER_S = 100_000


def open_signer(key_file: Path) -> Signer:
    """A signer with the key of `key_file` (64 hex digits) and the time kept beside it in `<key_file>.time`.

    Raises: ConfigError: file, what was expected, how to mend it.
    """
    try:
        key = bytes.fromhex(key_file.read_text(encoding="ascii").strip())
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"mavlink.signing_key_file: {key_file}: {error}; expected a file with 64 hex digits, made for example by "
            "`openssl rand -hex 32`"
        ) from None
    if len(key) != 32:
        raise ConfigError(
            f"mavlink.signing_key_file: {key_file}: expected 64 hex digits (32 bytes), got {len(key)} bytes"
        )
    kept = key_file.with_name(key_file.name + ".time")
    newest = max(_read(kept), int((time.time() - _EPOCH_2015_S) * _TICKS_PER_S))

    def save(timestamp: int) -> None:
        temporary = kept.with_name(kept.name + ".new")
        temporary.write_text(f"{timestamp}\n", encoding="ascii")
        os.replace(temporary, kept)

    def save_in_flight(timestamp: int) -> None:
        with contextlib.suppress(OSError):  # a full disk must not end a flight; the next start has the clock besides
            save(timestamp)

    try:
        save(max(0, newest))
        return Signer(key=key, timestamp=max(0, newest), save=save_in_flight)
    except OSError as error:
        raise ConfigError(
            f"mavlink.signing_key_file: {kept} cannot be written: {error}; choose a folder that can"
        ) from None


def _read(kept: Path) -> int:
    """0 when there is none yet, or it is damaged: then the clock alone counts."""
    try:
        return int(kept.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return 0
