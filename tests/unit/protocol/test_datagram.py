import random

import numpy as np
import pytest

from rig_protocol import datagram
from rig_protocol.datagram import DatagramBatch, FragmentHeader, consecutive_runs
from rig_protocol.errors import LinkUsageError

HEADER = FragmentHeader(
    seal=0x11223344,
    session_id=0x0102030405060708,
    frame_number=0x0A,
    unit_size=0x00030405,
    payload_size=1440,
    fragment_index=7,
)
# The byte table of SPEC section 3, written out by hand.
HEADER_BYTES = bytes.fromhex(
    "4b52 02 10 44332211 0807060504030201 0a00000000000000 05040300 a005 0700".replace(" ", "")
)


def batch_of(headers: list[FragmentHeader], size: int = 64, tail: bytes = b"") -> DatagramBatch:
    content = b"".join(datagram.pack_fragment_header(header).ljust(size, b"p") for header in headers)
    return DatagramBatch(content + tail, size)


def following(count: int, first: FragmentHeader = HEADER) -> list[FragmentHeader]:
    return [first._replace(fragment_index=first.fragment_index + k) for k in range(count)]


def test_fragment_header_byte_layout() -> None:
    assert datagram.pack_fragment_header(HEADER) == HEADER_BYTES
    assert datagram.parse_fragment_header(HEADER_BYTES + b"x") == HEADER


def test_the_structured_dtype_has_the_layout_of_the_header() -> None:
    record = np.frombuffer(HEADER_BYTES, datagram.FRAGMENT_HEADER)[0]
    assert (record["magic"], record["version"], record["type"]) == (b"KR", 2, 16)
    assert [int(record[name]) for name in HEADER._fields] == list(HEADER)


def test_headers_of_a_whole_frame_are_written_at_once() -> None:
    rows = np.zeros((3, 40), dtype=np.uint8)
    datagram.write_fragment_headers(HEADER, rows)
    assert [datagram.parse_fragment_header(row.tobytes()) for row in rows] == following(3)
    assert not rows[:, 32:].any()


def test_a_datagram_without_payload_or_with_size_zero_has_no_header() -> None:
    assert datagram.parse_fragment_header(HEADER_BYTES) is None
    for field in ("payload_size", "unit_size"):
        broken = datagram.pack_fragment_header(HEADER._replace(**{field: 0}))
        assert datagram.parse_fragment_header(broken + b"x") is None


def test_a_prefix_needs_sixteen_bytes() -> None:
    assert datagram.parse_prefix(HEADER_BYTES[:15]) is None
    assert datagram.parse_prefix(HEADER_BYTES[:16]) == (b"KR", 2, 16, 0x11223344, HEADER.session_id)


def test_a_batch_is_datagrams_of_one_size_and_a_shorter_last_one() -> None:
    batch = DatagramBatch(bytes(range(10)), 4)
    assert len(batch) == 3
    assert batch.total_bytes == 10
    assert [bytes(part) for part in batch] == [bytes(range(4)), bytes(range(4, 8)), bytes(range(8, 10))]
    assert bytes(batch.part(1, 3)) == bytes(range(4, 10))
    with pytest.raises(IndexError):
        batch[3]


def test_a_batch_without_a_segment_size_is_misuse() -> None:
    with pytest.raises(LinkUsageError, match="positive"):
        DatagramBatch(b"", 0)


def test_fragments_that_follow_each_other_are_one_run() -> None:
    batch = batch_of(following(44))
    [(count, run)] = consecutive_runs(batch)
    assert (count, bytes(run)) == (44, batch.buffer)


@pytest.mark.parametrize("field", FragmentHeader._fields[:-1])
def test_a_run_ends_where_anything_but_the_index_changes(field: str) -> None:
    first, second = following(2), following(2, HEADER._replace(fragment_index=9))
    changed = [header._replace(**{field: 99}) for header in second]
    assert [count for count, _ in consecutive_runs(batch_of(first + changed))] == [2, 2]


def test_a_run_ends_at_a_gap_a_repetition_and_a_step_back() -> None:
    indices = [0, 1, 3, 4, 4, 5, 2]
    batch = batch_of([HEADER._replace(fragment_index=index) for index in indices])
    assert [count for count, _ in consecutive_runs(batch)] == [2, 2, 2, 1]


def test_the_shorter_last_datagram_is_a_run_of_its_own() -> None:
    tail = datagram.pack_fragment_header(following(6)[-1]) + b"end"
    runs = list(consecutive_runs(batch_of(following(5), tail=tail)))
    assert [count for count, _ in runs] == [5, 1]
    assert bytes(runs[1][1]) == tail


@pytest.mark.parametrize("size", [1, 15, 16, 31, 32, 33, 1472])
def test_the_runs_of_any_batch_are_its_bytes_in_order(size: int) -> None:
    content = random.Random(size).randbytes(5 * size + size // 2)
    runs = list(consecutive_runs(DatagramBatch(content, size)))
    assert b"".join(bytes(run) for _, run in runs) == content
    assert sum(count for count, _ in runs) == len(DatagramBatch(content, size))


@pytest.mark.parametrize("count", range(1, 40))
def test_a_run_is_found_whether_datagrams_are_few_or_many(count: int) -> None:
    assert [run for run, _ in consecutive_runs(batch_of(following(count)))] == [count]


def test_an_empty_batch_has_no_runs() -> None:
    assert list(consecutive_runs(DatagramBatch(b"", 10))) == []
