"""COMMAND_LONG with acknowledgement, retries and time-out: one command of a kind on the wire at a time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from companion.mavlink import wire

TIMEOUT_NS = 700_000_000
TRIES = 4
_IN_PROGRESS = 5
_RESULTS = {
    0: "accepted",
    1: "temporarily rejected",
    2: "denied",
    3: "unsupported",
    4: "failed",
    5: "in progress",
    6: "cancelled",
    7: "only as COMMAND_LONG",
    8: "only as COMMAND_INT",
    9: "unsupported frame",
    10: "not in control",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """How a command ended. result: MAV_RESULT, None when no answer came."""

    command: int
    label: str
    result: int | None
    tries: int

    @property
    def accepted(self) -> bool:
        return self.result == 0

    @property
    def word(self) -> str:
        if self.result is None:
            return f"not answered, sent {self.tries} times"
        return _RESULTS.get(self.result, f"result {self.result}")


@dataclass(slots=True)
class _Pending:
    command: int
    params: tuple[float, ...]
    label: str
    then: Callable[[Outcome, int], None] | None
    tries: int = 0
    t_retry_ns: int = 0


@dataclass(slots=True)
class Commands:
    """The queue of each command id; its head is on the wire. `send` puts a payload of COMMAND_LONG on the link."""

    send: Callable[[bytes], None]
    target_system: int
    _queues: dict[int, deque[_Pending]] = field(default_factory=dict)

    def request(
        self,
        command: int,
        params: tuple[float, ...],
        t_ns: int,
        *,
        label: str = "",
        then: Callable[[Outcome, int], None] | None = None,
    ) -> None:
        """Send a command and call `then` with how it ended. params: up to 7, the rest 0."""
        queue = self._queues.setdefault(command, deque())
        queue.append(_Pending(command, (*params, *(0.0,) * (7 - len(params))), label, then))
        if len(queue) == 1:
            self._transmit(queue[0], t_ns)

    def on_ack(self, command: int, result: int, t_ns: int) -> None:
        """COMMAND_ACK came for us."""
        queue = self._queues.get(command)
        if not queue:
            return
        if result == _IN_PROGRESS:
            queue[0].t_retry_ns = t_ns + 10 * TIMEOUT_NS
            return
        self._finish(queue, result, t_ns)

    def poll(self, t_ns: int) -> None:
        for queue in list(self._queues.values()):
            if queue and queue[0].t_retry_ns <= t_ns:
                if queue[0].tries < TRIES:
                    self._transmit(queue[0], t_ns)
                else:
                    self._finish(queue, None, t_ns)

    def next_deadline_ns(self) -> int | None:
        return min((queue[0].t_retry_ns for queue in self._queues.values() if queue), default=None)

    def is_waiting(self, command: int, label: str) -> bool:
        """The newest of this kind is the same and has had no answer yet."""
        queue = self._queues.get(command)
        return queue is not None and len(queue) > 0 and queue[-1].label == label

    def clear(self) -> None:
        """Forget all without a word: nothing asked of an autopilot before its restart may reach it after."""
        self._queues.clear()

    def _finish(self, queue: deque[_Pending], result: int | None, t_ns: int) -> None:
        done = queue.popleft()
        if queue:
            self._transmit(queue[0], t_ns)
        if done.then is not None:
            done.then(Outcome(command=done.command, label=done.label, result=result, tries=done.tries), t_ns)

    def _transmit(self, pending: _Pending, t_ns: int) -> None:
        confirmation = min(pending.tries, 255)
        pending.tries += 1
        pending.t_retry_ns = t_ns + TIMEOUT_NS
        self.send(
            wire.pack(
                wire.COMMAND_LONG,
                *pending.params,
                pending.command,
                self.target_system,
                wire.COMP_AUTOPILOT,
                confirmation,
            )
        )
