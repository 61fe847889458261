"""What --calibrate is asked to do, and what its result remembers."""

import numpy as np
import pytest

from rig_calib.calibration import CalibrationResult
from rig_calib.rig_calibration import CalibratedCamera, RigCalibration
from rig_protocol.camera import CameraModel
from rig_protocol.errors import ConfigurationError
from rig_protocol.messages import Hello
from rig_server.calibration_task import CalibrationTask, Estimate
from rig_server.config import CameraSettings, RigSettings

KNOWN = RigCalibration(
    "joint",
    "ring",
    (CalibratedCamera(0, "cam00", np.eye(4), serial="OLD0"), CalibratedCamera(1, "door", np.eye(4))),
    (),
    None,
    {},
    1,
    provenance={"source": "folder", "agents": 0},
)


def hello(serial: str) -> Hello:
    return Hello("pi", 0, serial, None, CameraModel(), (1,), (32,), 30.0, "rig-agent 0.1")


def estimate(missed: str | None = None, failures: tuple[str, ...] = ()) -> Estimate:
    calibration = RigCalibration("joint", "ring", KNOWN.cameras, (), None, {}, 1, failures=failures)
    return Estimate(1, CalibrationResult(calibration, (), {}, None), [], (), missed)


def settings(**capture: object) -> RigSettings:
    return RigSettings.model_validate({"capture": capture})


def test_a_result_remembers_serials_source_agents_versions_settings_and_target() -> None:
    task = CalibrationTask.whole_rig(settings(target_mm=3.0))
    stamped = task.stamped(estimate("1 mm too much"), {0: hello("S0")}, "udp")
    assert [camera.serial for camera in stamped.cameras] == ["S0", None]
    assert stamped.created
    assert stamped.provenance["source"] == "udp"
    assert stamped.provenance["agents"] == 1
    assert stamped.provenance["agent_software"] == ["rig-agent 0.1"]
    assert {"kinect-rig", "numpy", "python"} <= stamped.provenance["versions"].keys()
    assert stamped.provenance["settings"]["capture"]["frames"] == 5
    assert stamped.provenance["target"] == {"deg": None, "mm": 3.0, "missed": "1 mm too much"}


def test_a_recalibrated_camera_is_recorded_and_nothing_is_written_of_the_others() -> None:
    task = CalibrationTask.one_camera(settings(), KNOWN, "door")
    stamped = task.stamped(estimate(), {0: hello("S0"), 1: hello("S1")}, "udp")
    assert [camera.serial for camera in stamped.cameras] == ["OLD0", "S1"]
    assert stamped.provenance["source"] == "folder"
    (record,) = stamped.provenance["recalibrated"]
    assert (record["camera"], record["name"], record["source"], record["frames"]) == (1, "door", "udp", 1)
    assert record["when"] == stamped.created


@pytest.mark.parametrize(
    ("made", "content"),
    [(estimate(), True), (estimate("1 mm"), False), (estimate(failures=("no camera",)), False)],
)
def test_content_is_what_passes_gate_and_target(made: Estimate, content: bool) -> None:
    assert CalibrationTask.whole_rig(settings(target_mm=3.0)).contents(made) == content


def test_cameras_are_named_by_the_calibration_by_rig_toml_or_by_id() -> None:
    listed = RigSettings(cameras=(CameraSettings(id=4, name="hall"),))
    found = [CalibrationTask.one_camera(listed, KNOWN, word).camera_id for word in ("door", "hall", "0", "9")]
    assert found == [1, 4, 0, 9]
    with pytest.raises(ConfigurationError, match="no camera is called 'dor'"):
        CalibrationTask.one_camera(listed, KNOWN, "dor")


def test_what_needs_a_covariance_is_refused_for_the_papers_method() -> None:
    paper = RigSettings.model_validate({"calibration": {"method": "paper"}, "capture": {"target_mm": 3.0}})
    with pytest.raises(ConfigurationError, match="paper"):
        CalibrationTask.whole_rig(paper)
    with pytest.raises(ConfigurationError, match="paper"):
        CalibrationTask.one_camera(paper, KNOWN, "door")
