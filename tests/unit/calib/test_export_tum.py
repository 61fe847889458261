"""TUM RGB-D folders, read with OpenCV and NumPy: what pixel, what distance, what pose, what time."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rig_calib.depth_model import DepthCorrection
from rig_calib.frame_exports import tum
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.frames import PanoramicFrame, RgbdFrame
from support.box_room import calibration_of
from support.box_takes import (
    COLOR,
    DEPTH,
    MODEL,
    POSES,
    box_calibration,
    box_description,
    box_frame,
    box_panorama,
    export_job,
    seen_by,
    wall_point,
    write_take,
)

K_COLOR = np.array([[COLOR.fx, 0, COLOR.cx], [0, COLOR.fy, COLOR.cy], [0, 0, 1]])
K_DEPTH = np.array([[DEPTH.fx, 0, DEPTH.cx], [0, DEPTH.fy, DEPTH.cy], [0, 0, 1]])
STEP_M = 0.02
"""A step of the raw disparity at the farthest wall."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sets, exported."""
    home = tmp_path_factory.mktemp("tum")
    take = write_take(home / "take.mcap", box_description(), [box_panorama(k) for k in range(2)])
    tum.export(export_job(take, home / "out", box_calibration()))
    return home / "out"


def listed(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text().splitlines() if not line.startswith("#")]


def depth_m(path: Path) -> np.ndarray:
    """Metres, NaN = none, as OpenCV reads a depth image of TUM."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert image.dtype == np.uint16
    return np.asarray(cv2.rescaleDepth(image, cv2.CV_64F, depth_factor=5000.0))


def first_depth(folder: Path) -> np.ndarray:
    return depth_m(folder / listed(folder / "depth.txt")[0][1])


def test_every_camera_is_a_sequence_whose_lists_name_its_files_in_unix_time(folder: Path) -> None:
    assert sorted(path.name for path in folder.iterdir()) == ["cam00", "cam01", "cam02"]
    camera = folder / "cam01"
    assert listed(camera / "rgb.txt") == [
        ["1772600767.001000", "rgb/1772600767.001000.png"],
        ["1772600767.034000", "rgb/1772600767.034000.png"],
    ]
    for color_s, color, depth_s, depth in listed(camera / "associations.txt"):
        assert color_s == depth_s
        assert (camera / color).is_file()
        assert (camera / depth).is_file()
    assert len(listed(camera / "associations.txt")) == len(listed(camera / "depth.txt")) == 2


@pytest.mark.parametrize("camera_id", POSES)
@pytest.mark.parametrize("k", [0, 1])
def test_colour_is_the_cameras_bit_for_bit(folder: Path, camera_id: int, k: int) -> None:
    camera = folder / f"cam{camera_id:02d}"
    image = cv2.imread(str(camera / listed(camera / "rgb.txt")[k][1]), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(image, box_frame(camera_id, k).color)


@pytest.mark.parametrize("camera_id", POSES)
def test_depth_is_the_walls_distance_in_the_colour_pixel(folder: Path, camera_id: int) -> None:
    depth = first_depth(folder / f"cam{camera_id:02d}")
    for pixel in [(40, 30), (80, 60), (120, 90), (100, 35)]:
        point, _ = wall_point(camera_id, pixel)
        _, expected_m = seen_by(POSES[camera_id], K_COLOR, np.array(COLOR.dist), point)
        assert abs(depth[pixel[1], pixel[0]] - expected_m) < STEP_M
    seen_by_depth_camera_too = depth[15:-15, 15:-30]
    assert np.isfinite(seen_by_depth_camera_too).all(), "a surface has no holes in it"


def test_depth_is_registered_as_opencv_registers_it(folder: Path) -> None:
    raw = box_frame(0, 0).raw
    assert raw is not None
    model = MODEL.raw_model
    original_m = (model.numerator_m / (model.offset - raw.astype(np.float64))).astype(np.float32)
    size = (COLOR.width, COLOR.height)
    by_opencv = cv2.registerDepth(
        K_DEPTH, K_COLOR, np.array(COLOR.dist), MODEL.T_color_depth, original_m, size
    )
    ours = first_depth(folder / "cam00")
    measured = np.isfinite(ours)
    assert np.array_equal(measured, by_opencv > 0)  # NaN is not
    assert np.abs(ours - by_opencv)[measured].max() < 0.51 / 5000 + 1e-6, "rounded, and nothing else"


def test_the_pose_is_the_calibrations_for_every_image(folder: Path) -> None:
    camera = folder / "cam02"
    rows = np.loadtxt(camera / "groundtruth.txt")
    assert rows.shape == (2, 8)
    assert [row[0] for row in listed(camera / "groundtruth.txt")] == [
        row[0] for row in listed(camera / "rgb.txt")
    ]
    for row in rows:
        assert np.allclose(row[1:4], POSES[2][:3, 3], atol=1e-12)
        assert np.allclose(Rotation.from_quat(row[4:]).as_matrix(), POSES[2][:3, :3], atol=1e-12)


def test_pose_depth_and_intrinsics_lead_back_to_the_wall(folder: Path) -> None:
    camera = folder / "cam01"
    fx, fy, cx, cy, *dist = np.loadtxt(camera / "intrinsics.txt")
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    _, tx, ty, tz, *quaternion = np.loadtxt(camera / "groundtruth.txt")[0]
    column, row = 100, 35
    ray = cv2.undistortPoints(np.array([[[column, row]]], float), K, np.array(dist)).reshape(2)
    point = np.array([*ray, 1.0]) * first_depth(camera)[row, column]
    in_rig = Rotation.from_quat(quaternion).apply(point) + np.array([tx, ty, tz])
    assert np.linalg.norm(in_rig - wall_point(1, (column, row))[0]) < STEP_M


def test_the_depth_correction_is_applied(tmp_path: Path) -> None:
    take = write_take(tmp_path / "take.mcap", box_description(), [box_panorama(0)])
    known = box_calibration()
    corrected = [
        type(camera)(camera.id, camera.name, camera.T_rig_camera, None, DepthCorrection((0.05,)))
        for camera in known.cameras
    ]
    longer: RigCalibration = calibration_of(POSES, cameras=tuple(corrected))
    for name, calibration in {"plain": known, "longer": longer}.items():
        tum.export(export_job(take, tmp_path / name, calibration))
    plain, more = (np.nanmedian(first_depth(tmp_path / name / "cam00")) for name in ("plain", "longer"))
    assert more / plain == pytest.approx(1.05, abs=0.01)


def test_a_camera_without_depth_has_colour_and_no_pairs(tmp_path: Path) -> None:
    frame = box_frame(0, 0)
    bare = RgbdFrame(0, 0, frame.timestamp_ns, color=frame.color)
    take = write_take(tmp_path / "take.mcap", box_description(), [PanoramicFrame.of(0, {0: bare})])
    tum.export(export_job(take, tmp_path / "out", calibration_of({0: POSES[0]})))
    camera = tmp_path / "out/cam00"
    assert len(listed(camera / "rgb.txt")) == 1
    assert listed(camera / "depth.txt") == listed(camera / "associations.txt") == []
