"""Fast down, slow up, slower after each step up that failed."""

from rig_server.step_patience import StepPatience

SECOND_NS = 1_000_000_000


def waited_s(patience: StepPatience, now_ns: int) -> int:
    """Seconds of room until a step up is due."""
    seconds = 0
    while not patience.long_enough_under(True, now_ns + seconds * SECOND_NS):
        seconds += 1
    return seconds


def test_half_a_second_of_overload_is_enough_and_less_is_forgiven() -> None:
    patience = StepPatience(10)
    assert not patience.too_long_over(True, 0)
    assert not patience.too_long_over(True, SECOND_NS // 4)
    assert not patience.too_long_over(False, SECOND_NS // 3)
    assert not patience.too_long_over(True, SECOND_NS)
    assert patience.too_long_over(True, SECOND_NS * 3 // 2)


def test_room_must_last_without_a_break() -> None:
    patience = StepPatience(10)
    assert waited_s(patience, 0) == 10
    patience = StepPatience(10)
    patience.long_enough_under(True, 0)
    patience.long_enough_under(False, 9 * SECOND_NS)
    assert waited_s(patience, 9 * SECOND_NS) == 10


def test_each_failed_step_up_doubles_the_hold_off_up_to_an_hour() -> None:
    patience, now_ns = StepPatience(10), 0
    waits = []
    for _ in range(9):
        patience.stepped_up(now_ns)
        now_ns += SECOND_NS
        patience.overload_ended_step(now_ns)
        wait = waited_s(patience, now_ns)
        waits.append(wait)
        now_ns += wait * SECOND_NS
    assert waits == [60, 120, 240, 480, 960, 1920, 3600, 3600, 3600]


def test_a_step_up_that_lasted_shortens_the_hold_off() -> None:
    patience, now_ns = StepPatience(10), 0
    for lasted_s in (1, 1, 600):
        patience.stepped_up(now_ns)
        now_ns += lasted_s * SECOND_NS
        patience.overload_ended_step(now_ns)
        now_ns += 300 * SECOND_NS
    assert waited_s(patience, now_ns - 300 * SECOND_NS) == 60


def test_a_rig_that_comes_together_anew_begins_without_a_hold_off() -> None:
    patience = StepPatience(10)
    patience.stepped_up(0)
    patience.overload_ended_step(0)
    patience.begin()
    assert waited_s(patience, 0) == 10
