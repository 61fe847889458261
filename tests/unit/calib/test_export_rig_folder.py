"""A take as a rig folder: the same images, the same description, and the same calibration from it."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from rig_agent.simulator.ring import VirtualRig, rig_description
from rig_agent.simulator.settings import SimulatorSettings
from rig_calib.frame_exports import rig_folder
from rig_calib.rig_folder_calibration import read_description, read_views
from rig_calib.view import CameraView
from rig_protocol.frames import PanoramicFrame
from rig_protocol.gravity import Gravity, common_gravity
from rig_protocol.rig_folder import read_frame, read_rig_description
from support.box_takes import POSES, box_description, box_frame, box_panorama, export_job, write_take


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sets 3 and 4 of a take, exported."""
    home = tmp_path_factory.mktemp("rig")
    take = write_take(home / "take.mcap", box_description(), [box_panorama(k) for k in (3, 4)])
    rig_folder.export(export_job(take, home / "out"))
    return home / "out"


@pytest.mark.parametrize("camera_id", POSES)
@pytest.mark.parametrize("k", [3, 4])
def test_images_are_the_sensors_bit_for_bit(folder: Path, camera_id: int, k: int) -> None:
    sent = box_frame(camera_id, k)
    directory = folder / f"cam{camera_id:02d}"
    for kind, expected in {"color": sent.color, "raw": sent.raw}.items():
        image = cv2.imread(str(directory / f"{kind}_{k:03d}.png"), cv2.IMREAD_UNCHANGED)
        assert np.array_equal(image, expected)
    read = read_frame(folder, box_description().camera(camera_id), k)
    assert np.array_equal(read.raw, sent.raw)


def test_the_description_is_the_takes_and_no_truth_is_told(folder: Path) -> None:
    told = json.loads((folder / "nominal.json").read_text())
    assert told == json.loads(json.dumps(box_description().to_dict()))
    assert sorted(path.name for path in folder.iterdir()) == ["cam00", "cam01", "cam02", "nominal.json"]


def test_gravity_that_never_changed_stays_bit_for_bit_the_same() -> None:
    felt = common_gravity([Gravity((0.999, 0.02, 0.03)), Gravity((0.998, 0.05, 0.04))])
    assert felt is not None
    assert common_gravity([felt] * 3) == common_gravity([felt] * 5) == felt


def test_a_calibration_is_given_the_same_as_of_the_take(tmp_path: Path) -> None:
    """To the last bit: views and the ring are all that it gets."""
    settings = SimulatorSettings(cameras=2, seed=5)
    rig, description = VirtualRig(settings), rig_description(settings)
    panoramas = [PanoramicFrame.of(k, {i: rig.camera(i).frame(k) for i in range(2)}) for k in range(2)]
    take = write_take(tmp_path / "take.mcap", description, panoramas)
    rig_folder.export(export_job(take, tmp_path / "out"))
    known = [read_description(source) for source in (take, tmp_path / "out")]
    assert known[0].ring == known[1].ring is not None
    of_take, of_folder = (
        [told(view) for view in read_views(source, description, 2)]
        for source, description in zip((take, tmp_path / "out"), known, strict=True)
    )
    assert len(of_take) == 2
    np.testing.assert_equal(of_folder, of_take)
    assert read_rig_description(tmp_path / "out").cameras[0].gravity is not None


def told(view: CameraView) -> dict[str, object]:
    """All that it holds."""
    fields = {name: getattr(view, name) for name in CameraView.__slots__}
    return fields | {"model": view.model.to_dict()}
