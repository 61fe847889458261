"""Rules of capture: a lost source is opened again, frames count on, what cannot be cured is reported."""

import logging
import random
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from itertools import pairwise
from types import TracebackType
from typing import Self

import pytest

from rig_agent.capture import Capture, _Thinning
from rig_agent.frame_queue import FrameQueue
from rig_agent.sources.base import ControlValue, SourceDescription, SourceLost
from rig_protocol.camera import CameraModel
from rig_protocol.errors import DataError
from rig_protocol.frames import RgbdFrame
from rig_protocol.gravity import Gravity

DESCRIPTION = SourceDescription("A1", "1-1", CameraModel(), 30.0, "bayer", "raw")
INTERVAL_NS = 33_333_333
Step = RgbdFrame | Exception


class ScriptedSource:
    """A FrameSource that plays frames and faults, then falls silent."""

    def __init__(self, steps: list[Step]) -> None:
        self._steps = iter(steps)
        self.closed = False
        self.counters: Mapping[str, int] = {"skipped": 2, "torn": 0}

    def describe(self) -> SourceDescription:
        return DESCRIPTION

    def read(self, timeout_s: float) -> RgbdFrame | None:
        step = next(self._steps, None)
        if isinstance(step, Exception):
            raise step
        if step is None:
            threading.Event().wait(min(timeout_s, 0.01))
        return step

    def close(self) -> None:
        self.closed = True

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None, /
    ) -> None:
        self.close()


class Recorder:
    """What capture told its owner."""

    def __init__(self) -> None:
        self.frames: FrameQueue[RgbdFrame] = FrameQueue(1000)
        self.opened = 0
        self.failures: FrameQueue[Exception] = FrameQueue(10)

    def take(self, count: int) -> list[RgbdFrame]:
        taken = [self.frames.get(5.0) for _ in range(count)]
        return [frame for frame in taken if frame is not None]

    def count_opened(self, _description: SourceDescription) -> None:
        self.opened += 1


def frames(*sequences: int) -> list[Step]:
    return [RgbdFrame(0, sequence, sequence * INTERVAL_NS) for sequence in sequences]


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rig_agent.capture._FIRST_RETRY_S", 0.01)


Start = Callable[..., tuple[Capture, Recorder]]


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts a capture over scripts, one an opening; an exception in their place is a failed opening."""
    started: list[Capture] = []

    def start(*scripts: list[Step] | Exception, max_fps: float | None = None) -> tuple[Capture, Recorder]:
        remaining = iter(scripts)

        def open_source() -> ScriptedSource:
            script = next(remaining, SourceLost("no more scripts"))
            if isinstance(script, Exception):
                raise script
            return ScriptedSource(script)

        recorder = Recorder()
        capture = Capture(
            open_source, max_fps, recorder.count_opened, recorder.frames.put, recorder.failures.put
        )
        capture.start()
        started.append(capture)
        return capture, recorder

    yield start
    assert all(capture.stop(5.0) for capture in started)


def test_frames_pass_in_order(start: Start) -> None:
    _, recorder = start(frames(0, 1, 2))
    assert [frame.sequence for frame in recorder.take(3)] == [0, 1, 2]


def test_a_queue_tells_what_it_dropped() -> None:
    queue: FrameQueue[int] = FrameQueue(2)
    assert [queue.put(k) for k in range(4)] == [None, None, 0, 1]


def test_a_lost_source_is_opened_again_and_frames_count_on(start: Start) -> None:
    capture, recorder = start([*frames(0, 1), SourceLost("unplugged")], frames(0, 1))
    assert [frame.sequence for frame in recorder.take(4)] == [0, 1, 2, 3]
    assert (recorder.opened, capture.counters.losses) == (2, 1)


def test_what_the_driver_counted_outlives_its_closing(start: Start) -> None:
    capture, recorder = start([*frames(0), SourceLost("unplugged")], [*frames(0), DataError("torn")])
    recorder.take(2)
    assert recorder.failures.get(5.0) is not None
    assert capture.source_counters == {"skipped": 4}


def test_gaps_that_the_sensor_left_stay_visible(start: Start) -> None:
    _, recorder = start([*frames(5, 7), SourceLost("unplugged")], frames(0, 4))
    assert [frame.sequence for frame in recorder.take(4)] == [0, 2, 3, 7]


def test_a_device_that_cannot_be_opened_is_tried_again(start: Start) -> None:
    capture, recorder = start(SourceLost("busy"), SourceLost("busy"), frames(0))
    assert len(recorder.take(1)) == 1
    assert capture.counters.losses == 2


def test_the_same_trouble_is_told_once(start: Start, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        _, recorder = start(SourceLost("busy"), SourceLost("busy"), SourceLost("gone"), frames(0))
        recorder.take(1)
    assert [message.partition(";")[0] for message in caplog.messages] == ["busy", "gone"]


def test_a_failure_that_no_retry_cures_is_reported_and_ends_the_thread(start: Start) -> None:
    capture, recorder = start([*frames(0), DataError("torn")])
    error = recorder.failures.get(5.0)
    assert isinstance(error, DataError)
    assert capture.stop(5.0)


def test_stopping_closes_the_source() -> None:
    source = ScriptedSource(frames(0))
    recorder = Recorder()
    capture = Capture(lambda: source, None, recorder.count_opened, recorder.frames.put, recorder.failures.put)
    capture.start()
    recorder.take(1)
    assert capture.stop(5.0)
    assert source.closed


def test_damaged_frames_are_counted_and_passed_on(start: Start) -> None:
    capture, recorder = start([RgbdFrame(0, 0, 0, damaged=True)])
    assert recorder.take(1)[0].damaged
    assert capture.counters.damaged == 1


@pytest.mark.parametrize(
    ("max_fps", "kept"),
    [
        (None, range(12)),
        (30.0, range(12)),
        (60.0, range(12)),
        (15.0, range(0, 12, 2)),
        (10.0, range(0, 12, 3)),
    ],
)
def test_a_faster_source_is_thinned_evenly(start: Start, max_fps: float | None, kept: range) -> None:
    _, recorder = start(frames(*range(12)), max_fps=max_fps)
    assert [frame.timestamp_ns for frame in recorder.take(len(kept))] == [INTERVAL_NS * n for n in kept]


def test_frames_left_out_on_purpose_leave_no_gap_and_lost_ones_do(start: Start) -> None:
    """At half the rate 0, 2, 4, 8 and 10 pass; 6 and 7 never came."""
    _, recorder = start(frames(0, 1, 2, 3, 4, 5, 8, 9, 10), max_fps=15.0)
    assert [frame.sequence for frame in recorder.take(5)] == [0, 1, 2, 5, 6]


def test_thinning_to_an_odd_rate_keeps_it_on_average(start: Start) -> None:
    _, recorder = start(frames(*range(300), *range(10**6, 10**6 + 3)), max_fps=20.0)
    taken = recorder.take(201)
    assert taken[199].timestamp_ns < 300 * INTERVAL_NS < taken[200].timestamp_ns


@pytest.mark.parametrize(
    ("max_fps", "wanted_fps", "kept"),
    [
        (None, 15.0, range(0, 12, 2)),
        (None, 60.0, range(12)),
        (10.0, 15.0, range(0, 12, 3)),
        (15.0, 10.0, range(0, 12, 3)),
    ],
)
def test_the_slower_of_what_the_operator_and_what_the_server_wants_counts(
    max_fps: float | None, wanted_fps: float, kept: range
) -> None:
    recorder = Recorder()
    capture = Capture(
        lambda: ScriptedSource(frames(*range(12))),
        max_fps,
        recorder.count_opened,
        recorder.frames.put,
        recorder.failures.put,
    )
    capture.want(wanted_fps, 0)
    capture.start()
    taken = recorder.take(len(kept))
    assert capture.stop(5.0)
    assert [frame.timestamp_ns for frame in taken] == [INTERVAL_NS * n for n in kept]
    assert [frame.sequence for frame in taken] == list(range(len(kept)))


def test_what_the_server_wants_may_change_amid_the_stream() -> None:
    capture: Capture

    class Wanting(ScriptedSource):
        def read(self, timeout_s: float) -> RgbdFrame | None:
            frame = super().read(timeout_s)
            if frame is not None and frame.sequence % 30 == 0:
                capture.want({0: None, 30: 15.0, 60: 30.0}[frame.sequence], 0)
            return frame

    recorder = Recorder()
    capture = Capture(
        lambda: Wanting(frames(*range(90))),
        None,
        recorder.count_opened,
        recorder.frames.put,
        recorder.failures.put,
    )
    capture.start()
    taken = [round(frame.timestamp_ns / INTERVAL_NS) for frame in recorder.take(75)]
    assert capture.stop(5.0)
    assert taken == [*range(30), *range(30, 60, 2), *range(60, 90)]


def test_a_control_that_changes_what_the_source_delivers_is_told_to_the_agent() -> None:
    infrared = replace(DESCRIPTION, color_image="grey")

    class Switched(ScriptedSource):
        description = DESCRIPTION

        def describe(self) -> SourceDescription:
            return self.description

        def control(self, name: str, value: ControlValue) -> str:
            assert (name, value) == ("color", "ir")
            self.description = infrared
            return "infrared from now on"

    told: FrameQueue[SourceDescription] = FrameQueue(10)
    answers: FrameQueue[tuple[bool, str]] = FrameQueue(10)
    capture = Capture(lambda: Switched([]), None, told.put, lambda _frame: None, lambda _error: None)
    capture.start()
    capture.control("color", "ir", lambda done, words: answers.put((done, words)))
    assert answers.get(5.0) == (True, "infrared from now on")
    assert [told.get(5.0), told.get(5.0)] == [DESCRIPTION, infrared]
    assert capture.stop(5.0)


def test_a_full_queue_drops_the_oldest_and_counts_it() -> None:
    queue: FrameQueue[int] = FrameQueue(2)
    for item in range(5):
        queue.put(item)
    assert queue.dropped == 3
    assert [queue.get(), queue.get(), queue.get()] == [3, 4, None]


def test_agents_with_other_clocks_leave_out_the_same_moments_of_rig_time() -> None:
    """Three agents whose clocks differ; their cameras run freely, within one period of each other."""
    taken = []
    for offset_ns, phase_ns in ((0, 0), (10**12 + 7, 9_000_000), (-(10**11) - 3, 21_000_000)):
        stamps = [INTERVAL_NS * n + phase_ns - offset_ns for n in range(40)]
        thinning = _Thinning()
        kept = [stamp + offset_ns for stamp in stamps if thinning.accepts(stamp + offset_ns, 7.5, 30.0)]
        taken.append(kept[1:9])
    for moments in zip(*taken, strict=True):
        assert max(moments) - min(moments) <= INTERVAL_NS


@pytest.mark.parametrize("phase_ns", range(0, 66_000_000, 1_700_000))
def test_a_camera_of_any_phase_is_thinned_evenly_whatever_its_jitter(phase_ns: int) -> None:
    rng, thinning = random.Random(phase_ns), _Thinning()
    kept = [
        n
        for n in range(60)
        if thinning.accepts(INTERVAL_NS * n + phase_ns + rng.randint(-200_000, 200_000), 15.0, 30.0)
    ]
    assert [after - before for before, after in pairwise(kept)] == [2] * (len(kept) - 1)
    assert len(kept) >= 29


def test_a_source_whose_count_goes_back_counts_on(start: Start) -> None:
    """As that of a recording, which follows from the clock, when the clock is set back."""
    _, recorder = start(frames(50, 51, 52, 3, 4, 6))
    assert [frame.sequence for frame in recorder.take(6)] == [0, 1, 2, 3, 4, 6]


def test_the_capture_knows_what_its_source_felt_last_and_forgets_it_with_the_source(start: Start) -> None:
    felt = Gravity((0.0, 1.0, 0.0))
    still: list[Step] = [RgbdFrame(0, 0, 0), RgbdFrame(0, 1, INTERVAL_NS, gravity=felt)]
    capture, recorder = start(still)
    recorder.take(2)
    assert capture.gravity == felt
    lost, recorder = start([*still, SourceLost("unplugged")], SourceLost("still away"), frames(0))
    recorder.take(3)
    assert lost.gravity is None
