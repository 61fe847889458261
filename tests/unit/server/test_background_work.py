"""Work in a thread of its own: its result once, its errors to whoever takes it, and an end when given up."""

import threading
from collections.abc import Callable

import pytest

from rig_server.background_work import BackgroundWork

Tell = Callable[[str, float], None]
LONG_S = 30.0


def quiet(_stage: str, _share: float) -> None:
    """Progress that nobody watches."""


def test_a_result_is_taken_once() -> None:
    with BackgroundWork[int]("test") as work:
        assert work.take(0.0) is None
        work.start(lambda _tell: 7, quiet)
        assert work.take(LONG_S) == 7
        assert not work.busy
        assert work.take(0.0) is None


def test_an_error_reaches_whoever_takes_the_result() -> None:
    def fail(_tell: Tell) -> int:
        raise ValueError("no such camera")

    with BackgroundWork[int]("test") as work:
        work.start(fail, quiet)
        with pytest.raises(ValueError, match="no such camera"):
            work.take(LONG_S)
        assert not work.busy


@pytest.mark.parametrize("leave", [False, True])
def test_work_that_is_given_up_ends_at_its_next_sign_of_progress(leave: bool) -> None:
    go_on, ended, begun = threading.Event(), threading.Event(), threading.Event()

    def go_on_and_on(tell: Tell) -> int:
        begun.set()
        go_on.wait(LONG_S)
        try:
            tell("matching", 0.5)
        finally:
            ended.set()
        return 1

    with BackgroundWork[int]("test") as work:
        work.start(go_on_and_on, quiet)
        assert begun.wait(LONG_S)
        assert work.take(0.0) is None
        assert work.busy
        if not leave:
            work.give_up()
            go_on.set()
            assert work.take(LONG_S) is None
            assert not work.busy
    # Leaving gives it up, too, and does not wait: the work has not even gone on yet.
    assert ended.is_set() != leave
    go_on.set()
    assert ended.wait(LONG_S)


def test_progress_is_passed_on() -> None:
    told: list[tuple[str, float]] = []

    def work_and_tell(tell: Tell) -> int:
        tell("features", 0.25)
        return 1

    with BackgroundWork[int]("test") as work:
        work.start(work_and_tell, lambda stage, share: told.append((stage, share)))
        work.take(LONG_S)
    assert told == [("features", 0.25)]
