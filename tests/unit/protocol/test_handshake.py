"""How two ends that hold the same key agree on a session, and what anybody else gets out of it."""

from typing import Any

import pytest

from rig_protocol.clear_datagram import clear_crc
from rig_protocol.datagram import MessageType
from rig_protocol.errors import DataError, LinkUsageError
from rig_protocol.handshake import AgentHandshake, NotAuthentic, answer_hello, fresh_id, open_hello
from rig_protocol.message_bytes import MIN_HELLO_SIZE, decode_hello
from rig_protocol.rig_key import RigKey
from rig_protocol.security import EphemeralKey, SessionKeys
from support.peers import WELCOME, id_of
from support.wire import KEY, make_hello, random_bytes

WRONG = RigKey(bytes(32))


def say_hello(seed: int = 1, rig_key: RigKey = KEY, **changes: Any) -> AgentHandshake:
    return AgentHandshake(make_hello(**changes), rig_key, random_bytes(seed))


def answer(agent: AgentHandshake, seed: int = 2, rig_key: RigKey = KEY) -> tuple[bytes, SessionKeys]:
    datagram, agreement = answer_hello(agent.datagram, agent.nonce, WELCOME, rig_key, random_bytes(seed))
    return datagram, agreement.keys


def with_crc(datagram: bytearray) -> bytes:
    """What stands behind the crc is to be reached."""
    datagram[4:8] = clear_crc(datagram).to_bytes(4, "little")
    return bytes(datagram)


def test_both_ends_hold_the_same_secrets_and_four_different_ones() -> None:
    agent = say_hello()
    datagram, keys = answer(agent)
    agreement = agent.open_welcome(datagram)
    assert (agreement.welcome, agreement.keys) == (WELCOME, keys)
    assert len({keys.welcome, keys.agent_control, keys.server_control, keys.frames}) == 4


def test_the_hello_says_who_the_agent_is_to_holders_of_the_key_alone() -> None:
    agent = say_hello(name="front door", serial="A1")
    hello = decode_hello(open_hello(agent.datagram, agent.nonce, KEY))
    assert (hello.name, hello.serial) == ("front door", "A1")
    assert b"front door" not in agent.datagram
    with pytest.raises(NotAuthentic):
        open_hello(agent.datagram, agent.nonce, WRONG)


def test_a_hello_is_at_least_as_long_as_any_answer_to_it() -> None:
    agent = say_hello()
    assert len(agent.datagram) >= MIN_HELLO_SIZE >= len(answer(agent)[0])


def test_a_server_without_the_key_cannot_welcome() -> None:
    agent = say_hello()
    with pytest.raises(NotAuthentic):
        agent.open_welcome(answer(agent, rig_key=WRONG)[0])


def test_a_welcome_to_another_hello_is_not_accepted() -> None:
    one, other = say_hello(1), say_hello(3)
    for_other = bytearray(answer(other)[0])
    for_other[8:16] = one.datagram[8:16]
    with pytest.raises(NotAuthentic):
        one.open_welcome(with_crc(for_other))


@pytest.mark.parametrize("seeds", [(1, 9), (9, 2)], ids=["another server key pair", "another agent key pair"])
def test_every_session_has_secrets_of_its_own_whatever_it_says(seeds: tuple[int, int]) -> None:
    usual = answer(say_hello(1), 2)[1]
    fresh = answer(say_hello(seeds[0]), seeds[1])[1]
    for name in SessionKeys.__slots__:
        assert getattr(usual, name) != getattr(fresh, name)


def test_the_rigs_key_alone_does_not_open_a_recorded_session() -> None:
    """Who learns the key later, and has all that was on the wire, lacks both private keys."""
    agent = say_hello()
    datagram, keys = answer(agent)
    hello_public, welcome_public = agent.datagram[16:48], datagram[16:48]
    transcript = agent.datagram + welcome_public
    for public in (hello_public, welcome_public):
        guess = EphemeralKey(random_bytes(77)).session_keys(public, KEY, transcript)
        assert guess.frames != keys.frames


@pytest.mark.parametrize("public", [bytes(32), bytes([1]) + bytes(31)])
def test_a_public_key_of_low_order_is_refused(public: bytes) -> None:
    agent = say_hello()
    harmed = bytearray(answer(agent)[0])
    harmed[16:48] = public
    with pytest.raises(DataError, match="low order"):
        agent.open_welcome(with_crc(harmed))


@pytest.mark.parametrize("size", [16, 47, 48, 63])
def test_a_hello_or_welcome_too_short_for_key_and_seal_is_malformed(size: int) -> None:
    agent = say_hello()
    with pytest.raises(DataError):
        open_hello(agent.datagram[:size], agent.nonce, KEY)
    with pytest.raises(DataError):
        agent.open_welcome(answer(agent)[0][:size])


def test_a_hello_against_the_limits_is_misuse() -> None:
    with pytest.raises(LinkUsageError):
        say_hello(name="")


def test_no_secret_is_shown() -> None:
    agent = say_hello()
    datagram, keys = answer(agent)
    shown = repr(keys) + repr(agent.open_welcome(datagram))
    for name in SessionKeys.__slots__:
        assert repr(getattr(keys, name)) not in shown


def test_an_id_is_never_zero() -> None:
    numbers = iter([bytes(8), bytes(8), (7).to_bytes(8, "little")])
    assert fresh_id(lambda _size: next(numbers)) == 7


def test_the_datagrams_bear_the_nonce_and_their_type() -> None:
    agent = say_hello()
    datagram, _ = answer(agent)
    assert id_of(datagram) == id_of(agent.datagram) == agent.nonce
    assert (agent.datagram[3], datagram[3]) == (MessageType.HELLO, MessageType.WELCOME)
