"""Takes and rig folders of the box room: small cameras, colour and disparity known in closed form."""

from collections.abc import Container, Iterable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from rig_calib.frame_exports.job import ExportJob
from rig_calib.offline.capture import open_capture
from rig_calib.offline.workers import ThisProcess
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.camera import CameraModel, Intrinsics
from rig_protocol.codecs import codec_by_name
from rig_protocol.frames import EncodedFrame, ImageU16, PanoramicFrame, Payload, RgbdFrame
from rig_protocol.poses import Pose, inverse, se3_exp, transform_points
from rig_protocol.recording import CALIBRATION, DESCRIPTION, RecordingWriter
from rig_protocol.recording_format import RecordedSet
from rig_protocol.rig_folder import CameraEntry, RigDescription, RingDrawing
from support.box_room import BoxRoom, calibration_of, ring_poses

ROOM = BoxRoom()
COLOR = Intrinsics(131.0, 132.0, 78.5, 60.5, 160, 120, (0.05, -0.08, 0.001, -0.002, 0.0))
DEPTH = Intrinsics(145.0, 144.0, 80.5, 58.5, 160, 120)
MODEL = CameraModel(
    COLOR, DEPTH, se3_exp(np.array([0.01, -0.02, 0.015, -0.025, 0.001, 0.002])), source="file"
)
POSES = ring_poses(3)
"""Rotations and offsets of every axis, so that a wrong direction or order shows."""

CREATED, CREATED_NS = "2026-03-04T05:06:07+00:00", 5_000_000_000
CREATED_UNIX_NS = 1_772_600_767_000_000_000
PERIOD_NS = 33_000_000


def box_description() -> RigDescription:
    """Three cameras of a ring of twelve."""
    return RigDescription(tuple(CameraEntry(i, f"cam{i:02d}", MODEL) for i in POSES), RingDrawing())


def box_frame(camera_id: int, k: int, T_rig_camera: Pose | None = None) -> RgbdFrame:
    """What a camera sees in panoramic frame `k`, which is a little darker than the one before."""
    T = POSES[camera_id] if T_rig_camera is None else T_rig_camera
    colors = ROOM.colors(_wall_points(COLOR, T)) - 5 * k
    time_ns = CREATED_NS + k * PERIOD_NS + camera_id * 1_000_000
    bgr = np.rint(colors[..., ::-1]).astype(np.uint8)
    return RgbdFrame(camera_id, k, time_ns, color=bgr, raw=_disparity(T @ MODEL.T_color_depth))


def box_panorama(k: int) -> PanoramicFrame:
    """All three cameras."""
    return PanoramicFrame.of(k, {i: box_frame(i, k) for i in POSES})


def box_calibration() -> RigCalibration:
    """The truth."""
    return calibration_of(POSES)


def write_take(
    path: Path,
    description: RigDescription,
    panoramas: Iterable[PanoramicFrame],
    calibration: RigCalibration | None = None,
    created: str = CREATED,
    broken: Container[int] = (),
) -> Path:
    """A recording of these panoramic frames, bit for bit; those with a `broken` index do not decode."""
    with path.open("wb") as output:
        writer = RecordingWriter(output, created, CREATED_NS)
        writer.attach(DESCRIPTION, description.to_dict(), 0)
        if calibration is not None:
            writer.attach(CALIBRATION, calibration.to_dict(), 0)
        for panorama in panoramas:
            for frame in panorama.frames.values():
                if frame is not None:
                    encoded = _encoded(frame)
                    writer.write(_broken(encoded) if panorama.index in broken else encoded)
            stamps = {i: None if one is None else one.timestamp_ns for i, one in panorama.frames.items()}
            writer.write(RecordedSet(panorama.index, panorama.timestamp_ns, stamps))
        writer.finish()
    return path


def export_job(source: Path, out: Path, calibration: RigCalibration | None = None) -> ExportJob:
    """All of a capture, in this process."""
    capture = open_capture(source)
    positions = range(len(capture.marks))
    return ExportJob(capture, positions, out, ThisProcess(), calibration or capture.calibration)


def wall_point(camera_id: int, pixel: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """The point (3,) of the rig frame that a colour pixel (column, row) sees, and its colour BGR (3,)."""
    column, row = pixel
    points = _wall_points(COLOR, POSES[camera_id])
    return points[row, column], ROOM.colors(points[row, column])[::-1]


def seen_by(
    T_rig_camera: Pose, K: np.ndarray, dist: np.ndarray, point: np.ndarray
) -> tuple[np.ndarray, float]:
    """Pixel (2,) and depth of a point of the rig frame, by OpenCV."""
    in_camera = transform_points(inverse(T_rig_camera), point[None])
    pixels, _ = cv2.projectPoints(in_camera, np.zeros(3), np.zeros(3), K, dist)
    return pixels.reshape(2), float(in_camera[0, 2])


def _wall_points(camera: Intrinsics, T_rig_camera: Pose) -> np.ndarray:
    turned = _rays(camera) @ T_rig_camera[:3, :3].T
    distance = ROOM.distance_along(T_rig_camera[:3, 3], turned)
    return np.asarray(T_rig_camera[:3, 3] + turned * distance[..., None])


def _disparity(T_rig_depth: Pose) -> ImageU16:
    turned = _rays(DEPTH) @ T_rig_depth[:3, :3].T
    depth_m = ROOM.distance_along(T_rig_depth[:3, 3], turned)  # the rays have z = 1
    model = MODEL.raw_model
    return np.rint(model.offset - model.numerator_m / depth_m).astype(np.uint16)


def _rays(camera: Intrinsics) -> np.ndarray:
    """Rays (H,W,3) of z = 1, by OpenCV."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    pixels = np.column_stack([u.ravel(), v.ravel()])[:, None]
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)
    xy = cv2.undistortPoints(pixels, K, np.array(camera.dist), None, None, None, criteria=criteria)
    return np.concatenate([xy.reshape(*u.shape, 2), np.ones((*u.shape, 1))], axis=2)


def _encoded(frame: RgbdFrame) -> EncodedFrame:
    images = {
        "bayer-lossless": frame.bayer,
        "bgr-lossless": frame.color if frame.bayer is None else None,
        "disparity-lossless": frame.raw,
        "depth-lossless": frame.depth_mm,
    }
    payloads = {
        name: Payload(codec_by_name(name).id, codec_by_name(name).encode(image))
        for name, image in images.items()
        if image is not None
    }
    return EncodedFrame(
        frame.camera_id,
        frame.sequence,
        frame.timestamp_ns,
        frame.uncertainty_ns,
        payloads.get("bayer-lossless") or payloads.get("bgr-lossless"),
        payloads.get("disparity-lossless") or payloads.get("depth-lossless"),
        frame.depth_frame,
        frame.damaged,
        gravity=frame.gravity,
    )


def _broken(frame: EncodedFrame) -> EncodedFrame:
    """The same, of which no image can be read."""
    payloads = {
        name: replace(payload, data=b"no image")
        for name in ("color", "depth")
        if (payload := getattr(frame, name)) is not None
    }
    return replace(frame, **payloads)


def damaged(frame: RgbdFrame) -> RgbdFrame:
    """The same, marked as damaged."""
    return replace(frame, damaged=True)
