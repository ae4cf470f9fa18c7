"""Events waiting to be told."""

from __future__ import annotations

from collections.abc import Iterable

from companion.messages import Event, Severity


class Journal:
    """t_ns: companion time of what is being handled now; the session keeps it up to date."""

    def __init__(self) -> None:
        self.t_ns = 0
        self._events: list[Event] = []

    def tell(self, severity: Severity, name: str, text: str) -> None:
        self._events.append(Event(t_ns=self.t_ns, severity=severity, name=name, text=text))

    def add(self, events: Iterable[Event]) -> None:
        self._events.extend(events)

    def take(self) -> list[Event]:
        events, self._events = self._events, []
        return events
