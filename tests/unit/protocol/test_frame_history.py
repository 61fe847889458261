"""What the agent remembers for the server to ask again, and how much of it it sends."""

import pytest

from rig_protocol.datagram import DatagramBatch
from rig_protocol.frame_history import FrameHistory
from rig_protocol.messages import WHOLE_FRAME, Resend

SIZE = 100


def frame(fill: int, fragments: int = 10) -> DatagramBatch:
    return DatagramBatch(bytes([fill]) * (SIZE * fragments), SIZE)


def history_of(frames: int, fragments: int = 10) -> FrameHistory:
    history = FrameHistory()
    for number in range(frames):
        history.add(number, frame(number % 256, fragments))
    return history


def granted(history: FrameHistory, resend: Resend, sent: int = 10) -> int:
    return sum(map(len, history.answer(resend, sent)))


def test_the_latest_eight_frames_are_held() -> None:
    history = history_of(20)
    assert [number for number in range(25) if history.find(number) is not None] == list(range(12, 20))


def test_a_whole_frame_may_be_asked_for_by_one_range() -> None:
    history = history_of(20)
    [answer] = history.answer(Resend(15, WHOLE_FRAME), 10)
    assert bytes(answer.part(0, 10)) == bytes(frame(15).buffer)


def test_what_is_not_held_is_refused_and_counted() -> None:
    history = history_of(20)
    assert granted(history, Resend(3, ((0, 2), (7, 1)))) == 0
    assert granted(history, Resend(99, WHOLE_FRAME)) == 0
    assert history.refused == 4


def test_fragments_beyond_the_frame_are_not_there() -> None:
    history = history_of(8)
    assert granted(history, Resend(0, ((10, 5), (65535, 65535)))) == 0
    assert granted(history, Resend(0, ((8, 5),))) == 2


@pytest.mark.parametrize("frames", [1, 5, 100])
def test_the_budget_is_a_quarter_of_the_bytes_and_what_was_saved_up_of_three_frames(frames: int) -> None:
    history, sent_again = FrameHistory(), 0
    for number in range(frames):
        history.add(number, frame(number % 256))
        for _ in range(5):  # whoever asks for everything, again and again
            sent_again += granted(history, Resend(number, WHOLE_FRAME))
    assert sent_again <= 10 + 0.25 * 10 * frames
    assert history.refused == 5 * 10 * frames - sent_again


def test_a_quiet_time_saves_up_three_frames_and_no_more() -> None:
    history = history_of(1000)
    assert sum(granted(history, Resend(999 - k, WHOLE_FRAME)) for k in range(8)) == 30


def test_the_first_fragments_of_a_range_have_the_rest_of_the_budget() -> None:
    history = history_of(1)  # one frame and a quarter
    assert granted(history, Resend(0, WHOLE_FRAME)) == 10
    [answer] = history.answer(Resend(0, ((3, 7),)), 10)
    assert len(answer) == 2
    assert history.refused == 5


def test_a_hostile_request_is_answered_within_the_budget() -> None:
    history = history_of(1000)
    answers = history.answer(Resend(999, ((0, 65535),) * 250), 10)
    assert sum(map(len, answers)) == 30


def test_a_frame_that_was_given_up_is_forgotten_and_the_others_stay() -> None:
    history = FrameHistory()
    frames = [frame(number) for number in range(3)]
    for number, one in enumerate(frames):
        history.add(number, one)
    history.forget(frames[1])
    assert [history.find(number) for number in range(3)] == [frames[0], None, frames[2]]


def test_the_first_frame_that_has_not_left_whole_is_known() -> None:
    history = FrameHistory()
    frames = [frame(number) for number in range(3)]
    for number, one in enumerate(frames):
        history.add(number, one)
    assert history.first_unsent(len) is None
    assert history.first_unsent(lambda batch: 9 if batch is frames[1] else len(batch)) == 1
    assert history.first_unsent(lambda batch: 0 if batch is frames[2] else len(batch)) == 2
