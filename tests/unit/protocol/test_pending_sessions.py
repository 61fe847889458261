from dataclasses import replace

from rig_protocol.handshake import Agreement
from rig_protocol.pending_sessions import MAX_PENDING, MAX_USED_NONCES, PendingSession, PendingSessions
from rig_protocol.security import SessionKeys
from support.peers import WELCOME
from support.wire import AGENT, OTHER, make_hello

AGREEMENT = Agreement(WELCOME, SessionKeys(b"", b"", b"", b""))


def pending(number: int, nonce: int | None = None, address: tuple[str, int] = AGENT) -> PendingSession:
    welcome = replace(WELCOME, session_id=1000 + number, camera_id=number % 256)
    agreement = replace(AGREEMENT, welcome=welcome)
    known = number if nonce is None else nonce
    return PendingSession(make_hello(), known, address, agreement, b"welcome", offered_ns=0)


def test_one_is_found_by_its_session_and_by_the_very_hello_that_began_it() -> None:
    sessions, one = PendingSessions(), pending(1)
    sessions.add(one)
    assert 1001 in sessions
    assert sessions.of_id(1001) is one
    assert sessions.of_hello(1, AGENT) is one
    assert sessions.of_hello(1, OTHER) is None
    assert sessions.of_hello(2, AGENT) is None


def test_the_oldest_gives_way() -> None:
    sessions = PendingSessions()
    for number in range(MAX_PENDING + 10):
        sessions.add(pending(number))
    assert [number for number in range(MAX_PENDING + 10) if 1000 + number in sessions] == list(
        range(10, MAX_PENDING + 10)
    )
    assert sessions.of_hello(9, AGENT) is None
    assert len(sessions._by_id) == len(sessions._ids) == MAX_PENDING


def test_one_that_becomes_a_session_waits_no_more_and_its_hello_is_used() -> None:
    sessions = PendingSessions()
    sessions.add(pending(1))
    assert not sessions.was_used(1)
    sessions.take(1001)
    assert 1001 not in sessions
    assert sessions.of_hello(1, AGENT) is None
    assert sessions.was_used(1)


def test_one_hello_from_two_addresses_waits_twice_and_is_used_once() -> None:
    sessions = PendingSessions()
    sessions.add(pending(1, nonce=7))
    sessions.add(pending(2, nonce=7, address=OTHER))
    sessions.take(1001)
    assert sessions.was_used(7)
    assert sessions.of_id(1002) is not None
    for number in range(3, MAX_PENDING + 10):
        sessions.add(pending(number))
    assert sessions.of_id(1002) is None


def test_used_hellos_are_remembered_within_bounds() -> None:
    sessions = PendingSessions()
    for number in range(MAX_USED_NONCES + 5):
        sessions.add(pending(number))
        sessions.take(1000 + number)
    assert [sessions.was_used(number) for number in (0, 4, 5, MAX_USED_NONCES + 4)] == [
        *(False, False, True, True),
    ]


def test_those_that_wait_can_be_forgotten_and_those_used_stay_known() -> None:
    sessions = PendingSessions()
    sessions.add(pending(1))
    sessions.take(1001)
    sessions.add(pending(2))
    sessions.clear()
    assert 1002 not in sessions
    assert sessions.of_hello(2, AGENT) is None
    assert sessions.was_used(1)


def test_other_offers_of_a_slot_are_withdrawn_when_one_is_taken() -> None:
    sessions = PendingSessions()
    for number in (1, 2, 257, 513):  # all but the second are of slot 1
        sessions.add(pending(number))
    sessions.take(1257)
    assert [number for number in (1, 2, 257, 513) if 1000 + number in sessions] == [2]
    assert len(sessions._ids) == 1
