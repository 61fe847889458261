"""Sets between threads: waiting, time-outs, a consumer that is too slow."""

import threading
import time

from rig_protocol.frames import PanoramicFrame, RgbdFrame
from rig_server.assembler import Assembler
from rig_server.synchroniser import Synchroniser

MS = 1_000_000


def assembler(cameras: int, deadline_ms: float = 30.0) -> Assembler:
    made = Assembler(Synchroniser(range(cameras), deadline_ns=int(deadline_ms * MS)))
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
