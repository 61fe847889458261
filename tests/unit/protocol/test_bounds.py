"""The link's small bounded helpers."""

from rig_protocol.event_queue import MAX_FRAMES, MAX_OTHERS, EventQueue
from rig_protocol.events import CameraLeft, FrameReceived
from rig_protocol.rate_limit import RateLimit
from support.wire import make_frame


def test_events_come_out_in_the_order_they_went_in() -> None:
    queue = EventQueue()
    events = [
        CameraLeft(0, "a"),
        FrameReceived(make_frame(1)),
        CameraLeft(1, "b"),
        FrameReceived(make_frame(2)),
    ]
    for event in events:
        assert queue.push(event) is None
    assert [queue.pop() for _ in range(5)] == [*events, None]


def test_a_flood_of_frames_does_not_push_out_other_events_nor_the_reverse() -> None:
    queue = EventQueue()
    queue.push(CameraLeft(0, "first"))
    dropped = [queue.push(FrameReceived(make_frame(k, size=0))) for k in range(MAX_FRAMES + 1)]
    assert dropped[-1] == FrameReceived(make_frame(0, size=0))
    assert dropped[:-1] == [None] * MAX_FRAMES
    assert queue.pop() == CameraLeft(0, "first")
    others = [queue.push(CameraLeft(k, "")) for k in range(MAX_OTHERS + 1)]
    assert others[-1] == CameraLeft(0, "")
    assert queue.pop() == FrameReceived(make_frame(1, size=0))


def test_an_event_is_allowed_once_an_interval_and_key() -> None:
    limit = RateLimit(100)
    assert [limit.allows("a", now_ns) for now_ns in (0, 99, 100, 150, 200)] == [
        True,
        False,
        True,
        False,
        True,
    ]
    assert limit.allows("b", 150)


def test_only_the_latest_keys_are_remembered() -> None:
    limit = RateLimit(100, max_keys=2)
    assert [limit.allows(key, 0) for key in "abca"] == [True, True, True, True]
    assert not limit.allows("c", 0)
    assert len(limit._full_ns) == 2


def test_what_was_saved_up_may_happen_at_once_and_then_one_an_interval() -> None:
    limit = RateLimit(100, burst=3)
    assert [limit.allows("a", now_ns) for now_ns in (0, 0, 0, 0, 99, 100, 150, 200, 299)] == [
        *(True, True, True, False),
        *(False, True, False, True, False),
    ]
    assert sum(limit.allows("a", 10_000) for _ in range(10)) == 3
