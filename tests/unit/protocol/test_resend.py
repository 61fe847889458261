"""Lost fragments are asked for and sent again: both ends, over a path whose losses are chosen."""

import heapq
import random
from collections import Counter
from collections.abc import Callable

import pytest

from rig_protocol.counters import CameraCounters
from rig_protocol.datagram import DatagramBatch, parse_fragment_header
from rig_protocol.fragmenter import fragment
from rig_protocol.frame_history import FrameHistory
from rig_protocol.messages import Resend
from rig_protocol.open_unit import MAX_TRIES, REORDER_NS
from rig_protocol.reassembler import GRACE_NS, Reassembler
from support.wire import make_frame, make_seal

MS = 1_000_000
INTERVAL_NS = 33_333_333
FRAGMENTS = 40
SIZE = FRAGMENTS * 1440 - 100
BURST, STEP_NS = 4, 2 * MS  # a frame takes 18 ms to leave
DELAY_NS = 500_000
SEAL = make_seal()
Lose = Callable[[int, int, int], bool]
"""Of frame number, fragment index and how often it was sent before: whether it is lost now."""


def nothing(_number: int, _index: int, _again: int) -> bool:
    return False


class Path:
    """An agent's memory, a server's reassembler, and the way between them in virtual time."""

    def __init__(
        self, lose: Lose = nothing, lose_request: Callable[[int], bool] = lambda _count: False
    ) -> None:
        self.counters = CameraCounters()
        self.requests: list[tuple[int, Resend]] = []
        self.delivered: dict[int, int] = {}  # frame number: when
        self.history = FrameHistory()
        self.jitter: Callable[[], int] = lambda: 0
        self.reassembler = Reassembler(0, 30.0, self.counters, SEAL)
        self._lose, self._lose_request = lose, lose_request
        self._sent: Counter[tuple[int, int]] = Counter()
        self._left: dict[int, int] = {}  # fragments of a frame that have left, by id of its batch
        self._things: list[tuple[int, int, Callable[[int], None]]] = []
        self._count = 0

    def stream(self, frames: int, fragments: int = FRAGMENTS) -> "Path":
        """Send frames at 30 a second, each in paced bursts."""
        for number in range(frames):
            self._at(number * INTERVAL_NS, lambda now_ns, n=number: self._begin(n, fragments, now_ns))  # type: ignore[misc]
        return self

    def run(self, until_ns: int = 10**10) -> "Path":
        """Let things happen until nothing is left to."""
        while (now_ns := min(self._next_ns(), self.reassembler.due_ns)) <= until_ns:
            while self._next_ns() <= now_ns:
                heapq.heappop(self._things)[2](now_ns)
            if self.reassembler.due_ns <= now_ns:
                for request in self.reassembler.handle_timeout(now_ns):
                    self._ask(request, now_ns)
        return self

    def _begin(self, number: int, fragments: int, now_ns: int) -> None:
        frame = make_frame(number, size=fragments * 1440 - 100)
        batch = fragment(frame, 5, number, SEAL)
        assert len(batch) == fragments
        self.history.add(number, batch)
        for start in range(0, fragments, BURST):
            stop = min(start + BURST, fragments)
            self._at(
                now_ns + start // BURST * STEP_NS, lambda at, s=start, e=stop: self._leave(batch, s, e, at)
            )  # type: ignore[misc]

    def _leave(self, batch: DatagramBatch, start: int, stop: int, now_ns: int) -> None:
        self._left[id(batch)] = stop
        self._send(DatagramBatch(batch.part(start, stop), batch.segment_size), now_ns)

    def _send(self, batch: DatagramBatch, now_ns: int) -> None:
        for datagram in batch:
            header = parse_fragment_header(datagram)
            assert header is not None
            key = (header.frame_number, header.fragment_index)
            if not self._lose(*key, self._sent[key]):
                self._at(now_ns + DELAY_NS + self.jitter(), lambda at, d=bytes(datagram): self._arrive(d, at))  # type: ignore[misc]
            self._sent[key] += 1

    def _arrive(self, datagram: bytes, now_ns: int) -> None:
        header = parse_fragment_header(datagram)
        assert header is not None
        if self.reassembler.receive(header, datagram, 1, now_ns) is not None:
            self.delivered[header.frame_number] = now_ns

    def _ask(self, request: Resend, now_ns: int) -> None:
        lost = self._lose_request(len(self.requests))
        self.requests.append((now_ns, request))
        if not lost:
            self._at(now_ns + DELAY_NS, lambda at: self._answer(request, at))

    def _answer(self, request: Resend, now_ns: int) -> None:
        batch = self.history.find(request.frame_number)
        left = 0 if batch is None else self._left.get(id(batch), 0)
        for answer in self.history.answer(request, left):
            self._send(answer, now_ns)

    def _at(self, time_ns: int, do: Callable[[int], None]) -> None:
        self._count += 1
        heapq.heappush(self._things, (time_ns, self._count, do))

    def _next_ns(self) -> int:
        return self._things[0][0] if self._things else 10**18

    def added_ns(self, number: int) -> int:
        """How much later than without any loss a frame was whole."""
        return self.delivered[number] - (number * INTERVAL_NS + (FRAGMENTS - 1) // BURST * STEP_NS + DELAY_NS)


LOSSES: dict[str, Lose] = {
    "the first": lambda _n, index, again: index == 0 and not again,
    "one in the middle": lambda _n, index, again: index == 17 and not again,
    "the last": lambda _n, index, again: index == FRAGMENTS - 1 and not again,
    "the last burst": lambda _n, index, again: index >= FRAGMENTS - BURST and not again,
    "every fifth": lambda _n, index, again: index % 5 == 2 and not again,
}


@pytest.mark.parametrize("name", LOSSES)
def test_what_is_lost_of_one_frame_comes_within_a_few_milliseconds(name: str) -> None:
    path = (
        Path(lambda number, index, again: number == 3 and LOSSES[name](number, index, again)).stream(6).run()
    )
    assert sorted(path.delivered) == list(range(6))
    assert path.added_ns(3) <= 10 * MS
    assert path.counters.lost == 0
    assert path.counters.requested == path.counters.resent > 0
    assert path.counters.duplicate == 0


def test_an_outage_of_ten_milliseconds_amid_a_frame_is_made_good_before_the_frame_ends() -> None:
    path = Path(lambda number, index, again: number == 3 and 4 <= index < 24 and not again).stream(6).run()
    assert sorted(path.delivered) == list(range(6))
    assert path.added_ns(3) <= 2 * MS
    assert path.counters.lost == 0


def test_a_frame_of_which_nothing_came_is_asked_for_when_the_next_one_begins() -> None:
    path = Path(lambda number, _index, again: number == 3 and not again).stream(6).run()
    assert sorted(path.delivered) == list(range(6))
    assert path.added_ns(3) <= INTERVAL_NS
    assert path.counters.resent == FRAGMENTS


def test_a_lost_fragment_is_asked_for_once_a_round_trip() -> None:
    path = Path(lambda number, index, again: number == 3 and index == 17 and not again).stream(6).run()
    assert len(path.requests) == 1


def test_a_gap_is_asked_for_as_soon_as_mere_overtaking_cannot_explain_it() -> None:
    path = Path(lambda number, index, again: number == 0 and index == 9 and not again).stream(1).run()
    [(asked_ns, request)] = path.requests
    arrived_ns = 10 // BURST * STEP_NS + DELAY_NS
    assert asked_ns == arrived_ns + REORDER_NS
    assert request == Resend(0, ((9, 1),))


@pytest.mark.parametrize("lost", [1, 3, 6])
def test_lost_requests_are_repeated(lost: int) -> None:
    path = Path(
        lambda number, index, again: number == 2 and index == 17 and not again, lambda count: count < lost
    )
    path.stream(4).run()
    assert sorted(path.delivered) == list(range(4))
    assert len(path.requests) == lost + 1


@pytest.mark.parametrize("lost", [1, 3, 6])
def test_lost_answers_are_asked_for_again(lost: int) -> None:
    path = Path(lambda number, index, again: number == 2 and index == 17 and again <= lost).stream(4).run()
    assert sorted(path.delivered) == list(range(4))
    assert len(path.requests) == lost + 1
    assert path.counters.resent == 1


@pytest.mark.parametrize("index", [0, 17])
def test_nobody_asks_for_ever(index: int) -> None:
    path = Path(lambda number, i, _again: number == 2 and i >= index).stream(8).run()
    assert sorted(path.delivered) == [0, 1, 3, 4, 5, 6, 7]
    assert 0 < len(path.requests) <= MAX_TRIES
    assert path.requests[-1][0] <= 3 * INTERVAL_NS + INTERVAL_NS + GRACE_NS
    path.reassembler.heard_of(8, 10**10)
    path.reassembler.close()
    assert path.counters.lost == 1


def test_nothing_is_asked_for_where_nothing_is_lost() -> None:
    path = Path().stream(60).run()
    assert (path.requests, len(path.delivered)) == ([], 60)


def test_a_little_overtaking_is_no_loss() -> None:
    path = Path()
    chaos = random.Random(3)
    path.jitter = lambda: REORDER_NS * 8 // 10 if chaos.random() < 0.05 else 0
    path.stream(60).run()
    assert (path.requests, len(path.delivered)) == ([], 60)


def test_what_has_not_been_sent_yet_is_not_sent_early() -> None:
    """A pause of the agent looks like a lost tail; the answer to the request is what has left, no more."""
    history = FrameHistory()
    batch = fragment(make_frame(0, size=SIZE), 5, 0, SEAL)
    history.add(0, batch)
    answers = history.answer(Resend(0, ((10, 30),)), sent=12)
    assert [bytes(datagram) for one in answers for datagram in one] == [bytes(batch[10]), bytes(batch[11])]
    assert history.answer(Resend(0, ((12, 28),)), sent=12) == []
    assert history.refused == 0


def test_the_last_frame_before_a_pause_is_asked_for_once_the_heartbeat_tells_of_it() -> None:
    path = Path(lambda number, _index, again: number == 5 and not again).stream(6).run()
    assert 5 not in path.delivered
    path.reassembler.heard_of(6, 10**10)
    path.run(2 * 10**10)
    assert sorted(path.delivered) == list(range(6))


def test_answers_after_the_frame_was_given_up_are_late() -> None:
    path = Path(lambda number, index, _again: number == 0 and index == 17).stream(1).run()
    assert path.counters.incomplete == 1
    batch = path.history.find(0)
    assert batch is not None
    header = parse_fragment_header(batch[17])
    assert header is not None
    assert path.reassembler.receive(header, batch[17], 1, 10**10) is None
    assert path.counters.late == 1


def test_a_fragment_that_comes_twice_because_it_was_only_slow_is_a_duplicate() -> None:
    path = Path()
    slow = iter([0] * 17 + [5 * MS] + [0] * 1000)
    path.jitter = lambda: next(slow)
    path.stream(1).run()
    assert (path.delivered.keys(), path.counters.duplicate) == ({0}, 1)


def test_random_losses_of_five_percent_cost_no_frame_and_ten_milliseconds_at_most() -> None:
    chaos = random.Random(4)
    path = Path(lambda *_: chaos.random() < 0.05, lambda _: chaos.random() < 0.05).stream(100).run()
    added = sorted(path.added_ns(number) for number in path.delivered)
    assert len(added) == 100
    assert added[98] <= 10 * MS
    assert path.counters.requested < 1.3 * 0.05 * 100 * FRAGMENTS
