"""The worker on the latest item: nobody waits for it, and an error ends neither it nor the rig."""

import threading
from collections.abc import Iterator

import pytest

from rig_server.latest_only import LatestOnly


class Gated:
    """Work that holds every item until `go`."""

    def __init__(self) -> None:
        self.begun, self.go, self.done = (threading.Semaphore(0) for _ in range(3))
        self.items: list[int] = []

    def __call__(self, item: int) -> None:
        self.begun.release()
        assert self.go.acquire(timeout=10)
        self.items.append(item)
        self.done.release()
        if item < 0:
            raise ValueError("a bad item")


@pytest.fixture
def gated() -> Gated:
    return Gated()


@pytest.fixture
def worker(gated: Gated) -> Iterator[LatestOnly[int]]:
    made = LatestOnly[int]("test", gated, 0.0, 0)
    made.start()
    yield made
    gated.go.release(10)
    made.stop()


def test_of_items_that_come_meanwhile_the_last_alone_is_worked_on(
    gated: Gated, worker: LatestOnly[int]
) -> None:
    worker.offer(1)
    assert gated.begun.acquire(timeout=10)
    for item in (2, 3, 4):
        worker.offer(item)
    gated.go.release(2)
    for _ in range(2):
        assert gated.done.acquire(timeout=10)
    assert gated.items == [1, 4]
    assert worker.passed == 2


def test_an_error_is_told_until_work_goes_well_again(
    gated: Gated, worker: LatestOnly[int], caplog: pytest.LogCaptureFixture
) -> None:
    gated.go.release(4)
    for item in (-1, -2, 3, 4):
        worker.offer(item)
        assert gated.done.acquire(timeout=10)
        if item == -2:
            assert worker.failure == "ValueError('a bad item')"
    assert worker.failure is None
    assert caplog.text.count("test has failed") == 1


def test_what_is_offered_too_soon_after_the_work_before_passes() -> None:
    done = threading.Semaphore(0)
    worker = LatestOnly[int]("test", lambda _: done.release(), 3600.0, 0)
    worker.start()
    worker.offer(1)
    assert done.acquire(timeout=10)
    worker.offer(2)
    worker.offer(3)
    assert worker.passed == 2
    worker.stop()
    assert not done.acquire(blocking=False)


def test_it_can_be_stopped_without_having_begun_and_takes_nothing_afterwards(gated: Gated) -> None:
    worker = LatestOnly[int]("test", gated, 0.0, 0)
    worker.stop()
    worker.stop()
    worker.offer(1)
    assert gated.items == []
