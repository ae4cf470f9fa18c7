"""A file that is only ever added to: the first failure latches, nothing raises, the file ends where a write ended."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

from companion.errors import StockpilotError


class AppendFile:
    """Unbuffered. After the first failed write `error` says why, and no later write is tried: a hole in the middle of
    a recording is worse than its end.

    Raises: StockpilotError: it cannot be created.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.error: str | None = None
        self.bytes_written = 0
        self._is_dirty = False
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        except OSError as error:
            raise StockpilotError(
                f"recording {path}: cannot be created ({error.strerror}); choose another folder with --out"
            ) from None

    def write(self, data: bytes) -> None:
        """Add all of data, or latch."""
        if self.error is not None:
            return
        view = memoryview(data)
        try:
            while view:
                view = view[os.write(self._fd, view) :]
        except OSError as error:
            self._latch(error)
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, self.bytes_written)
            return
        self.bytes_written += len(data)
        self._is_dirty = True

    def sync(self) -> None:
        """Put what was written on the disk itself."""
        if self._is_dirty and self.error is None:
            try:
                os.fsync(self._fd)
                self._is_dirty = False
            except OSError as error:
                self._latch(error)

    def free_bytes(self) -> int:
        """Space left on the file system for this user; 0 if it cannot be asked."""
        try:
            stat = os.fstatvfs(self._fd)
        except OSError:
            return 0
        return stat.f_bavail * stat.f_frsize

    def close(self) -> None:
        self.sync()
        with contextlib.suppress(OSError):
            os.close(self._fd)

    def _latch(self, error: OSError) -> None:
        self.error = f"{self.path.name}: {error.strerror or error}"
