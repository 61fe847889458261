"""A unit that still lacks fragments: what has come of it, and when to ask for the rest.

Fragments leave the agent in ascending order. So one is missed as soon as a later one is here, the tail
when nothing has come for longer than the agent's pace explains, or when the next frame has begun.
"""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from rig_protocol.datagram import FragmentHeader
from rig_protocol.smoothed_delay import SmoothedDelay

# Datagrams that only overtook each other are not worth a request.
REORDER_NS = 1_000_000
# A fragment asked for so often will not come: the agent has it no more, or the way is blocked.
MAX_TRIES = 12
# From here on the wait for an answer doubles: repeated losses are congestion, not chance.
_PATIENT_TRIES = 4
_NEVER_NS = np.iinfo(np.int64).max
_MAX_COUNT = 0xFFFF  # of a range on the wire


class OpenUnit:
    """Buffer and book-keeping of one unit; nothing but the buffer is allocated until something is missed."""

    __slots__ = ("_ask_ns", "_asked_ns", "_tries", "content", "deadline_ns", "due_ns", "edge", "last_ns",
                 "missing", "received", "total", "wholly_resent")  # fmt: skip

    def __init__(self, header: FragmentHeader, content: bytearray, deadline_ns: int, now_ns: int) -> None:
        self.content = content
        self.deadline_ns = deadline_ns
        self.total = self.missing = header.fragment_count
        self.received = bytearray(self.total)  # one byte a fragment, 1 = held
        self.edge = 0  # fragments from here on are not missed yet
        self.last_ns = now_ns
        self.due_ns = _NEVER_NS  # when `ask` has something to do
        self.wholly_resent = False  # nothing of it came before it was asked for
        self._ask_ns: npt.NDArray[np.int64] | None = None  # when to ask for each fragment (again)
        self._asked_ns = self._tries = np.zeros(0, np.int64)

    def take(self, start: int, stop: int, now_ns: int, answers: SmoothedDelay) -> int:
        """Note fragments [start, stop), none of them held before; how many of them had been asked for."""
        self.received[start:stop] = b"\x01" * (stop - start)
        self.missing -= stop - start
        self.last_ns = now_ns
        asked = 0 if self._ask_ns is None else self._note_answers(start, stop, now_ns, answers)
        if start > self.edge:
            self._miss(start, now_ns + REORDER_NS)
        self.edge = max(self.edge, stop)
        return stop - start if self.wholly_resent else asked

    def miss_tail(self, ask_ns: int) -> None:
        """All that has not come is missed: ask for it from `ask_ns` on."""
        self._miss(self.total, ask_ns)

    def ask(
        self, now_ns: int, tail_ns: int, answers: SmoothedDelay, afford: Callable[[int], int]
    ) -> list[tuple[int, int]]:
        """What to ask for now, as (first, count); `tail_ns` without a fragment is a missed tail.

        `afford` grants so many of a number of fragments; the others are asked for later.
        """
        if self.edge < self.total and now_ns - self.last_ns >= tail_ns:
            self.miss_tail(now_ns)
        wanted = np.zeros(0, np.int64)
        if self._ask_ns is not None:
            lacking = np.flatnonzero(np.frombuffer(self.received, np.uint8)[: self.edge] == 0)
            due = lacking[self._ask_ns[lacking] <= now_ns]
            wanted, refused = np.split(due, [afford(due.size) if due.size else 0])
            self._ask_ns[refused] = now_ns + answers.bound_ns
            self._asked_ns[wanted] = now_ns
            self._tries[wanted] += 1
            self._ask_ns[wanted] = now_ns + _waits_ns(self._tries[wanted], answers.bound_ns)
        self.schedule(tail_ns)
        return _ranges(wanted)

    def schedule(self, tail_ns: int) -> None:
        """Set `due_ns` by what is missed and by the tail that may be."""
        self.due_ns = self.last_ns + tail_ns if self.edge < self.total else _NEVER_NS
        if self._ask_ns is not None:
            lacking = np.frombuffer(self.received, np.uint8)[: self.edge] == 0
            waits = self._ask_ns[: self.edge][lacking]
            if waits.size:
                self.due_ns = min(self.due_ns, int(waits.min()))

    def _miss(self, stop: int, ask_ns: int) -> None:
        if self._ask_ns is None:
            self._ask_ns = np.full(self.total, _NEVER_NS)
            self._asked_ns = np.zeros(self.total, np.int64)
            self._tries = np.zeros(self.total, np.int64)
        self._ask_ns[self.edge : stop] = ask_ns
        self.edge = max(self.edge, stop)
        self.due_ns = min(self.due_ns, ask_ns)

    def _note_answers(self, start: int, stop: int, now_ns: int, answers: SmoothedDelay) -> int:
        tries = self._tries[start:stop]
        asked = int(np.count_nonzero(tries))
        if asked and tries[0] == 1:  # asked twice, nobody knows which request was answered (Karn)
            answers.add(now_ns - int(self._asked_ns[start]))
        return asked


def _waits_ns(tries: npt.NDArray[np.int64], answer_ns: int) -> npt.NDArray[np.int64]:
    """How long to wait for an answer to the tries-th request."""
    waits = answer_ns << np.clip(tries - _PATIENT_TRIES, 0, 4)
    return np.where(tries < MAX_TRIES, waits, _NEVER_NS // 2)


def _ranges(indices: npt.NDArray[np.int64]) -> list[tuple[int, int]]:
    """Ascending indices as runs (first, count)."""
    if not indices.size:
        return []
    starts = np.flatnonzero(np.diff(indices, prepend=-2) != 1)
    counts = np.diff(starts, append=indices.size)
    return [
        (int(indices[start]), min(int(count), _MAX_COUNT))
        for start, count in zip(starts, counts, strict=True)
    ]
