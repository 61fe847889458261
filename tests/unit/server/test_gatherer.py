"""Gathering changes neither the order nor the borders of any sender's datagrams."""

from collections import defaultdict

from hypothesis import given
from hypothesis import strategies as st

from rig_protocol.datagram import DatagramBatch
from rig_server.gatherer import Gatherer

SENDERS = [("10.0.0.1", 1), ("10.0.0.2", 2)]


def test_waiting_datagrams_of_one_sender_become_one_batch() -> None:
    gatherer = Gatherer()
    for k in range(6):
        assert list(gatherer.add(memoryview(bytes([k]) * 1472), SENDERS[k % 2])) == []
    batches = {sender: bytes(batch.buffer)[::1472] for batch, sender in gatherer.flush_all()}
    assert batches == {SENDERS[0]: bytes([0, 2, 4]), SENDERS[1]: bytes([1, 3, 5])}
    assert list(gatherer.flush_all()) == []


def test_a_short_datagram_is_delivered_at_once_after_what_the_sender_sent_before() -> None:
    gatherer = Gatherer()
    assert list(gatherer.add(memoryview(b"a" * 1472), SENDERS[0])) == []
    sizes = [len(batch.buffer) for batch in gatherer.add(memoryview(b"b" * 40), SENDERS[0])]
    assert sizes == [1472, 40]


steps = st.lists(
    st.tuples(
        st.sampled_from(SENDERS),
        st.sampled_from([1, 40, 1199, 1200, 1472, 8972, 65_000]),
        st.sampled_from(["add", "add", "add", "flush", "flush all"]),
    ),
    max_size=150,
)


@given(steps)
def test_every_senders_datagrams_come_out_whole_and_in_order(
    taken: list[tuple[tuple[str, int], int, str]],
) -> None:
    gatherer = Gatherer()
    sent, received = defaultdict(list), defaultdict(list)

    def deliver(batch: DatagramBatch, sender: tuple[str, int]) -> None:
        received[sender] += [bytes(datagram) for datagram in batch]

    for k, (sender, size, action) in enumerate(taken):
        if action == "add":
            datagram = k.to_bytes(2, "big") * (size // 2) + b"." * (size % 2)
            sent[sender].append(datagram)
            for batch in gatherer.add(memoryview(datagram), sender):
                deliver(batch, sender)
        elif action == "flush":
            for batch in gatherer.flush(sender):
                deliver(batch, sender)
        else:
            for batch, each in gatherer.flush_all():
                deliver(batch, each)
    for batch, each in gatherer.flush_all():
        deliver(batch, each)
    assert received == sent
