"""One camera found anew on a synthetic arc: the others stay bit by bit, and its covariance holds theirs."""

from dataclasses import replace

import numpy as np
import pytest

from rig_calib import calibration as pipeline
from rig_calib.calibration import CalibrationResult, calibrate
from rig_calib.observed_camera import ObservedCamera
from rig_calib.provenance import with_recalibration
from rig_calib.recalibration import find_camera, recalibrate
from rig_calib.rig_calibration import CalibratedCamera, RigCalibration
from rig_calib.settings import CalibrationSettings
from rig_calib.view import CameraView
from rig_protocol.errors import ConfigurationError
from rig_protocol.poses import inverse, se3_exp, se3_log
from support.synthetic_rig import SyntheticRig, pose_distance

SETTINGS = CalibrationSettings()
MOVED = 2
KNOCK = np.array([0.03, -0.05, 0.02, 0.01, 0.02, -0.02])  # 3.5° and 30 mm
# 99.99 % of a squared normal error in six dimensions: a covariance that is right fails once in 10,000.
CONSISTENT = 27.9


class Capture:
    """A synthetic arc of five cameras with a percent of depth bias, seen again with fresh noise each time."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, drawn: bool = True) -> None:
        self.rig = SyntheticRig(cameras=5, bias=0.01)
        self.drawn = drawn
        self.hidden: set[int] = set()
        self._captures = 0
        monkeypatch.setattr(pipeline, "observe", self._observe)

    def calibrate(self) -> RigCalibration:
        self._captures += 1
        return calibrate(self.rig.views(self.drawn), self._ring(), SETTINGS).calibration

    def knock(self, camera: int, by: np.ndarray = KNOCK) -> None:
        self.rig.truth[camera] = self.rig.truth[camera] @ se3_exp(by)

    def recalibrate(
        self, known: RigCalibration, camera: int = MOVED, settings: CalibrationSettings = SETTINGS
    ) -> CalibrationResult:
        self._captures += 1
        return recalibrate(self.rig.views(self.drawn), known, camera, self._ring(), settings)

    def _ring(self) -> object:
        return self.rig.drawing if self.drawn else None

    def _observe(self, view: CameraView, *_: object) -> ObservedCamera:
        only = np.arange(0) if view.camera_id in self.hidden else None
        seen = self.rig.observe(view.camera_id, 0.25, 0.3, self._captures, only, self.drawn)
        return replace(seen, view=view)


@pytest.fixture
def capture(monkeypatch: pytest.MonkeyPatch) -> Capture:
    return Capture(monkeypatch)


def squared_error(known: RigCalibration, rig: SyntheticRig, i: int, j: int) -> float:
    """Of T_i_j against the truth, in units of its covariance."""
    T_i_j = inverse(known.poses[i]) @ known.poses[j]
    e = se3_log(inverse(T_i_j) @ inverse(rig.truth[i]) @ rig.truth[j])
    covariance = known.relative_covariance(i, j)
    assert covariance is not None
    return float(e @ np.linalg.solve(covariance, e))


def test_a_knocked_camera_is_found_and_the_others_stay_bit_by_bit(capture: Capture) -> None:
    known = capture.calibrate()
    capture.knock(MOVED)
    found = capture.recalibrate(known).calibration
    assert found.failures == ()
    before, after = known.to_dict(), found.to_dict()
    for old, new in zip(before["cameras"], after["cameras"], strict=True):
        assert (old == new) == (old["id"] != MOVED)
    for old, new in zip(before["edges"], after["edges"], strict=True):
        assert (old == new) == (MOVED not in (old["i"], old["j"]))
    for neighbour in (MOVED - 1, MOVED + 1):
        true = inverse(capture.rig.truth[neighbour]) @ capture.rig.truth[MOVED]
        off_deg, off_mm = pose_distance(inverse(found.poses[neighbour]) @ found.poses[MOVED], true)
        assert off_deg < 0.25  # three expected errors of a pair
        assert off_mm < 6.0
        assert squared_error(found, capture.rig, neighbour, MOVED) < CONSISTENT
    assert any(f"camera {MOVED} " in told and "drawing" in told for told in found.warnings)


def test_its_covariance_holds_the_uncertainty_of_those_it_hangs_on(capture: Capture) -> None:
    """In the drawing's frame all cameras share a common turn, known to none."""
    known = capture.calibrate()
    capture.knock(MOVED)
    found = capture.recalibrate(known).calibration
    camera, neighbour = found.camera(MOVED), found.camera(MOVED + 1)
    assert camera is not None
    assert neighbour is not None
    assert camera.covariance is not None
    assert neighbour.covariance is not None
    relative = found.relative_covariance(MOVED + 1, MOVED)
    assert relative is not None
    rotation = slice(0, 3)
    own = np.trace(camera.covariance[rotation, rotation])
    assert own > np.trace(neighbour.covariance[rotation, rotation])
    assert np.trace(relative[rotation, rotation]) < 0.2 * own
    e = se3_log(inverse(camera.T_rig_camera) @ capture.rig.truth[MOVED])
    assert e @ np.linalg.solve(camera.covariance, e) < CONSISTENT
    assert camera.aligned_covariance is not None
    assert np.trace(camera.aligned_covariance[rotation, rotation]) < 0.2 * own
    edge = next(edge for edge in found.edges if (edge.i, edge.j) == (MOVED, MOVED + 1))
    np.testing.assert_array_equal(edge.relative_covariance, found.relative_covariance(MOVED, MOVED + 1))
    joint = found.joint_covariance
    assert joint is not None
    assert np.linalg.eigvalsh(joint)[0] > 0.0
    kept = np.delete(np.arange(30), np.arange(6 * MOVED, 6 * MOVED + 6))
    assert known.joint_covariance is not None
    assert np.array_equal(joint[np.ix_(kept, kept)], known.joint_covariance[np.ix_(kept, kept)])


def test_a_camera_turned_to_where_its_old_overlaps_are_not_is_found_too(capture: Capture) -> None:
    known = capture.calibrate()
    capture.knock(MOVED, np.array([np.deg2rad(25.0), 0.0, 0.0, 0.0, 0.0, 0.0]))  # about the vertical
    found = capture.recalibrate(known).calibration
    assert found.failures == ()
    true = inverse(capture.rig.truth[MOVED + 1]) @ capture.rig.truth[MOVED]
    off_deg, off_mm = pose_distance(inverse(found.poses[MOVED + 1]) @ found.poses[MOVED], true)
    assert off_deg < 0.5
    assert off_mm < 12.0


def test_a_camera_that_could_not_be_placed_is_added(monkeypatch: pytest.MonkeyPatch) -> None:
    capture = Capture(monkeypatch, drawn=False)
    capture.hidden = {MOVED}
    known = capture.calibrate()
    assert known.camera(MOVED) is None
    capture.hidden = set()
    found = capture.recalibrate(known).calibration
    # Without it the arc was in two parts, of which only one was placed.
    assert MOVED in found.poses
    assert [camera.id for camera in found.cameras] == sorted(found.poses)
    assert not any(f"camera {MOVED} " in failure for failure in found.failures)


def test_a_camera_that_only_the_drawing_placed_is_found(capture: Capture) -> None:
    capture.hidden = {MOVED}
    known = capture.calibrate()
    assert any(f"cameras {MOVED} and {MOVED + 1}" in failure for failure in known.failures)
    capture.hidden = set()
    found = capture.recalibrate(known).calibration
    before, after = known.camera(MOVED), found.camera(MOVED)
    assert before is not None
    assert after is not None
    assert before.T_rig_camera.tobytes() != after.T_rig_camera.tobytes()
    assert squared_error(found, capture.rig, MOVED, MOVED + 1) < CONSISTENT


def test_a_second_camera_that_moved_is_named(capture: Capture) -> None:
    known = capture.calibrate()
    capture.knock(MOVED)
    capture.knock(MOVED + 1, np.array([0.0, np.deg2rad(1.0), 0.0, 0.005, 0.0, 0.0]))
    failures = capture.recalibrate(known).calibration.failures
    assert len(failures) == 1
    assert "camera 3 (cam03)" in failures[0]
    assert "has moved, too" in failures[0]


def test_without_support_everything_stays_and_the_failure_says_what_to_do(capture: Capture) -> None:
    known = capture.calibrate()
    capture.hidden = {MOVED}
    found = capture.recalibrate(known).calibration
    assert found.to_dict()["cameras"] == known.to_dict()["cameras"]
    assert any("camera 2 (cam02)" in failure and "patterns" in failure for failure in found.failures)


def test_a_single_overlap_is_warned_about(capture: Capture) -> None:
    known = capture.calibrate()
    capture.hidden = {MOVED + 1}
    found = capture.recalibrate(known).calibration
    assert found.failures == ()
    assert any("only one overlap holds camera 2" in warning for warning in found.warnings)


def test_a_calibration_relative_to_camera_0_keeps_its_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    capture = Capture(monkeypatch, drawn=False)
    known = capture.calibrate()
    capture.knock(MOVED)
    found = capture.recalibrate(known).calibration
    assert found.failures == ()
    assert found.rig_frame == "camera 0"
    assert squared_error(found, capture.rig, 0, MOVED) < CONSISTENT
    with pytest.raises(ConfigurationError, match="camera 0 defines the frame"):
        capture.recalibrate(known, 0)


def test_a_file_without_a_joint_covariance_will_do(capture: Capture) -> None:
    known = replace(capture.calibrate(), joint_covariance=None)
    capture.knock(MOVED)
    found = capture.recalibrate(known).calibration
    assert found.failures == ()
    camera = found.camera(MOVED)
    assert camera is not None
    assert camera.covariance is not None
    assert np.linalg.eigvalsh(camera.covariance)[0] > 0.0


def test_what_cannot_be_recalibrated_is_refused(capture: Capture) -> None:
    known = capture.calibrate()
    with pytest.raises(ConfigurationError, match="camera 9 is not in this capture"):
        capture.recalibrate(known, 9)
    with pytest.raises(ConfigurationError, match="method"):
        capture.recalibrate(known, settings=CalibrationSettings(method="paper"))


@pytest.mark.parametrize(("word", "camera_id"), [("door", 3), ("3", 3), ("7", 7), ("hall", 7)])
def test_a_camera_goes_by_name_or_id(word: str, camera_id: int) -> None:
    known = RigCalibration("joint", "ring", (CalibratedCamera(3, "door", np.eye(4)),), (), None, {}, 1)
    assert find_camera(word, known, {7: "hall"}) == camera_id


def test_a_number_is_that_camera_whatever_another_one_is_called() -> None:
    known = RigCalibration("joint", "ring", (), (), None, {}, 1)
    assert find_camera("1", known, {0: "1", 1: "door"}) == 1


def test_an_unknown_name_is_answered_with_those_there_are() -> None:
    known = RigCalibration("joint", "ring", (), (), None, {}, 1)
    with pytest.raises(ConfigurationError, match=r"no camera is called 'dor'; there are door \(3\)"):
        find_camera("dor", known, {3: "door"})


def test_the_file_remembers_which_camera_was_recalibrated_and_when(capture: Capture) -> None:
    known = replace(capture.calibrate(), provenance={"source": "udp", "agents": 5})
    capture.knock(MOVED)
    once = with_recalibration(capture.recalibrate(known).calibration, known, MOVED, 4, source="folder")
    twice = with_recalibration(once, once, MOVED, 1, source="udp")
    records = twice.provenance["recalibrated"]
    assert twice.provenance["source"] == "udp"
    assert [(one["camera"], one["name"], one["frames"]) for one in records] == [
        (2, "cam02", 4),
        (2, "cam02", 1),
    ]
    assert records[0]["when"] == once.created
    assert records[0]["moved"]["deg"] == pytest.approx(3.5, abs=0.3)
    assert records[0]["moved"]["mm"] == pytest.approx(30.0, abs=6.0)


def test_the_covariance_of_every_pair_survives_the_file(capture: Capture) -> None:
    known = capture.calibrate()
    read = RigCalibration.from_dict(known.to_dict())
    assert known.relative_covariance(0, 4) is not None
    np.testing.assert_array_equal(read.relative_covariance(0, 4), known.relative_covariance(0, 4))
