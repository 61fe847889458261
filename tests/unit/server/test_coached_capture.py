"""Sets collected while estimates run: which sets a result rests on, and when a capture ends."""

import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import pytest
from rich.console import Console

from rig_calib.accuracy import AccuracyTarget
from rig_calib.calibration import CalibrationResult
from rig_calib.coaching import PairSupport, Support
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.errors import DataError, RigError
from rig_protocol.frames import PanoramicFrame, RgbdFrame
from rig_protocol.rig_folder import RigDescription
from rig_server.calibration_task import CalibrationTask, Estimate
from rig_server.coach_display import CoachDisplay
from rig_server.coached_capture import coached_capture, doublings
from rig_server.config import CaptureSettings, RigSettings

CAMERAS = (0, 1)


def panorama(index: int, missing: int = 0) -> PanoramicFrame:
    frames = {i: None if i < missing else RgbdFrame(i, index, 0) for i in CAMERAS}
    return PanoramicFrame(index, 0, frames, 0)


class FakeRig:
    """Hands out the given sets, then ends; with `endless`, one after the other to whoever waits for it."""

    class description:  # noqa: N801  # stands for an attribute
        camera_ids = CAMERAS

    def __init__(self, sets: Iterable[PanoramicFrame], endless: bool = False) -> None:
        self._sets = list(sets)
        self._next = len(self._sets)
        self._endless = endless
        self.closed = False

    @property
    def ended(self) -> bool:
        return not self._sets and not self._endless

    def next_panorama(self, timeout_s: float) -> PanoramicFrame | None:
        assert not self.closed, "a rig that is closed delivers nothing"
        if self._endless and timeout_s > 0.0:
            self._next += 1
            self._sets.append(panorama(self._next))
        return self._sets.pop(0) if self._sets else None

    def end_sets(self) -> None:
        self.closed = True


@dataclass
class ScriptedTask:
    """Estimates whose quality the test decides; remembers on which sets each was made."""

    settings: RigSettings
    missed: Callable[[Sequence[int]], str | None] = lambda _sets: None
    target: AccuracyTarget | None = None
    coached: bool = False
    bare: Callable[[Sequence[int]], bool] = lambda _sets: False
    failure: Exception | None = None
    on: list[list[int]] = field(default_factory=list)

    def estimate(
        self,
        _description: RigDescription,
        panoramas: Sequence[PanoramicFrame],
        warnings: Sequence[str],
        tell: Callable[[str, float], None],
    ) -> Estimate:
        tell("features", 0.0)
        if self.failure is not None:
            raise self.failure
        sets = [one.index for one in panoramas]
        self.on.append(sets)
        state = Support.NOTHING if self.bare(sets) else Support.GOOD
        pair = PairSupport(0, 1, "cam00–cam01", 9, True, None, state)
        calibration = RigCalibration("joint", "ring", (), (), None, {}, len(sets), warnings=tuple(warnings))
        return Estimate(
            len(sets), CalibrationResult(calibration, (), {}, None), [], (pair,), self.missed(sets)
        )

    def contents(self, estimate: Estimate) -> bool:
        return CalibrationTask.contents(self, estimate)  # type: ignore[arg-type]


def task(frames: int, **options: object) -> ScriptedTask:
    return ScriptedTask(RigSettings(capture=CaptureSettings(frames=frames)), **options)


def capture(rig: FakeRig, scripted: ScriptedTask) -> Estimate:
    with CoachDisplay(Console(file=io.StringIO())) as display:
        return coached_capture(rig, scripted, display)  # type: ignore[arg-type]


def test_without_a_target_the_result_rests_on_the_first_complete_sets() -> None:
    rig = FakeRig([panorama(0, 1), *map(panorama, range(1, 9))])
    estimate = capture(rig, scripted := task(3))
    assert scripted.on[-1] == [1, 2, 3]
    assert estimate.calibration.warnings == ()
    assert rig.closed


@pytest.mark.parametrize("enough", [1, 2, 4, 7])
def test_a_target_ends_the_capture_on_the_fewest_sets_that_meet_it_however_fast_they_came(
    enough: int,
) -> None:
    """A replayed capture comes at another pace and must end on the same sets."""
    rig = FakeRig(map(panorama, range(20)))
    scripted = task(
        7, target=AccuracyTarget(mm=3.0), missed=lambda sets: None if len(sets) >= enough else "1 mm too much"
    )
    estimate = capture(rig, scripted)
    assert estimate.missed is None
    assert [len(sets) for sets in scripted.on] == [count for count in (1, 2, 4, 7) if count <= enough]
    assert scripted.on[-1] == list(range(enough))


def test_a_target_that_all_sets_miss_ends_with_all_of_them_and_by_how_much() -> None:
    scripted = task(3, target=AccuracyTarget(mm=3.0), missed=lambda _sets: "1 mm too much")
    estimate = capture(FakeRig(map(panorama, range(9))), scripted)
    assert scripted.on == [[0], [0, 1], [0, 1, 2]]
    assert estimate.missed == "1 mm too much"


def test_partial_sets_fill_up_and_a_warning_says_so() -> None:
    estimate = capture(FakeRig([panorama(0), panorama(1, 1)]), scripted := task(2))
    assert scripted.on[-1] == [0, 1]
    assert "1 of 2 panoramic frames were partial" in estimate.calibration.warnings[0]


def test_a_coached_capture_goes_on_with_fresh_sets_until_no_overlap_is_bare() -> None:
    """Somebody hangs a pattern between sets 4 and 5."""
    scripted = task(2, coached=True, bare=lambda sets: min(sets) < 5)
    estimate = capture(FakeRig([], endless=True), scripted)
    assert estimate.pairs[0].support is Support.GOOD
    assert min(scripted.on[-1]) >= 5
    assert len(scripted.on[-1]) == 2


def test_a_coached_capture_of_a_recording_ends_with_it() -> None:
    estimate = capture(FakeRig(map(panorama, range(4))), task(2, coached=True, bare=lambda _sets: True))
    assert estimate.pairs[0].support is Support.NOTHING


def test_an_error_of_an_estimate_ends_the_capture() -> None:
    with pytest.raises(DataError, match="do not fit"):
        capture(FakeRig([panorama(0)]), task(1, failure=DataError("images do not fit")))


def test_no_frame_at_all_says_where_to_look() -> None:
    with pytest.raises(RigError, match="no frame has arrived"):
        capture(FakeRig([]), task(1))


def test_estimates_double_their_sets() -> None:
    assert doublings(1) == []
    assert doublings(5) == [1, 2, 4]
    assert doublings(8) == [1, 2, 4]
