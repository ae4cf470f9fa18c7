"""What runs beside a test: a context with a thread of its own."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from types import TracebackType
from typing import Self


class Background(ABC):
    """A context: inside it `_run` runs in a thread, until `_stop` is set on leaving."""

    def __init__(self) -> None:
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join(10)
        self._close()

    @abstractmethod
    def _run(self) -> None: ...

    @abstractmethod
    def _close(self) -> None:
        """Give back what it holds: the thread has ended."""
