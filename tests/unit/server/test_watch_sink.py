"""The watching sink: nobody waits for it, alarms are told once, and its own end is no secret."""

import logging
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from rig_calib.drift.watch import CameraDrift, DriftStatus
from rig_protocol.errors import ConfigurationError
from rig_protocol.frames import PanoramicFrame, RgbdFrame
from rig_protocol.rig_folder import RigDescription
from rig_server import Rig
from rig_server.config import RigSettings, load_rig_settings
from rig_server.sinks.watch import WatchSink
from support.box_room import calibration_of, ring_poses
from support.rig_processes import write_small_rig

CALIBRATION = calibration_of(ring_poses(3))
DESCRIPTION = RigDescription(())
MOVED = DriftStatus((CameraDrift(1, "moved", 0.5, 2.0, 0.01, 0.3, "its own view"),), looks=1)


class Script:
    """In place of the watch: holds every look until `go`, and then finds the next status of a script."""

    def __init__(self, *statuses: DriftStatus | Exception) -> None:
        self.go, self.looking, self.done = (
            threading.Semaphore(0),
            threading.Semaphore(0),
            threading.Semaphore(0),
        )
        self.taken: list[int] = []
        self._statuses = list(statuses)

    def take(self, _: RigDescription, panorama: PanoramicFrame) -> None:
        self.taken.append(panorama.index)
        self.looking.release()
        self.go.acquire()

    def status(self) -> DriftStatus:
        self.done.release()
        status = self._statuses.pop(0)
        if isinstance(status, Exception):
            raise status
        return status


@pytest.fixture
def sinks() -> Iterator[list[WatchSink]]:
    made: list[WatchSink] = []
    yield made
    for sink in made:
        sink.stop()


def started(sinks: list[WatchSink], script: Script, every: int = 1) -> WatchSink:
    sink = WatchSink(CALIBRATION, every)
    sink._watch = script  # type: ignore[assignment]  # the real one would need real images
    sink.start()
    sinks.append(sink)
    return sink


def offer(sink: WatchSink, index: int) -> None:
    sink.offer(PanoramicFrame.of(index, {0: RgbdFrame(0, index, 0)}), lambda: DESCRIPTION)


def test_a_busy_watch_passes_sets_over_and_nobody_waits(sinks: list[WatchSink]) -> None:
    script = Script(*[DriftStatus()] * 3)
    sink = started(sinks, script)
    offer(sink, 0)
    assert script.looking.acquire(timeout=10)
    for index in range(1, 100):  # one waits, the others are passed over
        offer(sink, index)
    assert sink.report().passed_over == 98
    script.go.release(2)
    assert script.looking.acquire(timeout=10)
    assert script.taken == [0, 1]


def test_it_looks_at_one_set_in_so_many(sinks: list[WatchSink]) -> None:
    script = Script(DriftStatus())
    sink = started(sinks, script, every=4)
    for index in range(7):
        offer(sink, index)
    assert script.looking.acquire(timeout=10)
    assert script.taken == [3]
    script.go.release()


def test_a_camera_that_moved_is_told_once_and_so_is_its_return(
    sinks: list[WatchSink], caplog: pytest.LogCaptureFixture
) -> None:
    script = Script(MOVED, MOVED, DriftStatus(looks=3))
    sink = started(sinks, script)
    script.go.release(3)
    for index in range(3):
        offer(sink, index)
        assert script.done.acquire(timeout=10)
    sink.stop()
    errors = [record.message for record in caplog.records if record.levelno == logging.ERROR]
    assert len(errors) == 1
    assert "cam01 has moved by 0.50°" in errors[0]
    assert "--recalibrate 1" in errors[0]
    assert "cam01 is in its place again" in caplog.text
    assert sink.report().status.moved == ()


def test_a_watch_that_breaks_says_so_and_the_rig_goes_on(
    sinks: list[WatchSink], caplog: pytest.LogCaptureFixture
) -> None:
    script = Script(ValueError("no such thing"))
    sink = started(sinks, script)
    script.go.release()
    offer(sink, 0)
    assert script.done.acquire(timeout=10)
    sink.stop()
    assert "no such thing" in str(sink.report().failure)
    offer(sink, 1)
    assert "the drift watch has ended" in caplog.text


def test_a_watch_ends_though_nobody_ever_began_it() -> None:
    WatchSink(CALIBRATION, 1).stop()


def test_the_calibration_in_rig_toml_is_relative_to_it_and_on_the_command_line_to_here(
    tmp_path: Path,
) -> None:
    file = tmp_path / "rig.toml"
    file.write_text('[watch]\ncalibration = "results/calibration.json"\n')
    assert load_rig_settings(file).watch.calibration == tmp_path / "results/calibration.json"
    here = {"watch": {"calibration": Path("calibration.json")}}
    assert load_rig_settings(file, here).watch.calibration == Path("calibration.json")


def test_a_calibration_that_is_none_is_refused(tmp_path: Path) -> None:
    write_small_rig(tmp_path, cameras=2)
    settings = RigSettings.model_validate({"watch": {"calibration": tmp_path / "nominal.json"}})
    with pytest.raises(ConfigurationError, match=r"watch\.calibration"):
        Rig.open(tmp_path, settings)


def test_a_watched_rig_reports_with_its_status(tmp_path: Path) -> None:
    """Images of noise: no camera can be judged, and none is called moved."""
    write_small_rig(tmp_path / "rig", cameras=3, shape=(480, 640))
    CALIBRATION.save(tmp_path / "calibration.json")
    watch = {"calibration": tmp_path / "calibration.json", "every": 1}
    with Rig.open(tmp_path / "rig", RigSettings.model_validate({"watch": watch})) as rig:
        assert len(list(rig)) == 2
    drift = rig.status().drift
    assert drift is not None
    assert drift.status.looks + drift.passed_over >= 1
    assert drift.status.moved == ()
    assert np.isfinite(drift.status.rig_mm)
