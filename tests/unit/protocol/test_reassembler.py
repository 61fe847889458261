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
from rig_protocol.frame_unit import MAX_UNIT_SIZE
from rig_protocol.frames import EncodedFrame
from rig_protocol.reassembler import GRACE_NS, MAX_OPEN_UNITS, NUMBER_WINDOW, Reassembler
from support.wire import make_frame

SESSION = 5
SIZE = 4000  # three fragments
FRAME_INTERVAL_NS = 33_333_333


class Bench:
    """A reassembler and what it delivered."""

    def __init__(self) -> None:
        self.counters = CameraCounters()
        self.reassembler = Reassembler(0, 30.0, self.counters)
        self.delivered: list[int] = []

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

    def counted(self) -> dict[str, int]:
        """Counters that are not zero."""
        names = (name for name in CameraCounters.__slots__ if getattr(self.counters, name))
        return {name: getattr(self.counters, name) for name in names}


def datagrams(number: int, size: int = SIZE) -> list[bytes]:
    return [bytes(datagram) for datagram in fragment(make_frame(number, size=size), SESSION)]


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
        batch = fragment(make_frame(number, size=SIZE), SESSION)
        for start in range(0, len(batch), together):
            bench.feed_batch(DatagramBatch(batch.part(start, start + together), batch.segment_size))
    assert bench.delivered == list(range(10))
    assert bench.counted() == {"fragments": 30}


def test_a_batch_may_hold_the_end_of_one_frame_and_the_start_of_the_next() -> None:
    # 1408 + 1440 bytes: two full fragments a frame, so that all datagrams are equally long.
    frames = [fragment(make_frame(number, size=2848), SESSION) for number in range(3)]
    content = b"".join(bytes(batch.buffer) for batch in frames)
    counters = CameraCounters()
    reassembler, delivered = Reassembler(0, 30.0, counters), []
    for count, run in consecutive_runs(DatagramBatch(content, 1472)):
        header = parse_fragment_header(run)
        assert header is not None
        delivered.append(reassembler.receive(header, run, count, 0))
    assert delivered == [make_frame(number, size=2848) for number in range(3)]


def test_a_fragment_held_already_is_a_duplicate_before_and_after_completion() -> None:
    first, *others = datagrams(0)
    bench = Bench().feed([first, first, *others, *others])
    assert bench.delivered == [0]
    assert bench.counted() == {"fragments": 3, "duplicate": 3}


def test_a_run_that_is_held_in_part_fills_the_rest() -> None:
    batch = fragment(make_frame(0, size=SIZE), SESSION)
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
    [{"frame_number": 4}, {"frame_crc": 77}, {"unit_size": 4031}, {"payload_size": 1439}],
    ids=lambda changes: next(iter(changes)),
)
def test_a_bit_error_in_a_header_does_not_spoil_the_true_frame(changes: dict[str, int]) -> None:
    bench = Bench()
    bench.feed([with_header(datagrams(0)[0], **changes)])
    bench.feed(datagrams(0))
    assert bench.delivered == [0]
    bench.reassembler.expire(10**12)
    assert bench.feed(datagrams(4)).delivered == [0, 4]


def test_an_incomplete_frame_expires_after_its_interval_and_the_grace() -> None:
    bench = Bench().feed(datagrams(0)[:2], now_ns=1000)
    due_ns = bench.reassembler.next_deadline_ns
    assert due_ns == 1000 + FRAME_INTERVAL_NS + GRACE_NS
    bench.reassembler.expire(due_ns - 1)
    assert "incomplete" not in bench.counted()
    bench.reassembler.expire(due_ns)
    assert bench.counted() == {"fragments": 2, "incomplete": 1}
    assert bench.reassembler.next_deadline_ns is None


def test_fragments_of_an_expired_frame_are_late() -> None:
    bench = Bench().feed(datagrams(0)[:2])
    bench.reassembler.expire(10**12)
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
        bench.reassembler.expire(number * FRAME_INTERVAL_NS)
    assert len(bench.delivered) == 97
    assert (bench.counters.incomplete, bench.counters.missing, bench.counters.corrupt) == (1, 1, 1)


def test_at_the_end_of_a_session_what_is_open_or_was_skipped_is_counted_as_lost() -> None:
    bench = Bench().feed(datagrams(0)).feed(datagrams(5)).feed(datagrams(3)[:1]).feed(datagrams(6)[:2])
    bench.reassembler.close()
    assert (bench.counters.incomplete, bench.counters.missing) == (2, 3)


def test_a_session_without_frames_ends_without_loss() -> None:
    bench = Bench()
    bench.reassembler.close()
    assert bench.counted() == {}


def test_only_a_verified_frame_moves_the_window() -> None:
    far_ahead = with_header(datagrams(0)[0], frame_number=2**60)
    bench = Bench().feed([far_ahead]).feed(datagrams(0))
    assert bench.delivered == [0]


@pytest.mark.parametrize(
    ("changes", "cause"),
    [
        ({"unit_size": MAX_UNIT_SIZE + 1}, "oversized"),
        ({"unit_size": 2**32 - 1}, "oversized"),
        ({"unit_size": 31}, "bad_fragment"),
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
    assert bench.reassembler.next_deadline_ns is None


@pytest.mark.parametrize("index", [0, 2])
def test_a_truncated_or_extended_fragment_is_dropped(index: int) -> None:
    datagram = datagrams(0)[index]
    bench = Bench().feed([datagram[:-1], datagram + b"x"])
    assert bench.counted() == {"bad_fragment": 2}


def test_a_run_past_the_end_of_its_unit_delivers_what_fits() -> None:
    frame = fragment(make_frame(0, size=2848), SESSION)  # two full fragments
    beyond = [with_header(bytes(frame[1]), fragment_index=index) for index in (2, 3)]
    header = parse_fragment_header(frame[0])
    assert header is not None
    counters = CameraCounters()
    run = bytes(frame.buffer) + b"".join(beyond)
    assert Reassembler(0, 30.0, counters).receive(header, run, 4, 0) == make_frame(0, size=2848)
    assert (counters.fragments, counters.bad_fragment + counters.duplicate) == (2, 2)


def test_a_run_whose_index_wraps_is_dropped() -> None:
    header = FragmentHeader(1, SESSION, 0, 4000, 1440, 65535)
    run = b"".join(pack_fragment_header(header._replace(fragment_index=i)) + bytes(1440) for i in (65535, 0))
    counters = CameraCounters()
    assert Reassembler(0, 30.0, counters).receive(header, run, 2, 0) is None
    assert (counters.bad_fragment, counters.fragments) == (1, 1)


def test_what_hostile_headers_make_it_hold_is_bounded() -> None:
    bench = Bench()
    chaos = random.Random(1)
    template = datagrams(0)[0]
    for _ in range(3000):
        bench.feed(
            [with_header(template, frame_number=chaos.getrandbits(64), frame_crc=chaos.getrandbits(32))]
        )
    reassembler = bench.reassembler
    assert len(reassembler._open) == MAX_OPEN_UNITS
    assert len(reassembler._lost_keys) <= 64
    assert len(reassembler._fates) <= 1024


def test_a_frame_of_two_megabytes_passes_and_an_empty_one_too() -> None:
    for size in (MAX_UNIT_SIZE - 32, 0):
        frame: EncodedFrame | None = None
        reassembler = Reassembler(0, 30.0, CameraCounters())
        for count, run in consecutive_runs(fragment(make_frame(0, size=size), SESSION)):
            header = parse_fragment_header(run)
            assert header is not None
            frame = reassembler.receive(header, run, count, 0)
        assert frame == make_frame(0, size=size)
