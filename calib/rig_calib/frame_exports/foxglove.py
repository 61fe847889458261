"""Foxglove MCAP: Protobuf messages of the published schemas, which Foxglove and Lichtblick show as they are.

Schemas: https://docs.foxglove.dev/docs/sdk/schemas. Frames are those of the ROS 2 export: rig ->
NAME_color_optical_frame -> NAME_depth_optical_frame.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.Pose_pb2 import Pose as PoseMessage
from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
from google.protobuf.timestamp_pb2 import Timestamp
from mcap_protobuf.writer import Writer

from rig_calib.exports.exported_rig import ros_names
from rig_calib.exports.ros2 import COLOR_FRAME, DEPTH_FRAME, ROOT
from rig_calib.exports.rotations import quaternion_wxyz
from rig_calib.frame_exports.frame_files import make_folder_of
from rig_calib.frame_exports.job import Exported, ExportJob
from rig_calib.frame_exports.placed_cameras import (
    PlacedCamera,
    missing_notes,
    placed_cameras,
    unplaced_notes,
)
from rig_calib.frame_exports.shown_frames import ShownCamera, ShownFrame, shown_frames
from rig_calib.frame_exports.time_stamps import TimeStamps
from rig_calib.whole_file import whole_file
from rig_calib.whole_folder import refuse_existing
from rig_protocol.camera import Intrinsics
from rig_protocol.poses import Pose

TRANSFORMS, CLOUD, PANORAMA = "/tf", "/cloud", "/panorama"
_PANORAMA_FRAME = "panorama"  # a picture of its own: no transform leads to a cylinder

_POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgba", "u1", 4)])
_FIELDS = [
    PackedElementField(name=name, offset=4 * n, type=PackedElementField.FLOAT32)
    for n, name in enumerate(("x", "y", "z"))
] + [
    PackedElementField(name=name, offset=12 + n, type=PackedElementField.UINT8)
    for n, name in enumerate(("red", "green", "blue", "alpha"))
]

Topical = tuple[str, int, Any]
"""A topic, the rig time of what is told, and the message."""


def export(job: ExportJob) -> Exported:
    """Write the file; what is left out is in the notes.

    Every message's log time is that of its panoramic frame, so that all of it plays at once; the message
    itself tells the exposure.
    """
    refuse_existing(job.out)
    make_folder_of(job.out)
    placed, stamps = placed_cameras(job), TimeStamps.of(job.capture)
    names = [camera.name for camera in placed]
    cameras = [replace(camera, name=name) for camera, name in zip(placed, ros_names(names), strict=True)]
    written = dict.fromkeys((camera.id for camera in cameras), 0)
    with whole_file(job.out) as file, Writer(file) as writer:
        for frame in shown_frames(job, cameras):
            for shown in frame.cameras:
                written[shown.camera_id] += 1
            for topic, time_ns, message in _messages(frame, cameras, stamps):
                writer.write_message(topic, message, stamps.ns(frame.timestamp_ns), stamps.ns(time_ns))
        job.refuse_nothing(sum(written.values()))
    missing = missing_notes(names, list(written.values()), len(job.positions))
    return Exported((job.out,), (*unplaced_notes(job, cameras), *missing, *stamps.notes))


def _messages(frame: ShownFrame, cameras: Sequence[PlacedCamera], stamps: TimeStamps) -> Iterator[Topical]:
    """Transforms first: a viewer can place nothing without them."""
    now_ns = frame.timestamp_ns
    time = _time(stamps.ns(now_ns))
    yield TRANSFORMS, now_ns, _transforms(cameras, time)
    shown = {one.camera_id: one for one in frame.cameras}
    for camera in cameras:
        if camera.id in shown:
            yield from _camera_messages(camera, shown[camera.id], stamps)
    yield CLOUD, now_ns, _cloud(frame, time)
    yield (
        PANORAMA,
        now_ns,
        CompressedImage(timestamp=time, frame_id=_PANORAMA_FRAME, data=frame.panorama_jpeg, format="jpeg"),
    )


def _camera_messages(camera: PlacedCamera, shown: ShownCamera, stamps: TimeStamps) -> Iterator[Topical]:
    time_ns, time, topic = shown.timestamp_ns, _time(stamps.ns(shown.timestamp_ns)), f"/{camera.name}"
    color_frame = camera.name + COLOR_FRAME
    yield f"{topic}/color/calibration", time_ns, _calibration(camera.model.color, color_frame, time)
    image = CompressedImage(timestamp=time, frame_id=color_frame, data=shown.color_jpeg, format="jpeg")
    yield f"{topic}/color", time_ns, image
    if shown.depth_mm is None:
        return
    depth_frame = color_frame if shown.depth_frame == "color" else camera.name + DEPTH_FRAME
    intrinsics = camera.grid(shown.depth_frame).intrinsics
    yield f"{topic}/depth/calibration", time_ns, _calibration(intrinsics, depth_frame, time)
    height, width = shown.depth_mm.shape
    yield (
        f"{topic}/depth",
        time_ns,
        RawImage(
            timestamp=time,
            frame_id=depth_frame,
            width=width,
            height=height,
            encoding="16UC1",
            step=2 * width,
            data=shown.depth_mm.astype("<u2").tobytes(),
        ),
    )


def _transforms(cameras: Sequence[PlacedCamera], time: Timestamp) -> FrameTransforms:
    transforms = []
    for camera in cameras:
        color_frame = camera.name + COLOR_FRAME
        transforms.append(_transform(ROOT, color_frame, camera.T_rig_camera, time))
        if camera.model.T_color_depth is not None:
            depth_frame = camera.name + DEPTH_FRAME
            transforms.append(_transform(color_frame, depth_frame, camera.model.T_color_depth, time))
    return FrameTransforms(transforms=transforms)


def _transform(parent: str, child: str, T_parent_child: Pose, time: Timestamp) -> FrameTransform:
    x, y, z = T_parent_child[:3, 3].tolist()
    return FrameTransform(
        timestamp=time,
        parent_frame_id=parent,
        child_frame_id=child,
        translation=Vector3(x=x, y=y, z=z),
        rotation=_rotation(T_parent_child),
    )


def _rotation(T: Pose) -> Quaternion:
    w, x, y, z = quaternion_wxyz(T)
    return Quaternion(x=x, y=y, z=z, w=w)


def _calibration(lens: Intrinsics, frame_id: str, time: Timestamp) -> CameraCalibration:
    return CameraCalibration(
        timestamp=time,
        frame_id=frame_id,
        width=lens.width,
        height=lens.height,
        distortion_model="plumb_bob",
        D=lens.dist,
        K=[lens.fx, 0, lens.cx, 0, lens.fy, lens.cy, 0, 0, 1],
        R=[1, 0, 0, 0, 1, 0, 0, 0, 1],
        P=[lens.fx, 0, lens.cx, 0, 0, lens.fy, lens.cy, 0, 0, 0, 1, 0],
    )


def _cloud(frame: ShownFrame, time: Timestamp) -> PointCloud:
    points = np.empty(len(frame.points_m), _POINT)
    for n, axis in enumerate("xyz"):
        points[axis] = frame.points_m[:, n]
    points["rgba"][:, :3], points["rgba"][:, 3] = frame.colors, 255
    origin = PoseMessage(position=Vector3(), orientation=Quaternion(w=1))
    return PointCloud(
        timestamp=time,
        frame_id=ROOT,
        pose=origin,
        point_stride=_POINT.itemsize,
        fields=_FIELDS,
        data=points.tobytes(),
    )


def _time(time_ns: int) -> Timestamp:
    seconds, nanos = divmod(time_ns, 1_000_000_000)
    return Timestamp(seconds=seconds, nanos=nanos)
