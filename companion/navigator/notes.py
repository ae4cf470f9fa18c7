"""What one step of the navigator asks for and tells."""

from __future__ import annotations

from companion.messages import Event, OperatorCommandKind, RequestKind, Severity, VehicleRequest


class Notes:
    """Begun anew at each step."""

    def __init__(self, t_ns: int) -> None:
        self._t_ns = t_ns
        self.requests: list[VehicleRequest] = []
        self.events: list[Event] = []

    def ask(self, kind: RequestKind) -> None:
        self.requests.append(VehicleRequest(t_ns=self._t_ns, kind=kind))

    def tell(self, severity: Severity, name: str, text: str) -> None:
        self.events.append(Event(t_ns=self._t_ns, severity=severity, name=name, text=text))

    def refuse(self, kind: OperatorCommandKind, why: str) -> None:
        self.tell(Severity.NOTICE, "command_refused", f"{kind.value} refused: {why}")
