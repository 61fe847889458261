"""Sealed messages: accepted once, whole, in their own direction and session."""

import pytest

from rig_protocol.datagram import MessageType
from rig_protocol.sealed_channel import SEALED_OVERHEAD, ReplayWindow, SealedChannel
from rig_protocol.security import Cipher

ONE, OTHER = bytes(range(32)), bytes(range(32, 64))


def ends(
    cipher: Cipher = Cipher.CHACHA20_POLY1305, session_id: int = 5
) -> tuple[SealedChannel, SealedChannel]:
    return SealedChannel(cipher, ONE, OTHER, session_id), SealedChannel(cipher, OTHER, ONE, session_id)


@pytest.mark.parametrize("cipher", Cipher)
def test_a_message_is_read_by_the_other_end_only(cipher: Cipher) -> None:
    agent, server = ends(cipher)
    datagram = agent.seal(MessageType.GOODBYE, b"the agent stops")
    assert len(datagram) == SEALED_OVERHEAD + 15
    assert b"agent" not in datagram
    assert agent.open(datagram) == "bad_seal"  # reflected
    assert server.open(datagram) == b"the agent stops"


def test_a_message_is_accepted_once() -> None:
    agent, server = ends()
    datagram = agent.seal(MessageType.HEARTBEAT, b"x")
    assert [server.open(datagram) for _ in range(3)] == [b"x", "replayed", "replayed"]


def test_messages_that_overtook_each_other_are_accepted_and_too_old_ones_are_not() -> None:
    agent, server = ends()
    datagrams = [agent.seal(MessageType.HEARTBEAT, bytes([k])) for k in range(100)]
    assert server.open(datagrams[80]) == bytes([80])
    assert server.open(datagrams[17]) == bytes([17])
    assert server.open(datagrams[16]) == "replayed"  # 64 behind: nobody remembers
    assert server.open(datagrams[99]) == bytes([99])
    assert server.open(datagrams[35]) == "replayed"
    assert server.open(datagrams[36]) == bytes([36])


def test_a_forged_counter_does_not_move_the_window() -> None:
    agent, server = ends()
    first = agent.seal(MessageType.HEARTBEAT, b"x")
    assert server.open(first[:16] + b"\xff" * 8 + first[24:]) == "bad_seal"
    assert server.open(first) == b"x"


def test_a_message_of_another_session_or_type_is_not_accepted_even_under_the_same_keys() -> None:
    agent, _ = ends(session_id=5)
    _, server = ends(session_id=6)
    datagram = agent.seal(MessageType.HEARTBEAT, b"x")
    assert server.open(datagram[:8] + b"\x06" + datagram[9:]) == "bad_seal"
    assert server.open(datagram[:3] + bytes([MessageType.GOODBYE]) + datagram[4:]) == "bad_seal"


@pytest.mark.parametrize("size", range(SEALED_OVERHEAD))
def test_a_datagram_too_short_for_a_seal_is_malformed(size: int) -> None:
    assert ends()[1].open(bytes(size)) == "malformed"


def test_an_empty_body_is_a_message() -> None:
    agent, server = ends()
    assert server.open(agent.seal(MessageType.HEARTBEAT, b"")) == b""


def test_the_same_text_is_never_sealed_to_the_same_bytes() -> None:
    agent, _ = ends()
    assert len({agent.seal(MessageType.HEARTBEAT, b"x" * 20)[24:] for _ in range(50)}) == 50


def test_a_window_remembers_the_latest_counters() -> None:
    window = ReplayWindow()
    for counter in (0, 3, 2):
        assert window.is_fresh(counter)
        window.accept(counter)
    assert [window.is_fresh(counter) for counter in range(5)] == [False, True, False, False, True]
    window.accept(1000)
    assert [window.is_fresh(counter) for counter in (1, 936, 937, 1000, 1001)] == [
        *(False, False, True, False, True),
    ]
