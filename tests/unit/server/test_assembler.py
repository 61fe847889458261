"""Sets between threads: waiting, time-outs, a consumer that is too slow."""

import threading
import time

import pytest

from rig_protocol.frames import PanoramicFrame, RgbdFrame
from rig_protocol.synchroniser import Policy, Synchroniser
from rig_server import assembler as assembler_module
from rig_server.assembler import Assembler, SetRecord

MS = 1_000_000


def assembler(cameras: int, deadline_ms: float = 30.0, policy: Policy = "partial") -> Assembler:
    made = Assembler(Synchroniser(range(cameras), deadline_ns=int(deadline_ms * MS), policy=policy))
    for camera_id in range(cameras):
        made.camera_joined(camera_id, 100.0)
    return made


def frame(camera_id: int, timestamp_ns: int | None = None) -> RgbdFrame:
    time_ns = time.monotonic_ns() if timestamp_ns is None else timestamp_ns
    return RgbdFrame(camera_id=camera_id, sequence=0, timestamp_ns=time_ns)


def test_whoever_waits_gets_the_set_when_the_last_frame_comes() -> None:
    sets = assembler(2, deadline_ms=10_000)
    now_ns = time.monotonic_ns()
    got: list[PanoramicFrame | None] = []
    waiter = threading.Thread(target=lambda: got.append(sets.next_panorama(10.0)))
    waiter.start()
    sets.add(frame(0, now_ns))
    sets.add(frame(1, now_ns))
    waiter.join(10.0)
    assert got[0] is not None
    assert got[0].complete
    assert (sets.complete, sets.partial) == (1, 0)


def test_waiting_makes_an_overdue_set_go_out_partial() -> None:
    sets = assembler(2)
    sets.add(frame(1))
    panorama = sets.next_panorama(10.0)
    assert panorama is not None
    assert panorama.missing == (0,)
    assert sets.recent[0].missing == (0,)


def test_a_set_whose_first_frame_comes_while_somebody_waits_goes_out_when_it_is_overdue() -> None:
    sets = assembler(2)
    got: list[PanoramicFrame | None] = []
    waiter = threading.Thread(target=lambda: got.append(sets.next_panorama(60.0)))
    waiter.start()
    sets.add(frame(1))
    waiter.join(30.0)
    assert got[0] is not None
    assert got[0].missing == (0,)


def test_every_waiter_gets_a_set_of_its_own() -> None:
    sets = assembler(1)
    got: list[PanoramicFrame | None] = []
    waiters = [threading.Thread(target=lambda: got.append(sets.next_panorama(30.0))) for _ in range(3)]
    for waiter in waiters:
        waiter.start()
    for _ in waiters:
        sets.add(frame(0))
    for waiter in waiters:
        waiter.join(30.0)
    assert sorted(panorama.index for panorama in got if panorama is not None) == [0, 1, 2]


def test_frames_that_make_no_set_wake_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    sets = assembler(9, deadline_ms=10_000)
    looks: list[str] = []  # at the clock, which a waiter does when it wakes
    waits = threading.Event()

    def rig_time_ns() -> int:
        looks.append(threading.current_thread().name)
        if looks[-1] == "waiter":
            waits.set()
        return time.monotonic_ns()

    monkeypatch.setattr(assembler_module, "rig_time_ns", rig_time_ns)
    got: list[PanoramicFrame | None] = []
    waiter = threading.Thread(target=lambda: got.append(sets.next_panorama(30.0)), name="waiter")
    waiter.start()
    assert waits.wait(10.0)
    now_ns = time.monotonic_ns()
    for camera_id in range(9):  # the lock is free once the waiter waits
        sets.add(frame(camera_id, now_ns))
    waiter.join(30.0)
    assert got[0] is not None
    assert looks.count("waiter") == 2


def test_nobody_loses_a_set_when_threads_add_and_take_at_once() -> None:
    sets = assembler(4, deadline_ms=10_000)
    start_ns, count = time.monotonic_ns() - 10_000 * MS, 200
    took: list[int] = []
    turn = threading.Barrier(5)

    def add(camera_id: int) -> None:
        for k in range(count):
            sets.add(frame(camera_id, start_ns + k * 10 * MS))
            turn.wait(30.0)

    def take() -> None:
        for _ in range(count):
            panorama = sets.next_panorama(30.0)
            took.append(-1 if panorama is None else panorama.index)
            turn.wait(30.0)

    threads = [threading.Thread(target=add, args=(i,)) for i in range(4)] + [threading.Thread(target=take)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60.0)
    assert took == list(range(count))
    assert sets.overrun == 0


def test_a_record_tells_uncertainty_and_when_the_last_frame_was_received() -> None:
    sets = assembler(2)
    now_ns = time.monotonic_ns()
    sets.add(RgbdFrame(0, 0, now_ns, uncertainty_ns=70_000, received_ns=now_ns + 5))
    sets.add(RgbdFrame(1, 0, now_ns - MS, uncertainty_ns=30_000, received_ns=now_ns + 9))
    record = sets.recent[0]
    assert (record.spread_ns, record.uncertainty_ns, record.received_ns) == (MS, 70_000, now_ns + 9)
    assert SetRecord.of(PanoramicFrame.of(0, {0: RgbdFrame(0, 0, 0)}), now_ns).received_ns is None


def test_incomplete_sets_of_the_policy_strict_are_counted_and_their_cameras_named() -> None:
    sets = assembler(2, policy="strict")
    sets.camera_left(1)
    sets.add(frame(0))
    assert sets.next_panorama(0.0) is None
    assert (sets.incomplete, sets.complete, sets.partial, sets.waiting) == (1, 0, 0, 0)
    assert [record.missing for record in sets.recent_incomplete] == [(1,)]


def test_nothing_comes_of_nothing() -> None:
    assert assembler(1).next_panorama(0.01) is None


def test_a_slow_consumer_gets_the_newest_sets_and_the_others_are_counted() -> None:
    sets = assembler(1)
    for _ in range(10):
        sets.add(frame(0))
    first = sets.next_panorama(1.0)
    assert first is not None
    assert first.index == 6
    assert sets.overrun == 6


def test_a_camera_that_leaves_releases_the_set_that_waited_for_it() -> None:
    sets = assembler(2, deadline_ms=10_000)
    sets.add(frame(0))
    assert sets.next_panorama(0.0) is None
    sets.camera_left(1)
    panorama = sets.next_panorama(1.0)
    assert panorama is not None
    assert panorama.missing == (1,)


def test_frames_that_enter_no_set_are_counted() -> None:
    sets = assembler(1)
    now_ns = time.monotonic_ns()
    sets.add(frame(0, now_ns + 3600 * 1000 * MS))
    assert (sets.implausible, sets.skipped) == (1, 0)
    assert sets.next_panorama(0.0) is None
