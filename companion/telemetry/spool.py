"""Messages that must arrive, kept on disk until the broker has them: one file each, complete or not there."""

from __future__ import annotations

import json
import os
import threading
from dataclasses import dataclass
from pathlib import Path

MAX_FILES = 5000


@dataclass(frozen=True, slots=True)
class Letter:
    """topic: below the prefix. payload: JSON."""

    topic: str
    payload: bytes


class Spool:
    """First in, first out, over restarts. At most MAX_FILES: then the oldest goes, and `dropped` counts it. Disk errors
    are counted in `errors`, never raised: telemetry may not end a flight. Safe to call from several threads."""

    def __init__(self, folder: Path) -> None:
        self.dropped = 0
        self.errors = 0
        self._folder = folder
        self._lock = threading.Lock()
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._names = sorted(p.name for p in folder.glob("*.json"))
        except OSError:
            self.errors += 1
            self._names = []
        last = self._names[-1].split(".")[0] if self._names else "0"
        self._next = int(last) + 1 if last.isdigit() else 1

    def __len__(self) -> int:
        return len(self._names)

    def put(self, letter: Letter) -> None:
        name = f"{self._next:012d}.json"
        self._next += 1
        temporary = self._folder / (name + ".part")
        try:
            with temporary.open("wb") as file:
                file.write(json.dumps({"topic": letter.topic, "payload": letter.payload.decode()}).encode())
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(self._folder / name)
        except OSError:
            self.errors += 1
            return
        with self._lock:
            self._names.append(name)
            is_full = len(self._names) > MAX_FILES
        if is_full:
            self.dropped += 1
            self.remove(self._names[0])

    def oldest(self) -> tuple[str, Letter] | None:
        """The next to be sent, with its name for `remove`; what cannot be read is thrown away and counted."""
        while self._names:
            name = self._names[0]
            try:
                content = json.loads((self._folder / name).read_bytes())
                return name, Letter(str(content["topic"]), str(content["payload"]).encode())
            except (OSError, ValueError, KeyError, TypeError):
                self.errors += 1
                self.remove(name)
        return None

    def remove(self, name: str) -> None:
        """It was delivered."""
        with self._lock:
            if name in self._names:
                self._names.remove(name)
        try:
            (self._folder / name).unlink(missing_ok=True)
        except OSError:
            self.errors += 1
