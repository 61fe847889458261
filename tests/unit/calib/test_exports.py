"""Rules of the exports: what goes out comes back, and who reads a file by its format's rules sees the same.

The second kind of test never uses our readers: it parses the file as its program does, follows the format's
documentation from a point in the rig to a pixel, and compares with our projection.
"""

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any
from xml.etree import ElementTree

import cv2
import numpy as np
import numpy.typing as npt
import pytest
import yaml

from rig_calib.exports import colmap, kalibr, nerfstudio, opencv_yaml, ros2
from rig_calib.exports.exported_rig import ExportedCamera, ExportedRig
from rig_calib.exports.rotations import pose_of_roll_pitch_yaw, roll_pitch_yaw
from rig_calib.projection import project
from rig_protocol.camera import Intrinsics
from rig_protocol.errors import ConfigurationError, DataError
from rig_protocol.poses import Pose, inverse, se3_exp, so3_exp, transform_points
from rig_protocol.rig_folder import RingDrawing

Array = npt.NDArray[np.float64]

CAMERAS = 5
DEPTH = Intrinsics(575.0, 574.5, 316.0, 241.0)
LENSES = {
    "pinhole": (0.0, 0.0, 0.0, 0.0, 0.0),
    "four": (0.05, -0.12, 0.001, -0.002, 0.0),
    "five": (0.2645, -0.8399, -0.00199, 0.00144, 0.9119),
}
HALF_PIXEL = 0.5


def make_rig(lens: str = "four", mounting_deg: float = 1.0) -> ExportedRig:
    """A part of a ring; without mounting errors it stands exactly where roll, pitch and yaw lock."""
    rng = np.random.default_rng(1)
    sigma = mounting_deg * np.repeat([np.deg2rad(1.0), 0.005], 3)
    cameras = [
        ExportedCamera(
            f"cam{n:02d}",
            RingDrawing().T_rig_camera(n) @ se3_exp(sigma * rng.standard_normal(6)),
            Intrinsics(*(525 + rng.standard_normal(2)), *(319.5 + rng.standard_normal(2)), dist=LENSES[lens]),
            DEPTH,
            se3_exp(np.array([0.01, 0.002, 0.005, -0.025, 0.0, 0.001])),
            {k: f"cam{n:02d}/color_{k:03d}.png" for k in range(2)},
        )
        for n in range(CAMERAS)
    ]
    return ExportedRig(tuple(cameras), tuple((n, n + 1) for n in range(CAMERAS - 1)))


@pytest.fixture(params=[(lens, deg) for lens in LENSES for deg in (0.0, 1.0)], ids=str)
def rig(request: pytest.FixtureRequest) -> ExportedRig:
    return make_rig(*request.param)


def points_seen_by(camera: ExportedCamera) -> Array:
    """Points (N,3) of the rig's frame in front of a camera, over its image."""
    x, y = np.meshgrid(np.linspace(-0.45, 0.45, 5), np.linspace(-0.35, 0.35, 5))
    z = 1.0 + 0.1 * np.arange(x.size)
    seen = np.column_stack([x.ravel() * z, y.ravel() * z, z])
    return transform_points(camera.T_rig_camera, seen)


def pixels_of(camera: ExportedCamera, points: Array) -> Array:
    """Where our own model sees points of the rig's frame."""
    assert camera.color is not None
    return project(camera.color, transform_points(inverse(camera.T_rig_camera), points))


def assert_same(a: ExportedRig, b: ExportedRig, depth: bool = False, color: bool = True) -> None:
    assert [camera.name for camera in a.cameras] == [camera.name for camera in b.cameras]
    for one, other in zip(a.cameras, b.cameras, strict=True):
        np.testing.assert_allclose(one.T_rig_camera, other.T_rig_camera, rtol=0, atol=1e-9)
        if color:
            assert one.color is not None
            assert other.color is not None
            np.testing.assert_allclose(numbers(one.color), numbers(other.color), rtol=0, atol=1e-9)
        if depth:
            assert one.T_color_depth is not None
            assert other.T_color_depth is not None
            np.testing.assert_allclose(one.T_color_depth, other.T_color_depth, rtol=0, atol=1e-9)


def numbers(camera: Intrinsics) -> list[float]:
    return [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, *camera.dist]


def seen_from_the_first(rig: ExportedRig) -> ExportedRig:
    """The same rig in the frame of its first camera: all that some formats keep."""
    T = inverse(rig.cameras[0].T_rig_camera)
    return replace(rig, cameras=tuple(replace(c, T_rig_camera=T @ c.T_rig_camera) for c in rig.cameras))


# ---- Kalibr


@pytest.mark.parametrize("lens", ["pinhole", "four"])
def test_kalibr_comes_back(lens: str) -> None:
    rig = make_rig(lens)
    again = kalibr.read_camchain(kalibr.export(rig).files[kalibr.FILE])
    assert_same(again, seen_from_the_first(rig))
    assert again.overlaps == rig.overlaps


def test_a_kalibr_chain_takes_a_point_from_camera_to_camera() -> None:
    rig = make_rig("four")
    chain = yaml.safe_load(kalibr.export(rig).files[kalibr.FILE])
    T = inverse(rig.cameras[0].T_rig_camera)
    for n, camera in enumerate(rig.cameras):
        values = chain[f"cam{n}"]
        T = np.array(values["T_cn_cnm1"]) @ T if n else T
        points = points_seen_by(camera)
        fu, fv, pu, pv = values["intrinsics"]
        K = np.array([[fu, 0, pu], [0, fv, pv], [0, 0, 1]])
        in_camera = transform_points(T, points)
        pixels, _ = cv2.projectPoints(
            in_camera, np.zeros(3), np.zeros(3), K, np.array(values["distortion_coeffs"])
        )
        np.testing.assert_allclose(pixels[:, 0], pixels_of(camera, points), atol=1e-6)


def test_kalibr_says_what_its_lens_model_cannot_hold() -> None:
    rig = make_rig("five")
    made = kalibr.export(rig)
    assert len(made.notes) == CAMERAS
    color = kalibr.read_camchain(made.files[kalibr.FILE]).cameras[0].color
    assert color is not None
    points = points_seen_by(rig.cameras[0])
    moved_px = np.abs(
        project(color, transform_points(inverse(rig.cameras[0].T_rig_camera), points))
        - pixels_of(rig.cameras[0], points)
    )
    told_px = float(made.notes[0].split(" px ")[0].split()[-1])
    assert 0.1 < moved_px.max() < told_px, "and it is not silent about how much that is"
    reach = np.hypot(319.5, 239.5) / 525
    assert told_px < 0.2 * 525 * LENSES["five"][4] * reach**7, "leaving k3 out alone would be far worse"


# ---- ROS 2


def test_ros_transforms_come_back(rig: ExportedRig) -> None:
    assert_same(
        ros2.read_launch(ros2.export_launch(rig).files[ros2.LAUNCH_FILE]), rig, depth=True, color=False
    )
    assert_same(ros2.read_urdf(ros2.export_urdf(rig).files[ros2.URDF_FILE]), rig, depth=True, color=False)


@pytest.fixture
def ros_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stand-ins for `launch` and `launch_ros` that keep what they are given."""
    launch, launch_ros, actions = (ModuleType(n) for n in ("launch", "launch_ros", "launch_ros.actions"))
    launch.LaunchDescription = list  # type: ignore[attr-defined] # a module has what it is given
    actions.Node = dict  # type: ignore[attr-defined]
    for module in (launch, launch_ros, actions):
        monkeypatch.setitem(sys.modules, module.__name__, module)


@pytest.mark.usefixtures("ros_modules")
def test_the_launch_file_publishes_where_the_cameras_are(rig: ExportedRig) -> None:
    frames: dict[str, tuple[str, Pose]] = {}
    for node in launched(ros2.export_launch(rig).files[ros2.LAUNCH_FILE]):
        assert (node["package"], node["executable"]) == ("tf2_ros", "static_transform_publisher")
        words = node["arguments"]
        given = dict(zip(words[::2], words[1::2], strict=True))
        quaternion = [float(given[f"--q{axis}"]) for axis in "wxyz"]
        T = np.eye(4)
        T[:3, :3] = hamilton(*quaternion)
        T[:3, 3] = [float(given[f"--{axis}"]) for axis in "xyz"]
        frames[given["--child-frame-id"]] = (given["--frame-id"], T)
    assert_frames(frames, rig)


def launched(text: str) -> list[dict[str, Any]]:
    names: dict[str, Any] = {}
    exec(compile(text, "rig.launch.py", "exec"), names)  # noqa: S102 # as ros2 launch does
    return list(names["generate_launch_description"]())


def hamilton(w: float, x: float, y: float, z: float) -> Array:
    """Rotation matrix of a unit quaternion, written out."""
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_the_urdf_is_a_tree_of_where_the_cameras_are(rig: ExportedRig) -> None:
    robot = ElementTree.fromstring(ros2.export_urdf(rig).files[ros2.URDF_FILE])  # noqa: S314 # our own
    links = [link.attrib["name"] for link in robot.iter("link")]
    frames: dict[str, tuple[str, Pose]] = {}
    for joint in robot.iter("joint"):
        parts = {part.tag: part.attrib for part in joint}
        assert joint.attrib["type"] == "fixed"
        roll, pitch, yaw = map(float, parts["origin"]["rpy"].split())
        T = np.eye(4)
        T[:3, :3] = so3_exp(np.array([0, 0, yaw])) @ so3_exp(np.array([0, pitch, 0])) @ so3_exp([roll, 0, 0])
        T[:3, 3] = list(map(float, parts["origin"]["xyz"].split()))
        frames[parts["child"]["link"]] = (parts["parent"]["link"], T)
    assert sorted(links) == sorted([ros2.ROOT, *frames])
    assert_frames(frames, rig)


def assert_frames(frames: dict[str, tuple[str, Pose]], rig: ExportedRig) -> None:
    for camera in rig.cameras:
        color, depth = (f"{camera.name}_{kind}_optical_frame" for kind in ("color", "depth"))
        assert (frames[color][0], frames[depth][0]) == (ros2.ROOT, color)
        np.testing.assert_allclose(frames[color][1], camera.T_rig_camera, rtol=0, atol=1e-12)
        assert camera.T_color_depth is not None
        np.testing.assert_allclose(frames[depth][1], camera.T_color_depth, rtol=0, atol=1e-12)


@pytest.mark.parametrize("tilt_rad", [0.0, 1e-12, 1e-9, 1e-7, 1e-4, 0.1])
def test_roll_pitch_and_yaw_hold_an_upright_kinect_to_the_last_digit(tilt_rad: float) -> None:
    for slot in range(12):
        R = RingDrawing().T_rig_camera(slot)[:3, :3] @ so3_exp(np.array([0.3, tilt_rad, 0.2]) * tilt_rad)
        again = pose_of_roll_pitch_yaw(roll_pitch_yaw(R), np.zeros(3))[:3, :3]
        np.testing.assert_allclose(again, R, rtol=0, atol=1e-14)


def test_names_become_frames_that_ros_allows() -> None:
    cameras = [ExportedCamera(name, np.eye(4)) for name in ("cam 0", "cam-0", "Küche")]
    assert ExportedRig(tuple(cameras)).ros_names() == ["cam_0", "cam_0_1", "K_che"]


# ---- COLMAP


def test_colmap_comes_back(rig: ExportedRig) -> None:
    files = colmap.export(rig).files
    assert_same(colmap.read_rig_config(files[colmap.RIG_CONFIG]), seen_from_the_first(rig))
    model = colmap.read_sparse_model(files)
    assert_same(model, rig)
    assert [list(c.images.values()) for c in model.cameras] == [list(c.images.values()) for c in rig.cameras]


def test_colmap_itself_reads_the_same_cameras(rig: ExportedRig, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    write_all(colmap.export(rig).files, tmp_path)
    (config,) = pycolmap.read_rig_config(tmp_path / colmap.RIG_CONFIG)
    reference = inverse(rig.cameras[0].T_rig_camera)
    for camera, read in zip(rig.cameras, config.cameras, strict=True):
        points = points_seen_by(camera)
        in_rig = transform_points(reference, points)
        in_camera = in_rig if read.ref_sensor else read.cam_from_rig * in_rig
        pixels = read.camera.img_from_cam(in_camera) - HALF_PIXEL
        np.testing.assert_allclose(pixels, pixels_of(camera, points), atol=1e-6)


def test_colmap_itself_reads_the_sparse_model(rig: ExportedRig, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    write_all(colmap.export(rig).files, tmp_path)
    model = pycolmap.Reconstruction(tmp_path / "sparse")
    assert (model.num_images(), model.num_frames(), model.num_rigs()) == (2 * CAMERAS, 2, 1)
    by_name = {name: camera for camera in rig.cameras for name in camera.images.values()}
    for image in model.images.values():
        points = points_seen_by(by_name[image.name])
        in_camera = image.cam_from_world() * points
        pixels = image.camera.img_from_cam(in_camera) - HALF_PIXEL
        np.testing.assert_allclose(pixels, pixels_of(by_name[image.name], points), atol=1e-6)


def test_colmap_lists_no_image_that_is_not_colour(rig: ExportedRig) -> None:
    listed = colmap.export(rig).files[colmap.IMAGE_LIST].splitlines()
    assert sorted(listed) == sorted(name for camera in rig.cameras for name in camera.images.values())


def test_colmap_refuses_names_that_its_text_would_tear() -> None:
    rig = make_rig()
    spaced = replace(rig, cameras=(replace(rig.cameras[0], name="cam 0"), *rig.cameras[1:]))
    with pytest.raises(ConfigurationError, match="rename"):
        colmap.export(spaced)


def write_all(files: Any, folder: Path) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)


# ---- nerfstudio


def test_nerfstudio_comes_back(rig: ExportedRig) -> None:
    assert_same(nerfstudio.read_transforms(nerfstudio.export(rig).files[nerfstudio.FILE]), rig)


def test_nerfstudio_looks_along_minus_z_with_y_up(rig: ExportedRig) -> None:
    values = json.loads(nerfstudio.export(rig).files[nerfstudio.FILE])
    frames = {frame["file_path"]: frame for frame in values["frames"]}
    for camera in rig.cameras:
        frame = frames[camera.images[0]]
        points = points_seen_by(camera)
        x, y, z = np.linalg.solve(
            frame["transform_matrix"], np.column_stack([points, np.ones(len(points))]).T
        )[:3]
        assert (z < 0).all()
        plane = np.column_stack([x / -z, -y / -z, np.ones_like(z)])
        K = np.array([[frame["fl_x"], 0, frame["cx"]], [0, frame["fl_y"], frame["cy"]], [0, 0, 1]])
        dist = np.array([frame[key] for key in ("k1", "k2", "p1", "p2", "k3")])
        pixels, _ = cv2.projectPoints(plane, np.zeros(3), np.zeros(3), K, dist)
        np.testing.assert_allclose(pixels[:, 0] - HALF_PIXEL, pixels_of(camera, points), atol=1e-6)


def test_nerfstudio_must_not_turn_a_world_whose_z_is_up() -> None:
    values = json.loads(nerfstudio.export(make_rig()).files[nerfstudio.FILE])
    assert values["orientation_override"] == "none"


def test_nerfstudio_without_images_says_where_they_belong() -> None:
    rig = make_rig()
    bare = replace(rig, cameras=tuple(replace(camera, images={}) for camera in rig.cameras))
    made = nerfstudio.export(bare)
    assert "cam00/color_000.png" in made.notes[0]
    assert_same(nerfstudio.read_transforms(made.files[nerfstudio.FILE]), rig)


# ---- OpenCV


def test_opencv_comes_back(rig: ExportedRig) -> None:
    assert_same(opencv_yaml.read_opencv(opencv_yaml.export(rig).files[opencv_yaml.FILE]), rig, depth=True)


def test_opencv_projects_with_what_it_is_given(rig: ExportedRig) -> None:
    text = opencv_yaml.export(rig).files[opencv_yaml.FILE]
    loader = type("Loader", (yaml.SafeLoader,), {})
    loader.add_constructor("tag:yaml.org,2002:opencv-matrix", opencv_matrix)
    values = yaml.load(text, loader)  # noqa: S506 # a safe loader and one more tag
    for camera, read in zip(rig.cameras, values["cameras"], strict=True):
        points = points_seen_by(camera)
        pixels, _ = cv2.projectPoints(
            points, read["rvec"], read["tvec"], read["camera_matrix"], read["distortion_coefficients"]
        )
        np.testing.assert_allclose(pixels[:, 0], pixels_of(camera, points), atol=1e-6)


def opencv_matrix(loader: Any, node: Any) -> Array:
    values = loader.construct_mapping(node, deep=True)
    return np.array(values["data"], dtype=np.float64).reshape(values["rows"], values["cols"])


# ---- all

READERS: dict[str, Callable[[str], ExportedRig]] = {
    "kalibr": kalibr.read_camchain,
    "ros2": ros2.read_launch,
    "urdf": ros2.read_urdf,
    "colmap": colmap.read_rig_config,
    "colmap model": lambda text: colmap.read_sparse_model({"sparse/cameras.txt": text}),
    "nerfstudio": nerfstudio.read_transforms,
    "opencv": opencv_yaml.read_opencv,
}


@pytest.mark.parametrize(
    "text", ["", "[", "{}", "<a>", "cam0: {}", "TRANSFORMS = [1]", '{"frames": [{}]}', "1 A"]
)
@pytest.mark.parametrize("name", READERS)
def test_what_is_no_export_is_refused_in_words(name: str, text: str) -> None:
    with pytest.raises(DataError):
        READERS[name](text)


@pytest.mark.parametrize("export", [kalibr.export, colmap.export, nerfstudio.export, opencv_yaml.export])
def test_a_format_with_intrinsics_says_which_cameras_lack_them(
    export: Callable[[ExportedRig], object],
) -> None:
    rig = make_rig()
    blind = replace(rig, cameras=(*rig.cameras[:-1], replace(rig.cameras[-1], color=None)))
    with pytest.raises(ConfigurationError, match=r"cam04.*--rig"):
        export(blind)
