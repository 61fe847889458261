"""Foxglove MCAP, read by the mcap library and by Rerun: topics, colours, units, directions, times."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from rerun.chunk import McapReader
from scipy.spatial.transform import Rotation

from rig_calib.frame_exports import foxglove
from rig_calib.fusion.live import LiveFusion
from rig_protocol.frames import PanoramicFrame, RgbdFrame
from rig_protocol.poses import Pose
from rig_protocol.rig_folder import RigDescription
from support.box_room import MODEL as REGISTERED_MODEL
from support.box_room import BoxRoom, calibration_of
from support.box_takes import (
    CREATED_UNIX_NS,
    MODEL,
    PERIOD_NS,
    POSES,
    ROOM,
    box_calibration,
    box_description,
    box_frame,
    box_panorama,
    export_job,
    seen_by,
    wall_point,
    write_take,
)

Told = Mapping[str, Sequence[tuple[Any, Any]]]
"""By topic: the records of MCAP and the decoded messages."""

PIXELS = [(40, 30), (80, 60), (110, 85)]
STEP_MM = 20.0
"""A step of the raw disparity at the farthest wall."""


@pytest.fixture(scope="module")
def view(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two sets, exported."""
    home = tmp_path_factory.mktemp("foxglove")
    panoramas = [box_panorama(k) for k in range(2)]
    take = write_take(home / "take.mcap", box_description(), panoramas, box_calibration())
    foxglove.export(export_job(take, home / "view.mcap"))
    return home / "view.mcap"


@pytest.fixture(scope="module")
def told(view: Path) -> Told:
    """What the mcap library reads, by topic."""
    return messages_of(view)


def messages_of(view: Path) -> Told:
    topics: dict[str, list[tuple[Any, Any]]] = {}
    with view.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, record, message in reader.iter_decoded_messages():
            topics.setdefault(channel.topic, []).append((record, message))
    return topics


def first(told: Told, topic: str) -> Any:
    return told[topic][0][1]


def pose_of(told: Told, child: str) -> tuple[str, Pose]:
    """The parent, and T_parent_child, as the schema defines it."""
    (one,) = (one for one in first(told, "/tf").transforms if one.child_frame_id == child)
    T = np.eye(4)
    q, t = one.rotation, one.translation
    T[:3, :3], T[:3, 3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix(), (t.x, t.y, t.z)
    return one.parent_frame_id, T


def pose_in_rig(told: Told, frame_id: str) -> Pose:
    """T_rig_frame along the tree."""
    T = np.eye(4)
    while frame_id != "rig":
        frame_id, T_parent_frame = pose_of(told, frame_id)
        T = T_parent_frame @ T
    return T


def depth_of(image: Any) -> np.ndarray:
    assert image.encoding == "16UC1"
    assert image.step == 2 * image.width
    return np.frombuffer(image.data, "<u2").reshape(image.height, image.width)


def points_of(cloud: Any) -> tuple[np.ndarray, np.ndarray]:
    """Points and RGB of a cloud, by its own description of its fields."""
    kinds = {7: "<f4", 1: "u1"}  # PackedElementField.NumericType
    layout = np.dtype(
        {
            "names": [field.name for field in cloud.fields],
            "formats": [kinds[field.type] for field in cloud.fields],
            "offsets": [field.offset for field in cloud.fields],
            "itemsize": cloud.point_stride,
        }
    )
    points = np.frombuffer(cloud.data, layout)
    return (
        np.column_stack([points[axis] for axis in ("x", "y", "z")]),
        np.column_stack([points[color] for color in ("red", "green", "blue")]),
    )


def test_every_topic_has_the_published_schema(view: Path) -> None:
    with view.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    schemas = {
        channel.topic: (summary.schemas[channel.schema_id].name, channel.message_encoding)
        for channel in summary.channels.values()
    }
    cameras = {
        f"/{name}/{topic}": (f"foxglove.{schema}", "protobuf")
        for name in ("cam00", "cam01", "cam02")
        for topic, schema in {
            "color": "CompressedImage",
            "color/calibration": "CameraCalibration",
            "depth": "RawImage",
            "depth/calibration": "CameraCalibration",
        }.items()
    }
    assert schemas == cameras | {
        "/tf": ("foxglove.FrameTransforms", "protobuf"),
        "/cloud": ("foxglove.PointCloud", "protobuf"),
        "/panorama": ("foxglove.CompressedImage", "protobuf"),
    }


@pytest.mark.parametrize("k", [0, 1])
def test_colour_is_the_cameras_with_red_and_blue_in_their_places(told: Told, k: int) -> None:
    _, image = told["/cam01/color"][k]
    assert image.format == "jpeg"
    shown = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR).astype(float)
    sent = box_frame(1, k).color
    assert sent is not None
    assert np.abs(shown - sent).mean() < 1.0
    assert np.abs(shown[..., ::-1] - sent).mean() > 10.0, "the scene tells red from blue"


def test_depth_is_in_millimetres_on_the_depth_cameras_grid(told: Told) -> None:
    raw = box_frame(2, 0).raw
    assert raw is not None
    expected_mm = MODEL.raw_model.numerator_m * 1e3 / (MODEL.raw_model.offset - raw.astype(float))
    assert np.abs(depth_of(first(told, "/cam02/depth")) - expected_mm).max() <= 0.5


@pytest.mark.parametrize("pixel", PIXELS)
@pytest.mark.parametrize("camera_id", POSES)
def test_a_point_of_the_room_falls_on_its_pixel_through_the_transforms(
    told: Told, camera_id: int, pixel: tuple[int, int]
) -> None:
    point, bgr = wall_point(camera_id, pixel)
    for kind in ("color", "depth"):
        image = first(told, f"/cam{camera_id:02d}/{kind}")
        lens = first(told, f"/cam{camera_id:02d}/{kind}/calibration")
        assert lens.distortion_model == "plumb_bob"
        assert image.frame_id == lens.frame_id
        T_rig_camera = pose_in_rig(told, image.frame_id)
        K = np.array(lens.K).reshape(3, 3)
        assert np.array_equal(np.array(lens.P).reshape(3, 4), np.column_stack([K, np.zeros(3)]))
        seen, depth_m = seen_by(T_rig_camera, K, np.array(lens.D), point)
        column, row = np.rint(seen).astype(int)
        if kind == "color":
            assert np.abs(seen - pixel).max() < 1e-3
            shown = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR)
            assert np.abs(shown[row, column] - bgr).max() < 8
        else:
            assert abs(depth_of(image)[row, column] - depth_m * 1e3) < STEP_MM


def test_the_cloud_lies_on_the_walls_in_their_colours(told: Told) -> None:
    cloud = first(told, "/cloud")
    assert cloud.frame_id == "rig"
    assert cloud.pose.orientation.w == 1.0
    points, colors = points_of(cloud)
    assert len(points) > 500
    assert np.median(ROOM.wall_error_m(points.astype(float))) < 0.01
    expected = ROOM.colors(points.astype(float))
    assert np.median(np.abs(colors - expected)) < 4
    assert np.median(np.abs(colors[:, ::-1] - expected)) > 10


def test_the_cloud_holds_one_point_of_a_cube_of_two_centimetres(told: Told) -> None:
    points, _ = points_of(first(told, "/cloud"))
    assert len(np.unique(np.floor(points.astype(float) / 0.02), axis=0)) == len(points)


def test_the_panorama_is_what_fusion_made_of_the_frame(told: Told) -> None:
    image = first(told, "/panorama")
    shown = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_COLOR).astype(float)
    with LiveFusion(box_calibration(), dict.fromkeys(POSES, MODEL)) as fusion:
        made = fusion.fuse(box_panorama(0)).panorama
        assert shown.shape == made.shape
        lit = made.max(axis=2) > 0
        assert np.median(np.abs(shown - made)[lit]) < 8, "JPEG, with the dots of small cameras"
        assert np.median(np.abs(shown[..., ::-1] - made)[lit]) > 15


def test_messages_tell_their_exposure_in_unix_time_and_play_with_their_set(told: Told) -> None:
    for k in range(2):
        set_ns = CREATED_UNIX_NS + k * PERIOD_NS + 1_000_000
        for topic, messages in told.items():
            record, message = messages[k]
            assert record.log_time == set_ns
            if topic.startswith("/cam"):
                exposed_ns = CREATED_UNIX_NS + k * PERIOD_NS + int(topic[5]) * 1_000_000
                assert message.timestamp.ToNanoseconds() == record.publish_time == exposed_ns
    assert first(told, "/tf").transforms[0].timestamp.ToNanoseconds() == CREATED_UNIX_NS + 1_000_000


def test_registered_depth_stands_in_the_colour_frame(tmp_path: Path) -> None:
    poses = {i: POSES[i] for i in (0, 1)}
    room, frames = BoxRoom(), {}
    for i, T in poses.items():
        seen = room.view(i, T)
        frames[i] = RgbdFrame(
            i, 0, 6_000_000_000, color=seen.color[0], depth_mm=seen.depth_mm[0], depth_frame="color"
        )
    entries = [entry for entry in box_description().cameras if entry.id in poses]
    cameras = tuple(type(entry)(entry.id, entry.name, REGISTERED_MODEL) for entry in entries)
    take = write_take(tmp_path / "take.mcap", RigDescription(cameras), [PanoramicFrame.of(0, frames)])
    foxglove.export(export_job(take, tmp_path / "view.mcap", calibration_of(poses)))
    told = messages_of(tmp_path / "view.mcap")
    assert first(told, "/cam00/depth").frame_id == "cam00_color_optical_frame"
    assert np.abs(depth_of(first(told, "/cam00/depth")).astype(int) - frames[0].depth_mm).max() <= 1
    assert len(first(told, "/tf").transforms) == 2


def test_cameras_are_named_as_in_the_export_to_ros(tmp_path: Path) -> None:
    names = ["left-1", "left 1", "cam02"]
    cameras = tuple(
        replace(entry, name=name) for entry, name in zip(box_description().cameras, names, strict=True)
    )
    take = write_take(tmp_path / "take.mcap", RigDescription(cameras), [box_panorama(0)], box_calibration())
    foxglove.export(export_job(take, tmp_path / "view.mcap"))
    told = messages_of(tmp_path / "view.mcap")
    for name in ("left_1", "left_1_1", "cam02"):
        assert first(told, f"/{name}/depth").frame_id == f"{name}_depth_optical_frame"
        assert pose_of(told, f"{name}_color_optical_frame")[0] == "rig"


def test_another_program_reads_the_same(view: Path, told: Told) -> None:
    columns: dict[str, list[Any]] = {}
    for chunk in McapReader(str(view)).stream().to_chunks():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            columns.setdefault(f"{chunk.entity_path} {name}", []).extend(batch.column(name).to_pylist())
    points, colors = points_of(first(told, "/cloud"))
    assert np.array_equal(np.array(columns["/cloud Points3D:positions"][0], np.float32), points)
    packed = np.array(columns["/cloud Points3D:colors"][0], np.uint32)  # 0xRRGGBBAA
    assert np.array_equal(np.column_stack([(packed >> shift) & 255 for shift in (24, 16, 8)]), colors)
    row = [names[0] for names in columns["/tf Transform3D:child_frame"]].index("cam01_depth_optical_frame")
    T = pose_of(told, "cam01_depth_optical_frame")[1]
    assert columns["/tf Transform3D:parent_frame"][row] == ["cam01_color_optical_frame"]
    assert np.allclose(columns["/tf Transform3D:translation"][row][0], T[:3, 3], atol=1e-6)
    by_columns = np.array(columns["/cam00/color/calibration Pinhole:image_from_camera"][0][0]).reshape(3, 3)
    K = np.array(first(told, "/cam00/color/calibration").K).reshape(3, 3)
    assert np.allclose(by_columns.T, K, atol=1e-4)
