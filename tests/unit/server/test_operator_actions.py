"""Rules of what a person can have the rig do: every answer is a sentence, and nothing is overwritten."""

import re
import threading
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest

from rig_protocol.errors import ConfigurationError, RigError
from rig_protocol.events import ControlAnswered, Outcome
from rig_protocol.messages import ControlValue
from rig_protocol.recorder import RecordingStatus
from rig_server.config import RecordingSettings, RigSettings
from rig_server.metrics import CameraMetrics, RigStatus
from rig_server.operator_actions import RigActions
from rig_server.operator_requests import find_camera_id
from rig_server.session_view import Phase, SessionView


class FakeRig:
    """Two cameras; remembers what it was told."""

    def __init__(self, folder: Path, refusing: Mapping[int, str] | None = None) -> None:
        self.settings = RigSettings(recording=RecordingSettings(folder=folder))
        self.refusing = refusing or {}
        self.connected = (0, 1)
        self.told: list[tuple[int | None, str, ControlValue]] = []
        self.changed = threading.Condition()
        self.recording: RecordingStatus | None = None

    def status(self) -> RigStatus:
        return RigStatus(tuple(CameraMetrics(i, f"cam{i:02d}", connected=True) for i in (0, 1)))

    def control(self, camera: int | None, name: str, value: ControlValue) -> dict[int, ControlAnswered]:
        with self.changed:
            self.told.append((camera, name, value))
            self.changed.notify_all()
        cameras = self.connected if camera is None else (camera,)
        return {
            i: ControlAnswered(
                i, 0, Outcome.REFUSED if i in self.refusing else Outcome.DONE, self.refusing.get(i, "")
            )
            for i in cameras
        }

    def start_recording(self, path: Path) -> None:
        path.touch()
        self.recording = RecordingStatus(path, 12.0, 360, 1_230_000_000, dropped=3)

    def stop_recording(self) -> RecordingStatus | None:
        return self.recording

    def until_told(self, count: int) -> list[tuple[int | None, str, ControlValue]]:
        with self.changed:
            assert self.changed.wait_for(lambda: len(self.told) >= count, 30)
            return self.told


class FakeSession:
    """Remembers what it was asked."""

    def __init__(self) -> None:
        self.view = SessionView(Phase.WAITING, wanted=5)
        self.asked: list[object] = []

    def start(self, *arguments: object) -> None:
        self.asked.append(arguments)

    def accept(self) -> None:
        self.view = SessionView(message="out/calibration.json is in force")

    def reject(self) -> None:
        raise RigError("no calibration is ready")

    def cancel(self) -> None:
        self.view = SessionView(message="the calibration was given up")


def actions(rig: FakeRig, identify_s: float = 60.0) -> RigActions:
    return RigActions(rig, FakeSession(), identify_s)  # type: ignore[arg-type]


def test_a_lamp_blinks_for_a_while_and_is_ordinary_again(tmp_path: Path) -> None:
    rig = FakeRig(tmp_path)
    assert (
        actions(rig, identify_s=0.01).identify("cam01") == "cam01: the lamp blinks red and yellow for 0.01 s"
    )
    assert rig.until_told(2) == [(1, "led", "blink_red_yellow"), (1, "led", "green")]


def test_the_end_leaves_no_lamp_blinking(tmp_path: Path) -> None:
    rig = FakeRig(tmp_path)
    one = actions(rig)
    one.identify(0)
    one.identify(0)
    one.identify()
    one.close()
    assert rig.told[3:] == [(0, "led", "green"), (None, "led", "green")]


@pytest.mark.parametrize(("auto", "told"), [(True, "adapts"), (False, "held")])
def test_exposure_adapts_or_is_held_for_one_or_for_all(tmp_path: Path, auto: bool, told: str) -> None:
    rig = FakeRig(tmp_path)
    assert re.match(f"every camera: exposure .*{told}", actions(rig).expose(None, auto))
    assert actions(rig).expose("cam00", auto).startswith("cam00: ")
    assert rig.told == [(None, "auto_exposure", auto), (0, "auto_exposure", auto)]


def test_who_did_not_and_why_is_told(tmp_path: Path) -> None:
    rig = FakeRig(tmp_path, refusing={1: "this camera has no auto_exposure"})
    with pytest.raises(RigError, match="1 of 2 cameras did not set auto_exposure: cam01: this camera has no"):
        actions(rig).expose(None, auto=True)
    rig.connected = ()
    with pytest.raises(RigError, match="no camera is connected"):
        actions(rig).identify()
    with pytest.raises(ConfigurationError, match="no camera 'cam07': this rig has cam00"):
        actions(rig).identify("cam07")


def test_takes_are_named_by_date_and_never_by_a_name_that_exists(tmp_path: Path) -> None:
    rig = FakeRig(tmp_path / "new" / "takes")
    told = [actions(rig).start_recording() for _ in range(3)]
    names = [Path(sentence.removeprefix("recording to ")).name for sentence in told]
    assert len(set(names)) == 3
    for name in names:
        assert re.fullmatch(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d(_\d)?\.mcap", name)
    assert {path.name for path in (tmp_path / "new" / "takes").iterdir()} == set(names)


@pytest.mark.parametrize("name", ["hall", "hall.mcap"])
def test_a_take_may_be_given_a_name(tmp_path: Path, name: str) -> None:
    assert actions(FakeRig(tmp_path)).start_recording(name) == f"recording to {tmp_path / 'hall.mcap'}"


@pytest.mark.parametrize(
    "name",
    ["/etc/passwd", "../hall", "a/b", "..", ".hidden", "a\\b", "a\nb", "a\0b", "x" * 101, "hall.001.mcap"],
)
def test_no_name_leads_out_of_the_folder_or_into_another_take(tmp_path: Path, name: str) -> None:
    rig = FakeRig(tmp_path)
    with pytest.raises(ConfigurationError, match=re.escape(repr(name))):
        actions(rig).start_recording(name)
    assert rig.recording is None


def test_the_end_of_a_recording_says_how_it_was(tmp_path: Path) -> None:
    rig = FakeRig(tmp_path)
    with pytest.raises(RigError, match="nothing is being recorded"):
        actions(rig).stop_recording()
    actions(rig).start_recording("hall")
    assert actions(rig).stop_recording() == (
        f"recorded 0:12, 1.23 GB to {tmp_path / 'hall.mcap'}; the disk was too slow for 3 frames"
    )


def test_calibrating_is_left_to_the_session_and_told_in_its_words(tmp_path: Path) -> None:
    session = FakeSession()
    one = RigActions(FakeRig(tmp_path), session)  # type: ignore[arg-type]
    assert "the whole rig on 5 complete sets" in one.start_calibration()
    assert "camera cam01" in one.start_calibration("cam01", coached=True, frames=5)
    assert session.asked == [(None, False, None), ("cam01", True, 5)]
    assert one.cancel_calibration() == "the calibration was given up"
    assert one.accept_calibration() == "out/calibration.json is in force"
    with pytest.raises(RigError, match="no calibration is ready"):
        one.reject_calibration()


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    start: Callable[[], str] = actions(FakeRig(tmp_path / "file" / "takes")).start_recording
    with pytest.raises(ConfigurationError, match=r"recording\.folder"):
        start()


def test_a_number_is_the_camera_in_that_slot_whatever_others_are_called() -> None:
    names = {0: "1", 1: "cam01"}
    assert [find_camera_id(camera, names) for camera in (1, "1", 0, "cam01")] == [1, 1, 0, 1]
