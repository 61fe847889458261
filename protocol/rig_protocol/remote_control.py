"""Remote control: what the server asks of one agent, one thing at a time, and what it answers.

A control is repeated until its result comes; its number tells a repeated one from a new one, so that nothing
is done twice (protocol/SPEC.md, section 4).
"""

from collections import deque
from typing import NamedTuple

from rig_protocol.messages import Control, ControlResult, ControlValue

CONTROL_RETRY_NS = (100_000_000, 1_000_000_000)
# Closing and opening a Kinect takes some seconds.
CONTROL_PATIENCE_NS = 10_000_000_000
# An operator's commands, or a calibration's: more means that nobody answers.
MAX_WAITING_CONTROLS = 16
_NEVER_NS = 2**63


class _Asked(NamedTuple):
    ticket: int
    name: str
    value: ControlValue


class ControlSender:
    """The server's end of one session. Whoever asks gives a ticket, and gets it back with the outcome.

    `due_ns` is when `messages_due` has something to say.
    """

    def __init__(self) -> None:
        self.due_ns = _NEVER_NS
        self._waiting: deque[_Asked] = deque()  # the first one is in flight
        self._number = 0  # of the one in flight
        self._begun_ns: int | None = None  # when it was first sent
        self._retry_ns = CONTROL_RETRY_NS[0]
        self._given_up: list[int] = []

    def ask(self, ticket: int, name: str, value: ControlValue, now_ns: int) -> bool:
        """Ask for something when all that was asked before is answered; False where too much waits."""
        if len(self._waiting) >= MAX_WAITING_CONTROLS:
            return False
        self._waiting.append(_Asked(ticket, name, value))
        if len(self._waiting) == 1:
            self._begin(now_ns)
        return True

    def messages_due(self, now_ns: int) -> list[Control]:
        """The control in flight where it is time to send it, for the first time or again."""
        if not self._waiting or now_ns < self.due_ns:
            return []
        if self._begun_ns is None:
            self._begun_ns = now_ns
        elif now_ns - self._begun_ns >= CONTROL_PATIENCE_NS:
            self._given_up.append(self._next(now_ns))
            return self.messages_due(now_ns)
        self.due_ns = now_ns + self._retry_ns
        self._retry_ns = min(2 * self._retry_ns, CONTROL_RETRY_NS[1])
        asked = self._waiting[0]
        return [Control(self._number, asked.name, asked.value)]

    def take_result(self, result: ControlResult, now_ns: int) -> int | None:
        """The ticket of the control in flight when the result is its own; None for any other result."""
        if not self._waiting or self._begun_ns is None or result.number != self._number:
            return None
        return self._next(now_ns)

    def given_up(self) -> list[int]:
        """Tickets for which no result has come in time; each is told once."""
        tickets, self._given_up = self._given_up, []
        return tickets

    def close(self) -> list[int]:
        """The session has ended: tickets that will have no result."""
        tickets = [*self._given_up, *(asked.ticket for asked in self._waiting)]
        self._waiting.clear()
        self.due_ns = _NEVER_NS
        return tickets

    def _begin(self, now_ns: int) -> None:
        self._number += 1
        self._begun_ns, self._retry_ns, self.due_ns = None, CONTROL_RETRY_NS[0], now_ns

    def _next(self, now_ns: int) -> int:
        """Go on to the next control; the ticket of the one that is over."""
        over = self._waiting.popleft()
        self.due_ns = _NEVER_NS
        if self._waiting:
            self._begin(now_ns)
        return over.ticket


class ControlReceiver:
    """The agent's end of one session: remembers the latest control, which is all that can be repeated."""

    def __init__(self) -> None:
        self._latest = 0
        self._result: ControlResult | None = None
        self._to_send = False

    def take(self, control: Control) -> bool:
        """True for a control that has not been here: it is to be done. The latest one is answered again."""
        if control.number > self._latest:
            self._latest, self._result, self._to_send = control.number, None, False
            return True
        if control.number == self._latest:
            self._to_send = self._result is not None
        return False

    def answer(self, result: ControlResult) -> None:
        """What became of a control; of an older one nobody wants to know any more."""
        if result.number == self._latest:
            self._result, self._to_send = result, True

    def results_to_send(self) -> list[ControlResult]:
        """The result of the latest control where it is new, or was asked for again."""
        if not self._to_send or self._result is None:
            return []
        self._to_send = False
        return [self._result]
