"""Rules of a calibration beside a running rig: it disturbs nobody, and a person decides what is in force."""

import re
import threading
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest

from rig_calib.coaching import Support
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.camera import CameraModel
from rig_protocol.errors import ConfigurationError, DataError, RigError
from rig_protocol.events import ControlAnswered, Outcome
from rig_protocol.frames import PanoramicFrame, RgbdFrame
from rig_protocol.messages import Hello
from rig_protocol.rig_folder import CameraEntry, RigDescription
from rig_server.calibration_session import CalibrationSession, Phase, SessionView
from rig_server.calibration_task import CalibrationTask
from rig_server.capture_log import CaptureLog
from rig_server.config import CaptureSettings, RigSettings, SynchroniserSettings
from rig_server.metrics import RigStatus
from rig_server.offered_sets import OfferedSets
from rig_server.receiver import rig_time_ns
from support.box_room import calibration_of
from support.scripted_estimates import ScriptedEstimates

CAMERAS = (0, 1)
RAW = np.full((2, 2), 900, np.uint16)


class RunningRig:
    """Two cameras of a rig that somebody else takes the sets of; nobody here may end it."""

    source = "udp"
    ended = False

    def __init__(self, **capture: object) -> None:
        self.settings = RigSettings(capture=CaptureSettings.model_validate({"frames": 2} | capture))
        self.description = RigDescription(
            tuple(CameraEntry(i, f"cam{i:02d}", CameraModel()) for i in CAMERAS)
        )
        self.hellos: dict[int, Hello] = {}
        self.calibration: RigCalibration | None = None
        self.absent: str | None = None
        self.here = threading.Event()
        self.here.set()
        self.on = set(CAMERAS)

    def wait_for_cameras(self, timeout_s: float, on_wait: Callable[[RigStatus], None]) -> None:
        if self.absent is not None:
            raise RigError(f"after {timeout_s:.0f} s {self.absent}")
        while not self.here.wait(0.01):
            on_wait(RigStatus(()))

    def put_in_force(self, calibration: RigCalibration) -> None:
        self.calibration = calibration

    def control(self, cameras: Collection[int], name: str, value: bool) -> Mapping[int, ControlAnswered]:
        assert name == "depth"
        self.on = self.on | set(cameras) if value else self.on - set(cameras)
        return {i: ControlAnswered(i, 0, Outcome.DONE, "") for i in cameras}

    def panorama(self, index: int, damaged: bool = False, missing: bool = False) -> PanoramicFrame:
        now_ns = rig_time_ns() + 10**9  # after any switching
        frames: dict[int, RgbdFrame | None] = {
            i: RgbdFrame(i, index, now_ns, raw=RAW if i in self.on else None, damaged=damaged and i == 0)
            for i in CAMERAS
        }
        return PanoramicFrame.of(index, frames | ({1: None} if missing else {}))


def hello(camera_id: int) -> Hello:
    name, codecs = f"cam{camera_id:02d}", {"color_codecs": (2,), "depth_codecs": (5,)}
    return Hello(name, camera_id, None, None, CameraModel(), fps=30.0, software="0", **codecs)


class Beside:
    """A session beside a rig, and the thread that takes the rig's sets and hands them over."""

    def __init__(self, folder: Path, rig: RunningRig) -> None:
        self.rig, self.folder = rig, folder
        self.session = CalibrationSession(rig, folder)  # type: ignore[arg-type]
        self._next = 0
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    def run(self) -> None:
        """Take sets until the end of the test."""
        self._thread = threading.Thread(target=self._take_sets, daemon=True)
        self._thread.start()

    def _take_sets(self) -> None:
        while not self._stopping.wait(0.002):
            self.session.offer(self.rig.panorama(self._next))
            self._next += 1

    def until(self, *phases: Phase) -> SessionView:
        """The view as soon as it is at one of the phases."""
        waiting = threading.Event()
        for _ in range(3000):
            view = self.session.view
            if view.phase in phases:
                return view
            assert view.phase is not Phase.FAILED, view.message
            waiting.wait(0.01)
        raise AssertionError(f"still {self.session.view}")

    def close(self) -> None:
        self._stopping.set()
        if self._thread is not None:
            self._thread.join()
        self.session.close()


@pytest.fixture
def estimates(monkeypatch: pytest.MonkeyPatch) -> ScriptedEstimates:
    scripted = ScriptedEstimates({i: np.eye(4) for i in CAMERAS})
    monkeypatch.setattr(CalibrationTask, "estimate", lambda *arguments: scripted(*arguments))
    return scripted


@pytest.fixture
def make(tmp_path: Path, estimates: ScriptedEstimates) -> Iterator[Callable[..., Beside]]:  # noqa: ARG001
    made: list[Beside] = []

    def beside(rig: RunningRig | None = None) -> Beside:
        made.append(Beside(tmp_path / "out", rig or RunningRig()))
        return made[-1]

    yield beside
    for one in made:
        one.close()


@pytest.fixture
def ready(make: Callable[..., Beside], monkeypatch: pytest.MonkeyPatch) -> Beside:
    """A session whose result waits for its decision; files are written without pictures."""
    beside = make()

    def write(folder: Path, calibration: RigCalibration, *_: object) -> None:
        calibration.save(folder / "calibration.json")

    monkeypatch.setattr("rig_server.calibration_session.write_outputs", write)
    beside.run()
    beside.session.start()
    beside.until(Phase.READY)
    return beside


def test_only_complete_undamaged_sets_count(
    make: Callable[..., Beside], estimates: ScriptedEstimates
) -> None:
    beside = make()
    session, rig = beside.session, beside.rig
    session.start()
    rig_sets = [
        rig.panorama(0, damaged=True),
        rig.panorama(1),
        rig.panorama(2, missing=True),
        rig.panorama(3),
    ]
    for one in rig_sets:
        session.offer(one)
    view = beside.until(Phase.READY)
    assert estimates.on[-1] == [1, 3]
    assert (view.sets, view.wanted) == (2, 2)
    assert view.headline == "on 2 sets: 1 of 1 overlap good"


def test_before_anybody_asks_nothing_is_collected_and_nothing_can_be_decided(
    make: Callable[..., Beside],
) -> None:
    beside = make()
    beside.session.offer(beside.rig.panorama(0))
    assert beside.session.view.phase is Phase.IDLE
    assert beside.session.candidate is None
    for decide in (beside.session.accept, beside.session.reject):
        with pytest.raises(RigError, match="no calibration is ready"):
            decide()
    beside.session.cancel()
    assert beside.session.view.phase is Phase.IDLE


def test_it_waits_for_the_cameras_first(make: Callable[..., Beside]) -> None:
    beside = make()
    beside.rig.here.clear()
    beside.run()
    beside.session.start()
    assert beside.until(Phase.WAITING).sets == 0
    beside.rig.here.set()
    beside.until(Phase.READY)


def test_accepting_writes_the_files_keeps_the_one_before_and_puts_it_in_force(ready: Beside) -> None:
    (ready.folder / "calibration.json").write_text("the one before")
    candidate = ready.session.candidate
    assert ready.rig.calibration is None, "nothing is in force before a person says so"
    path = ready.session.accept()
    assert path == ready.folder / "calibration.json"
    assert RigCalibration.load(path).provenance["source"] == "udp"
    assert (ready.folder / "calibration-before.json").read_text() == "the one before"
    assert ready.rig.calibration is candidate is not None
    assert (ready.session.view.phase, ready.session.candidate) == (Phase.IDLE, None)
    assert ready.session.view.message == f"{path} is in force"


def test_rejecting_leaves_in_force_what_was(ready: Beside) -> None:
    ready.rig.calibration = before = calibration_of({0: np.eye(4)})
    ready.session.reject()
    assert ready.rig.calibration is before
    assert list(ready.folder.iterdir()) == []
    assert (ready.session.view.phase, ready.session.candidate) == (Phase.IDLE, None)


def test_what_fails_its_gate_can_be_looked_at_and_not_be_accepted(
    ready: Beside, estimates: ScriptedEstimates
) -> None:
    ready.session.reject()
    estimates.failures = ("camera 1 (cam01) is not connected",)
    ready.session.start()
    assert ready.until(Phase.READY).failures == estimates.failures
    assert ready.session.candidate is not None
    with pytest.raises(RigError, match=r"fails its gate.*cam01"):
        ready.session.accept()
    assert ready.rig.calibration is None
    assert list(ready.folder.iterdir()) == []


def test_what_misses_its_target_may_be_accepted_and_says_so(
    ready: Beside, estimates: ScriptedEstimates
) -> None:
    ready.session.reject()
    estimates.missed = "cam00–cam01 by 2 mm"
    ready.session.start()
    assert ready.until(Phase.READY).missed == "cam00–cam01 by 2 mm"
    ready.session.accept()
    assert "misses its target: cam00–cam01 by 2 mm" in (ready.session.view.message or "")


def test_a_disk_that_fails_costs_nothing_but_another_try(
    ready: Beside, monkeypatch: pytest.MonkeyPatch
) -> None:
    def write(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("rig_server.calibration_session.write_outputs", write)
    with pytest.raises(RigError, match="cannot be written to: No space left"):
        ready.session.accept()
    assert ready.rig.calibration is None
    assert ready.session.view.phase is Phase.READY
    ready.session.reject()


def test_one_at_a_time_and_none_over_a_result_that_waits(ready: Beside) -> None:
    with pytest.raises(RigError, match="accept or reject"):
        ready.session.start()
    ready.session.reject()
    ready.rig.here.clear()
    ready.session.start()
    with pytest.raises(RigError, match="running"):
        ready.session.start()


def test_a_cancelled_one_ends_and_the_next_begins(make: Callable[..., Beside]) -> None:
    beside = make()
    beside.session.start()
    beside.until(Phase.COLLECTING)
    beside.session.cancel()
    assert beside.session.view.phase is Phase.IDLE
    assert "given up" in (beside.session.view.message or "")
    beside.run()
    beside.session.start()
    beside.until(Phase.READY)


def test_one_that_was_given_up_and_still_switches_projectors_is_waited_for(
    make: Callable[..., Beside], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rig_server.calibration_session._PATIENCE_S", 0.05)
    rig = RunningRig(projector_groups=2)
    rig.hellos = {i: hello(i) for i in CAMERAS}
    switching, switched = threading.Event(), threading.Event()

    def control(cameras: Collection[int], _name: str, _value: bool) -> Mapping[int, ControlAnswered]:
        switching.set()
        assert switched.wait(30)
        return {i: ControlAnswered(i, 0, Outcome.DONE, "") for i in cameras}

    monkeypatch.setattr(rig, "control", control)
    beside = make(rig)
    beside.session.start()
    assert switching.wait(30)
    beside.session.cancel()
    with pytest.raises(RigError, match="still ending"):
        beside.session.start()
    switched.set()


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (DataError("images do not fit"), "images do not fit"),
        (ValueError("a bug"), "programming error.*a bug"),
    ],
)
def test_what_fails_says_why_and_the_next_may_begin(
    make: Callable[..., Beside], estimates: ScriptedEstimates, error: Exception, told: str
) -> None:
    beside = make()
    beside.run()
    estimates.error = error
    beside.session.start()
    assert re.search(told, beside.until(Phase.FAILED).message or "")
    estimates.error = None
    beside.session.start()
    beside.until(Phase.READY)


def test_cameras_that_do_not_come_are_named(make: Callable[..., Beside]) -> None:
    rig = RunningRig()
    rig.absent = "camera cam01 is not here"
    beside = make(rig)
    beside.session.start()
    assert "cam01 is not here" in (beside.until(Phase.FAILED).message or "")


def test_a_coached_one_goes_on_with_fresh_sets_until_every_overlap_holds(
    make: Callable[..., Beside], estimates: ScriptedEstimates
) -> None:
    beside = make()
    estimates.support = lambda sets: Support.GOOD if min(sets) > 20 else Support.NOTHING
    beside.run()
    beside.session.start(coached=True)
    assert beside.until(Phase.READY).pairs[0].support is Support.GOOD
    assert min(estimates.on[-1]) > 20


def test_it_says_how_far_each_camera_is_from_where_it_was_whatever_the_rig_as_a_whole_did(
    make: Callable[..., Beside], estimates: ScriptedEstimates
) -> None:
    """Two cameras that moved by 10 mm from one another, in a rig that stands a metre further on."""
    before, after = np.eye(4), np.eye(4)
    before[0, 3], after[0, 3] = 0.22, 0.23
    elsewhere = np.eye(4)
    elsewhere[1, 3] = 1.0
    beside = make()
    beside.rig.calibration = calibration_of({0: np.eye(4), 1: before})
    estimates.poses = {0: elsewhere, 1: elsewhere @ after}
    beside.run()
    beside.session.start()
    moved = beside.until(Phase.READY).moved
    assert moved.keys() == {0, 1}
    for deg, mm in moved.values():
        assert deg == pytest.approx(0.0, abs=1e-6)
        assert mm == pytest.approx(5.0)


def test_projectors_take_turns_while_the_rig_runs_on_and_all_shine_again(
    make: Callable[..., Beside], estimates: ScriptedEstimates
) -> None:
    rig = RunningRig(projector_groups=2)
    rig.hellos = {i: hello(i) for i in CAMERAS}
    beside = make(rig)
    beside.run()
    beside.session.start()
    beside.until(Phase.READY)
    assert len(estimates.on[-1]) == 2
    assert rig.on == set(CAMERAS)


def refused(rig: RunningRig, told: str, tmp_path: Path, **start: object) -> None:
    session = CalibrationSession(rig, tmp_path)  # type: ignore[arg-type]
    with pytest.raises(ConfigurationError, match=told):
        session.start(**start)  # type: ignore[arg-type]
    assert session.view.phase is Phase.IDLE


def test_what_cannot_be_done_is_refused_before_it_begins(tmp_path: Path) -> None:
    refused(RunningRig(), "no calibration is in force", tmp_path, camera="cam01")
    refused(RunningRig(), "1 to 100 sets", tmp_path, frames=0)
    recorded = RunningRig(projector_groups=2)
    recorded.source = "recording"
    refused(recorded, "need a live rig", tmp_path)
    latest = RunningRig()
    latest.settings = RigSettings(synchroniser=SynchroniserSettings(policy="latest"))
    refused(latest, "repeats frames", tmp_path)
    known = RunningRig()
    known.calibration = calibration_of({i: np.eye(4) for i in CAMERAS})
    refused(known, "cam07", tmp_path, camera="cam07")
    (tmp_path / "file").touch()
    refused(RunningRig(), "cannot write", tmp_path / "file")


def test_a_capture_that_does_not_keep_up_loses_the_oldest_sets_and_nobody_waits() -> None:
    rig = RunningRig()
    sets = OfferedSets(rig)  # type: ignore[arg-type]
    for k in range(10):
        sets.offer(rig.panorama(k))
    taken = [one.index for one in iter(lambda: sets.next_panorama(0.0), None)]
    assert taken == [6, 7, 8, 9]
    assert sets.passed_over == 6
    sets.end_sets()
    sets.offer(rig.panorama(11))
    assert sets.next_panorama(0.0) is None


def test_it_shows_a_calibration_that_others_make_and_leaves_it_to_them(make: Callable[..., Beside]) -> None:
    session, log = make().session, CaptureLog(wanted=5)
    session.look_on(log)
    log.collected(3, 5)
    assert (session.view.phase, session.view.sets) == (Phase.COLLECTING, 3)
    log.ready()
    for act in (session.start, session.accept, session.reject):
        with pytest.raises(RigError, match="by itself"):
            act()
