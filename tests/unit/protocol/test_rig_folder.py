"""Rules of the rig folder."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from rig_protocol.camera import CameraModel
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.frames import RgbdFrame
from rig_protocol.gravity import Gravity
from rig_protocol.rig_folder import (
    CameraEntry,
    RigDescription,
    RingDrawing,
    frame_indices,
    read_frame,
    read_rig_description,
    read_true_poses,
    write_rig_folder,
    write_true_poses,
)
from support.real_data import real_data

RNG = np.random.default_rng(7)
HUGE = "1" + "0" * 400
COLOR = RNG.integers(0, 256, (48, 64, 3), dtype=np.uint8)
RAW = RNG.integers(400, 1000, (48, 64), dtype=np.uint16)


def description(cameras: int = 2) -> RigDescription:
    ring = RingDrawing()
    entries = [CameraEntry(i, f"cam{i:02d}", CameraModel(), ring.T_rig_camera(i)) for i in range(cameras)]
    return RigDescription(tuple(entries), ring)


def test_a_folder_gives_back_what_was_written(tmp_path: Path) -> None:
    frames = [
        RgbdFrame(0, 3, 0, color=COLOR, raw=RAW),
        RgbdFrame(1, 3, 0, color=COLOR[..., 0].copy(), depth_mm=RAW, depth_frame="color"),
    ]
    write_rig_folder(tmp_path, description(), frames)
    again = read_rig_description(tmp_path)
    assert again.to_dict() == description().to_dict()
    assert frame_indices(tmp_path, "cam00") == [3]
    first, second = (read_frame(tmp_path, again.camera(i), 3) for i in (0, 1))
    np.testing.assert_array_equal(first.color, COLOR)
    np.testing.assert_array_equal(first.raw, RAW)
    np.testing.assert_array_equal(second.color, COLOR[..., 0])
    np.testing.assert_array_equal(second.depth_mm, RAW)
    assert (first.depth_frame, second.depth_frame) == ("depth", "color")


def test_what_the_cameras_felt_is_in_the_folder_and_in_the_frames_read_from_it(tmp_path: Path) -> None:
    felt = Gravity((0.6, 0.8, 0.0), 2.0)
    frames = [RgbdFrame(0, k, 0, color=COLOR, gravity=felt) for k in range(2)] + [
        RgbdFrame(1, 0, 0, color=COLOR)
    ]
    write_rig_folder(tmp_path, description(), frames)
    again = read_rig_description(tmp_path)
    assert read_frame(tmp_path, again.camera(0), 1).gravity == felt
    assert read_frame(tmp_path, again.camera(1), 0).gravity is None
    cameras = json.loads((tmp_path / "nominal.json").read_text())["cameras"]
    assert [camera.get("gravity") for camera in cameras] == [felt.to_dict(), None]
    assert "gravity" not in cameras[1]


def test_a_camera_that_was_turned_between_its_frames_has_no_gravity_in_the_folder(tmp_path: Path) -> None:
    downs = (Gravity((1.0, 0.0, 0.0)), Gravity((0.0, 1.0, 0.0)))
    frames = [RgbdFrame(0, k, 0, color=COLOR, gravity=down) for k, down in enumerate(downs)]
    write_rig_folder(tmp_path, description(1), frames)
    assert read_rig_description(tmp_path).camera(0).gravity is None


def test_malformed_gravity_names_the_camera() -> None:
    values = description().to_dict()
    values["cameras"][1]["gravity"] = {"down": [0, 0, 0], "sigma_deg": 1}
    with pytest.raises(DataError, match="camera 1: gravity"):
        RigDescription.from_dict(values)


def test_raw_disparity_is_preferred_to_millimetres(tmp_path: Path) -> None:
    write_rig_folder(tmp_path, description(1), [RgbdFrame(0, 0, 0, color=COLOR, raw=RAW)])
    cv2.imwrite(str(tmp_path / "cam00" / "depth_000.png"), RAW + 1)
    frame = read_frame(tmp_path, description(1).camera(0), 0)
    np.testing.assert_array_equal(frame.raw, RAW)
    assert frame.depth_mm is None


def test_a_torn_image_is_named(tmp_path: Path) -> None:
    write_rig_folder(tmp_path, description(1), [RgbdFrame(0, 0, 0, color=COLOR, raw=RAW)])
    image = tmp_path / "cam00" / "color_000.png"
    image.write_bytes(image.read_bytes()[:60])
    with pytest.raises(DataError, match=r"color_000\.png is not a readable image"):
        read_frame(tmp_path, description(1).camera(0), 0)


def test_an_image_of_the_wrong_depth_is_refused(tmp_path: Path) -> None:
    write_rig_folder(tmp_path, description(1), [RgbdFrame(0, 0, 0, color=COLOR, raw=RAW)])
    cv2.imwrite(str(tmp_path / "cam00" / "raw_000.png"), COLOR)
    with pytest.raises(DataError, match=r"raw_000\.png holds uint8"):
        read_frame(tmp_path, description(1).camera(0), 0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "not valid JSON"),
        ("[]", "list `cameras`"),
        ('{"cameras": [{}]}', "integer `id`"),
        ('{"cameras": [{"id": 0, "name": "../../etc"}]}', "plain folder name"),
        ('{"cameras": [{"id": 4, "color": {"fx": 1}}]}', "camera 4"),
        ('{"cameras": [{"id": 1e400}]}', "integer `id`"),
        (f'{{"cameras": [], "ring": {{"radius": {HUGE}}}}}', "ring must hold numbers"),
        (
            json.dumps({"cameras": [{"id": 0, **CameraModel().to_dict(), "T_rig_cam": [[10**400]]}]}),
            "T_rig_cam must be",
        ),
    ],
)
def test_a_malformed_description_says_where(tmp_path: Path, content: str, message: str) -> None:
    (tmp_path / "nominal.json").write_text(content)
    with pytest.raises(DataError, match=message):
        read_rig_description(tmp_path)


def test_a_folder_without_description_is_a_usage_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"nominal\.json cannot be read"):
        read_rig_description(tmp_path)


def test_two_cameras_with_one_id_are_refused() -> None:
    entry = CameraEntry(1, "a", CameraModel())
    with pytest.raises(DataError, match="share an id"):
        RigDescription((entry, entry))


def test_unknown_keys_are_ignored(tmp_path: Path) -> None:
    values = description().to_dict() | {"weather": "fine"}
    values["cameras"][0]["colour of the tape"] = "red"
    (tmp_path / "nominal.json").write_text(json.dumps(values))
    assert read_rig_description(tmp_path).camera_ids == (0, 1)


def test_true_poses_survive_their_file(tmp_path: Path) -> None:
    poses = {i: RingDrawing().T_rig_camera(i) for i in (0, 5)}
    write_true_poses(tmp_path / "truth.json", poses)
    again = read_true_poses(tmp_path)
    assert again.keys() == poses.keys()
    np.testing.assert_array_equal(again[5], poses[5])


def test_the_ring_drawing_is_that_of_the_rendered_room() -> None:
    rendered = read_rig_description(real_data("rendered_room"))
    assert rendered.ring is not None
    for camera in rendered.cameras:
        np.testing.assert_allclose(rendered.ring.T_rig_camera(camera.id), camera.T_rig_camera, atol=1e-9)


def test_the_real_views_are_read_as_registered_depth() -> None:
    folder = real_data("tum_fr1_rpy_12views")
    rig = read_rig_description(folder)
    frame = read_frame(folder, rig.camera(0), frame_indices(folder, "cam00")[0])
    assert rig.camera(0).T_rig_camera is None
    assert frame.depth_frame == "color"
    assert frame.depth_mm is not None
    assert 400 < np.median(frame.depth_mm[frame.depth_mm > 0]) < 5000
