import random
from collections.abc import Iterable

import pytest

from rig_protocol.counters import CameraCounters
from rig_protocol.datagram import (
    DatagramBatch,
    FragmentHeader,
    consecutive_runs,
    pack_fragment_header,
    parse_fragment_header,
)
from rig_protocol.fragmenter import fragment
from rig_protocol.frame_unit import FRAME_HEADER_SIZE, MAX_SEALED_SIZE, MAX_UNIT_SIZE, MIN_SEALED_SIZE
from rig_protocol.frames import EncodedFrame
from rig_protocol.messages import Resend
from rig_protocol.reassembler import GRACE_NS, MAX_OPEN_UNITS, NUMBER_WINDOW, Reassembler
from rig_protocol.security import TAG_SIZE
from support.wire import make_frame, make_seal

SESSION = 5
SIZE = 4000  # three fragments
# Two full fragments, so that all datagrams are equally long.
TWO_FULL = 2 * 1440 - FRAME_HEADER_SIZE - TAG_SIZE
FRAME_INTERVAL_NS = 33_333_333
SEAL = make_seal()


class Bench:
    """A reassembler and what it delivered."""

    def __init__(self) -> None:
        self.counters = CameraCounters()
        self.reassembler = make_reassembler(self.counters)
        self.delivered: list[int] = []
        self.requests: list[Resend] = []

    def feed(self, datagrams: Iterable[bytes | memoryview], now_ns: int = 0) -> "Bench":
        """Take datagrams one by one."""
        for datagram in datagrams:
            self.feed_batch(DatagramBatch(datagram, len(datagram)), now_ns)
        return self

    def feed_batch(self, batch: DatagramBatch, now_ns: int = 0) -> "Bench":
        """Take datagrams as a socket with UDP_GRO delivers them."""
        for count, run in consecutive_runs(batch):
            header = parse_fragment_header(run)
            assert header is not None
            frame = self.reassembler.receive(header, run, count, now_ns)
            if frame is not None:
                assert frame == make_frame(frame.sequence, size=SIZE)
                self.delivered.append(frame.sequence)
        return self

    def pass_time(self, now_ns: int) -> "Bench":
        """Serve the reassembler whenever it is due, until `now_ns`."""
        while self.reassembler.due_ns <= now_ns:
            self.requests += self.reassembler.handle_timeout(self.reassembler.due_ns)
        return self

    def counted(self) -> dict[str, int]:
        """Counters of frames and fragments that are not zero; requests apart."""
        names = (name for name in CameraCounters.__slots__ if getattr(self.counters, name))
        return {name: getattr(self.counters, name) for name in names if name != "requested"}


def make_reassembler(counters: CameraCounters | None = None) -> Reassembler:
    return Reassembler(0, 30.0, counters or CameraCounters(), SEAL)


def cut(number: int, size: int = SIZE) -> DatagramBatch:
    return fragment(make_frame(number, size=size), SESSION, number, SEAL)


def datagrams(number: int, size: int = SIZE) -> list[bytes]:
    return [bytes(datagram) for datagram in cut(number, size)]


def with_header(datagram: bytes, **changes: int) -> bytes:
    header = parse_fragment_header(datagram)
    assert header is not None
    return pack_fragment_header(header._replace(**changes)) + datagram[32:]


def test_a_frame_is_delivered_by_its_last_fragment() -> None:
    bench = Bench().feed(datagrams(0)[:-1])
    assert bench.delivered == []
    assert bench.feed(datagrams(0)[-1:]).delivered == [0]
    assert bench.counted() == {"fragments": 3}


@pytest.mark.parametrize("seed", range(5))
def test_fragments_may_come_in_any_order_of_interleaved_frames(seed: int) -> None:
    shuffled = [datagram for number in range(MAX_OPEN_UNITS) for datagram in datagrams(number)]
    random.Random(seed).shuffle(shuffled)
    bench = Bench().feed(shuffled)
    assert sorted(bench.delivered) == list(range(MAX_OPEN_UNITS))
    assert bench.counted() == {"fragments": 3 * MAX_OPEN_UNITS}


@pytest.mark.parametrize("together", [1, 2, 5, 44])
def test_batches_and_single_datagrams_give_the_same(together: int) -> None:
    bench = Bench()
    for number in range(10):
        batch = cut(number)
        for start in range(0, len(batch), together):
            bench.feed_batch(DatagramBatch(batch.part(start, start + together), batch.segment_size))
    assert bench.delivered == list(range(10))
    assert bench.counted() == {"fragments": 30}


def test_a_batch_may_hold_the_end_of_one_frame_and_the_start_of_the_next() -> None:
    frames = [cut(number, TWO_FULL) for number in range(3)]
    content = b"".join(bytes(batch.buffer) for batch in frames)
    reassembler, delivered = make_reassembler(), []
    for count, run in consecutive_runs(DatagramBatch(content, 1472)):
        header = parse_fragment_header(run)
        assert header is not None
        delivered.append(reassembler.receive(header, run, count, 0))
    assert delivered == [make_frame(number, size=TWO_FULL) for number in range(3)]


def test_a_fragment_held_already_is_a_duplicate_before_and_after_completion() -> None:
    first, *others = datagrams(0)
    bench = Bench().feed([first, first, *others, *others])
    assert bench.delivered == [0]
    assert bench.counted() == {"fragments": 3, "duplicate": 3}


def test_a_run_that_is_held_in_part_fills_the_rest() -> None:
    batch = cut(0)
    bench = Bench().feed([batch[1]])
    bench.feed_batch(batch)
    assert bench.delivered == [0]
    assert bench.counted() == {"fragments": 3, "duplicate": 1}


def test_the_first_copy_of_a_fragment_is_kept() -> None:
    first, *others = datagrams(0)
    bench = Bench().feed([first, first[:40] + b"other" + first[45:], *others])
    assert bench.delivered == [0]


def test_altered_content_makes_the_frame_corrupt_not_wrong() -> None:
    first, *others = datagrams(0)
    bench = Bench().feed([first[:40] + b"x" + first[41:], *others])
    assert bench.delivered == []
    assert bench.counted() == {"fragments": 3, "corrupt": 1}


@pytest.mark.parametrize(
    "changes",
    [{"frame_number": 4}, {"seal": 77}, {"unit_size": 4047}, {"payload_size": 1439}],
    ids=lambda changes: next(iter(changes)),
)
def test_a_bit_error_in_a_header_does_not_spoil_the_true_frame(changes: dict[str, int]) -> None:
    bench = Bench()
    bench.feed([with_header(datagrams(0)[0], **changes)])
    bench.feed(datagrams(0))
    assert bench.delivered == [0]
    bench.pass_time(10**12)
    assert bench.feed(datagrams(4)).delivered == [0, 4]


def test_an_incomplete_frame_expires_after_its_interval_and_the_grace() -> None:
    bench = Bench().feed(datagrams(0)[:2], now_ns=1000)
    due_ns = 1000 + FRAME_INTERVAL_NS + GRACE_NS
    bench.pass_time(due_ns - 1)
    assert "incomplete" not in bench.counted()
    bench.pass_time(due_ns)
    assert bench.counted() == {"fragments": 2, "incomplete": 1}
    assert bench.reassembler.due_ns > 10**18


def test_fragments_of_an_expired_frame_are_late() -> None:
    bench = Bench().feed(datagrams(0)[:2]).pass_time(10**12)
    bench.feed(datagrams(0)[2:])
    assert bench.counted() == {"fragments": 2, "incomplete": 1, "late": 1}


def test_one_open_frame_too_many_drops_the_oldest() -> None:
    bench = Bench()
    for number in range(MAX_OPEN_UNITS + 1):
        bench.feed(datagrams(number)[:2])
    assert bench.counters.evicted == 1
    for number in range(MAX_OPEN_UNITS + 1):
        bench.feed(datagrams(number)[2:])
    assert bench.delivered == list(range(1, MAX_OPEN_UNITS + 1))
    assert bench.counters.late == 1


def test_numbers_below_the_window_are_late() -> None:
    bench = Bench().feed(datagrams(NUMBER_WINDOW)).feed(datagrams(0)).feed(datagrams(1))
    assert bench.delivered == [NUMBER_WINDOW, 1]
    assert bench.counters.late == 3


def test_a_number_that_left_the_window_unseen_is_missing() -> None:
    bench = Bench()
    for number in range(100):
        if number not in (10, 11, 50):
            bench.feed(datagrams(number))
    assert bench.counters.missing == 3
    assert bench.counters.lost == 3


def test_a_lost_frame_is_counted_once_whatever_the_cause() -> None:
    bench = Bench()
    for number in range(100):
        whole = datagrams(number)
        broken = {10: whole[:1], 11: [], 12: [whole[0][:-1] + b"?", *whole[1:]]}
        bench.feed(broken.get(number, whole), now_ns=number * FRAME_INTERVAL_NS)
        bench.pass_time(number * FRAME_INTERVAL_NS)
    assert len(bench.delivered) == 97
    assert (bench.counters.incomplete, bench.counters.missing, bench.counters.corrupt) == (1, 1, 1)


def test_at_the_end_of_a_session_what_is_open_or_was_skipped_is_counted_as_lost() -> None:
    bench = Bench().feed(datagrams(0)).feed(datagrams(5)).feed(datagrams(3)[:1]).feed(datagrams(6)[:2])
    bench.reassembler.close()
    assert (bench.counters.incomplete, bench.counters.missing) == (2, 3)


@pytest.mark.parametrize("whole", [[], [0, 1, 2], [0, 2, 6]])
def test_at_the_end_of_a_session_missing_is_exactly_what_the_agent_says_it_sent(whole: list[int]) -> None:
    bench = Bench()
    for number in whole:
        bench.feed(datagrams(number))
    bench.reassembler.heard_of(7, 0)
    bench.reassembler.close()
    assert (bench.counters.missing, bench.counters.lost) == (7 - len(whole), 7 - len(whole))


def test_a_session_without_frames_ends_without_loss() -> None:
    bench = Bench()
    bench.reassembler.heard_of(0, 0)
    bench.reassembler.close()
    assert bench.counted() == {}


def test_only_a_verified_frame_moves_the_window() -> None:
    far_ahead = with_header(datagrams(0)[0], frame_number=2**60)
    bench = Bench().feed([far_ahead]).feed(datagrams(0))
    assert bench.delivered == [0]


@pytest.mark.parametrize(
    ("changes", "cause"),
    [
        ({"unit_size": MAX_SEALED_SIZE + 1}, "oversized"),
        ({"unit_size": 2**32 - 1}, "oversized"),
        ({"unit_size": MIN_SEALED_SIZE - 1}, "bad_fragment"),
        ({"payload_size": 1}, "bad_fragment"),
        ({"payload_size": 1000}, "bad_fragment"),
        ({"payload_size": 1441}, "bad_fragment"),
        ({"fragment_index": 3}, "bad_fragment"),
        ({"fragment_index": 65535}, "bad_fragment"),
        ({"fragment_index": 2}, "bad_fragment"),
    ],
    ids=str,
)
def test_a_fragment_that_does_not_fit_its_unit_is_dropped(changes: dict[str, int], cause: str) -> None:
    bench = Bench().feed([with_header(datagrams(0)[0], **changes)])
    assert bench.counted() == {cause: 1}
    assert bench.reassembler.due_ns > 10**18


@pytest.mark.parametrize("index", [0, 2])
def test_a_truncated_or_extended_fragment_is_dropped(index: int) -> None:
    datagram = datagrams(0)[index]
    bench = Bench().feed([datagram[:-1], datagram + b"x"])
    assert bench.counted() == {"bad_fragment": 2}


def test_a_unit_of_fewer_bytes_than_a_seal_and_a_header_is_dropped() -> None:
    header = parse_fragment_header(datagrams(0)[0])
    assert header is not None
    size = MIN_SEALED_SIZE - 1
    bench = Bench().feed([pack_fragment_header(header._replace(unit_size=size)) + bytes(size)])
    assert bench.counted() == {"bad_fragment": 1}


def test_a_run_past_the_end_of_its_unit_delivers_what_fits() -> None:
    frame = cut(0, TWO_FULL)
    beyond = [with_header(bytes(frame[1]), fragment_index=index) for index in (2, 3)]
    header = parse_fragment_header(frame[0])
    assert header is not None
    counters = CameraCounters()
    run = bytes(frame.buffer) + b"".join(beyond)
    assert make_reassembler(counters).receive(header, run, 4, 0) == make_frame(0, size=TWO_FULL)
    assert (counters.fragments, counters.bad_fragment + counters.duplicate) == (2, 2)


def test_a_run_whose_index_wraps_is_dropped() -> None:
    header = FragmentHeader(1, SESSION, 0, 4000, 1440, 65535)
    run = b"".join(pack_fragment_header(header._replace(fragment_index=i)) + bytes(1440) for i in (65535, 0))
    counters = CameraCounters()
    assert make_reassembler(counters).receive(header, run, 2, 0) is None
    assert (counters.bad_fragment, counters.fragments) == (1, 1)


def hostile(number: int, seal: int = 1, **changes: int) -> bytes:
    return with_header(datagrams(0)[0], frame_number=number, seal=seal, **changes)


def test_what_hostile_headers_make_it_hold_is_bounded() -> None:
    bench = Bench()
    chaos = random.Random(1)
    for k in range(3000):
        number = chaos.choice([chaos.getrandbits(64), chaos.randrange(100)])
        bench.feed([hostile(number, chaos.getrandbits(32))], now_ns=k * 10_000).pass_time(k * 10_000)
    reassembler = bench.reassembler
    assert len(reassembler._open) == MAX_OPEN_UNITS
    assert len(reassembler._lost_keys) <= 64
    assert len(reassembler._given_up) <= 1024
    assert len(reassembler._unseen) <= 4 * NUMBER_WINDOW


def test_memory_of_units_of_the_most_fragments_is_bounded_and_so_is_what_is_asked_for() -> None:
    """65,536 fragments of 32 bytes, of which every second one came: the costliest gaps to ask for."""
    bench = Bench()
    header = FragmentHeader(7, SESSION, 0, MAX_UNIT_SIZE, 32, 0)
    for number in range(MAX_OPEN_UNITS + 2):
        for index in range(1, 1200, 2):
            one = header._replace(frame_number=number, fragment_index=index)
            bench.feed([pack_fragment_header(one) + bytes(32)], now_ns=number)
    requests = bench.reassembler.handle_timeout(5_000_000)
    assert all(len(request.ranges) <= 250 for request in requests)
    held = [len(unit.content) for unit in bench.reassembler._open.values()]
    assert sum(held) <= MAX_OPEN_UNITS * MAX_SEALED_SIZE
    bench.pass_time(10**12)
    assert bench.reassembler._open == {}
    assert sum(map(len, bench.reassembler._spare)) <= 2 * MAX_SEALED_SIZE


def test_no_flood_of_forged_headers_makes_a_delivered_frame_come_again() -> None:
    bench = Bench().feed(datagrams(0)).feed(datagrams(1))
    for k in range(1100):
        bench.feed([hostile(2**60 + k)]).feed([hostile(5, seal=k)])
    bench.feed(datagrams(1)).feed(datagrams(0))
    assert bench.delivered == [0, 1]
    assert bench.counters.duplicate == 6


@pytest.mark.parametrize("size", [MAX_UNIT_SIZE - FRAME_HEADER_SIZE, 0])
def test_a_frame_of_two_megabytes_passes_and_an_empty_one_too(size: int) -> None:
    frame: EncodedFrame | None = None
    reassembler = make_reassembler()
    for count, run in consecutive_runs(cut(0, size)):
        header = parse_fragment_header(run)
        assert header is not None
        frame = reassembler.receive(header, run, count, 0)
    assert frame == make_frame(0, size=size)


def test_forged_numbers_ahead_neither_grow_tables_nor_move_what_is_believed() -> None:
    """A fragment 31 numbers ahead, over and over: only what is authentic moves the window."""
    bench = Bench()
    fragment_0 = datagrams(0)[0]
    for k in range(1, 2000):
        forged = with_header(fragment_0, frame_number=31 * k, seal=k)
        bench.feed([forged], k)
        bench.reassembler.handle_timeout(k)
    assert len(bench.reassembler._unseen) <= NUMBER_WINDOW
    assert bench.reassembler._next_number <= NUMBER_WINDOW
    assert bench.feed(datagrams(0), 2000).delivered == [0]


@pytest.mark.parametrize("payload_size", [1, 100, 1167])
def test_fragments_smaller_than_any_sender_cuts_open_no_unit(payload_size: int) -> None:
    bench = Bench()
    header = FragmentHeader(1, SESSION, 0, 65_536, payload_size, 0)
    bench.feed([pack_fragment_header(header) + bytes(payload_size)])
    assert bench.counted() == {"bad_fragment": 1}
    assert not bench.reassembler._open
