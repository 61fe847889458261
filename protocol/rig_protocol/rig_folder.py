"""The rig folder: one capture of a rig on disk (`nominal.json`, `cam00/color_000.png`, ...).

Images stay as the sensor delivered them. Readers ignore keys that they do not know.
"""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from rig_protocol.camera import CameraModel, RawDepthModel, as_pose
from rig_protocol.errors import ConfigurationError, DataError, RigError
from rig_protocol.frames import RgbdFrame
from rig_protocol.gravity import Gravity, common_gravity
from rig_protocol.poses import Pose
from rig_protocol.troubleshooting import Topic

_FRAME_PERIOD_NS = 33_333_333  # a folder holds no times: frame k is stamped as a 30-Hz sensor would
_COLOR_NAME = re.compile(r"color_(\d+)\.png")


@dataclass(frozen=True, slots=True)
class RingDrawing:
    """The drawing of the ring and its per-axis standard deviations; lengths in metres."""

    radius_m: float = 0.22
    yaw_step_deg: float = 30.0
    tolerance_deg: float = 1.0
    tolerance_m: float = 0.005

    def to_dict(self) -> dict[str, float]:
        """The `formats.md` form of `ring`."""
        return {
            "radius": self.radius_m,
            "yaw_step_deg": self.yaw_step_deg,
            "tolerance_deg": self.tolerance_deg,
            "tolerance_m": self.tolerance_m,
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "RingDrawing":
        """Read `ring` of a `nominal.json`; keys that are absent take the defaults."""
        names = {"radius": "radius_m"}
        keys = ("radius", "yaw_step_deg", "tolerance_deg", "tolerance_m")
        try:
            numbers = {names.get(key, key): float(values[key]) for key in keys if key in values}
        except (TypeError, ValueError, OverflowError) as error:
            raise DataError(f"ring must hold numbers: {error}") from error
        drawing = cls(**numbers)
        if not (drawing.tolerance_deg > 0 and drawing.tolerance_m > 0 and drawing.radius_m >= 0):
            raise DataError(f"ring out of reason: {values}")
        return drawing

    def T_rig_camera(self, slot: int) -> Pose:
        """Nominal pose of the colour camera in a slot: upright ring, looking outward, image +x down.

        Rig: z up, x through slot 0, slots counter-clockwise seen from above.
        """
        yaw = np.deg2rad(self.yaw_step_deg * slot)
        c, s = np.cos(yaw), np.sin(yaw)
        T = np.eye(4)
        T[:3, 0] = (0, 0, -1)
        T[:3, 1] = (-s, c, 0)
        T[:3, 2] = (c, s, 0)
        T[:3, 3] = (self.radius_m * c, self.radius_m * s, 0)
        return T


@dataclass(frozen=True, slots=True, eq=False)
class CameraEntry:
    """One camera of a rig: identity, model, and its pose where one is known.

    `gravity`: down as it felt it during a capture; None where no accelerometer did.
    """

    id: int
    name: str
    model: CameraModel
    T_rig_camera: Pose | None = None
    gravity: Gravity | None = None


@dataclass(frozen=True, slots=True)
class RigDescription:
    """What the user knows of a rig before calibration: `nominal.json`."""

    cameras: tuple[CameraEntry, ...]
    ring: RingDrawing | None = None

    def __post_init__(self) -> None:
        """DataError when two cameras share an id."""
        if len({camera.id for camera in self.cameras}) != len(self.cameras):
            raise DataError("two cameras of the rig share an id")

    @property
    def camera_ids(self) -> tuple[int, ...]:
        """Ids in the order of the file."""
        return tuple(camera.id for camera in self.cameras)

    def camera(self, camera_id: int) -> CameraEntry:
        """The camera with this id; ConfigurationError lists those that exist."""
        for camera in self.cameras:
            if camera.id == camera_id:
                return camera
        raise ConfigurationError(f"camera {camera_id} is not in the rig; it has {list(self.camera_ids)}")

    def to_dict(self) -> dict[str, Any]:
        """The `nominal.json` form."""
        cameras = [
            {
                "id": camera.id,
                "name": camera.name,
                "T_rig_cam": None if camera.T_rig_camera is None else camera.T_rig_camera.tolist(),
                **camera.model.to_dict(),
                **({} if camera.gravity is None else {"gravity": camera.gravity.to_dict()}),
            }
            for camera in self.cameras
        ]
        return {"cameras": cameras} | ({} if self.ring is None else {"ring": self.ring.to_dict()})

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "RigDescription":
        """Read a `nominal.json`; DataError says which camera is malformed."""
        if not isinstance(values, Mapping) or not isinstance(values.get("cameras"), list):
            raise DataError("a rig description needs a list `cameras`")
        shared = values.get("raw_model")
        raw_model = None if shared is None else RawDepthModel.from_dict(shared)
        ring = values.get("ring")
        cameras = tuple(_camera_entry(item, raw_model) for item in values["cameras"])
        return cls(cameras, None if ring is None else RingDrawing.from_dict(ring))


def read_rig_description(path: Path) -> RigDescription:
    """Read `nominal.json`, given the file or its folder; ConfigurationError when there is none."""
    path = path / "nominal.json" if path.is_dir() else path
    values = read_json(path)
    try:
        return RigDescription.from_dict(values)
    except DataError as error:
        raise DataError(f"{path}: {error}") from error


def read_true_poses(path: Path) -> dict[int, Pose]:
    """True T_rig_camera by camera id from a `truth.json` (or its folder)."""
    path = path / "truth.json" if path.is_dir() else path
    values = read_json(path)
    try:
        return {
            int(item["id"]): as_pose(item["T_rig_cam"], f"{path}: T_rig_cam")
            for item in values["cameras"]
            if item["T_rig_cam"] is not None
        }
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(f"{path}: needs cameras with id and T_rig_cam: {error!r}") from error


def write_true_poses(path: Path, poses: Mapping[int, Pose]) -> None:
    """Write a `truth.json` of T_rig_camera by camera id."""
    cameras = [
        {"id": camera_id, "name": f"cam{camera_id:02d}", "T_rig_cam": T.tolist()}
        for camera_id, T in sorted(poses.items())
    ]
    path.write_text(json.dumps({"cameras": cameras}, indent=1) + "\n")


def frame_indices(folder: Path, name: str) -> list[int]:
    """Panoramic frame indices that one camera's subfolder holds, ascending."""
    directory = folder / name
    if not directory.is_dir():
        raise ConfigurationError(f"{directory} does not exist: a rig folder has one subfolder a camera")
    found = (_COLOR_NAME.fullmatch(path.name) for path in directory.iterdir())
    return sorted(int(match.group(1)) for match in found if match)


def read_frame(folder: Path, camera: CameraEntry, index: int) -> RgbdFrame:
    """One camera's frame: colour and the first of raw, depth and registered that is present.

    The camera id is the entry's, the sequence is the index. A camera without any depth file yields a
    frame without depth. DataError for an image that cannot be read or has the wrong type.
    """
    directory = folder / camera.name
    color = _read_image(directory / f"color_{index:03d}.png", np.dtype(np.uint8))
    if color is None:
        raise DataError(f"{directory} holds no color_{index:03d}.png")
    raw = _read_image(directory / f"raw_{index:03d}.png", np.dtype(np.uint16))
    depth_mm, depth_frame = None, "depth"
    if raw is None:
        depth_mm = _read_image(directory / f"depth_{index:03d}.png", np.dtype(np.uint16))
    if raw is None and depth_mm is None:
        depth_mm = _read_image(directory / f"registered_{index:03d}.png", np.dtype(np.uint16))
        depth_frame = "color"
    return RgbdFrame(
        camera_id=camera.id,
        sequence=index,
        timestamp_ns=index * _FRAME_PERIOD_NS,
        color=color,  # _read_image checked the dtype
        raw=raw,
        depth_mm=depth_mm,
        depth_frame="color" if depth_frame == "color" else "depth",
        gravity=camera.gravity,
    )


def write_rig_folder(folder: Path, description: RigDescription, frames: Iterable[RgbdFrame]) -> None:
    """Write every frame, its sequence as the panoramic index, then `nominal.json` with what they felt.

    A Bayer image is demosaiced: the format holds colour as people look at it. RigError when a file cannot be
    written.
    """
    felt: dict[int, list[Gravity]] = {}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for frame in frames:
            if frame.gravity is not None:
                felt.setdefault(frame.camera_id, []).append(frame.gravity)
            directory = folder / description.camera(frame.camera_id).name
            directory.mkdir(exist_ok=True)
            for name, data in encoded_images(frame, frame.sequence).items():
                (directory / name).write_bytes(data)
        write_rig_description(folder, with_gravity(description, felt))
    except OSError as error:
        raise RigError(f"{folder} could not be written: {error.strerror}", Topic.FULL_DISK) from error


def encoded_images(frame: RgbdFrame, index: int) -> dict[str, bytes]:
    """The PNG files of one camera's frame, by their names in its subfolder; a Bayer image is demosaiced."""
    return {f"{kind}_{index:03d}.png": _png(image) for kind, image in _images(frame).items()}


def with_gravity(description: RigDescription, felt: Mapping[int, Sequence[Gravity]]) -> RigDescription:
    """The description with what the cameras felt over a capture, by camera id."""
    cameras = tuple(
        replace(entry, gravity=common_gravity(felt[entry.id])) if entry.id in felt else entry
        for entry in description.cameras
    )
    return replace(description, cameras=cameras)


def write_rig_description(folder: Path, description: RigDescription) -> None:
    """Write `nominal.json`."""
    (folder / "nominal.json").write_text(json.dumps(description.to_dict(), indent=1) + "\n")


def read_json(path: Path) -> Any:
    """Parse a JSON file; ConfigurationError when it is absent, DataError when it is torn."""
    try:
        return json.loads(path.read_text())
    except OSError as error:
        raise ConfigurationError(f"{path} cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise DataError(f"{path} is not valid JSON: {error}") from error


def _camera_entry(item: Any, raw_model: RawDepthModel | None) -> CameraEntry:
    try:
        camera_id = int(item["id"])
        name = str(item.get("name") or f"cam{camera_id:02d}")
        T = item.get("T_rig_cam")
    except (AttributeError, KeyError, TypeError, ValueError, OverflowError) as error:
        raise DataError(f"a camera needs an integer `id`: {error!r}") from error
    if Path(name).name != name or name in ("", ".", ".."):
        raise DataError(f"camera {camera_id}: name {name!r} must be a plain folder name")
    try:
        model = CameraModel.from_dict(item, raw_model)
        pose = None if T is None else as_pose(T, "T_rig_cam")
        felt = item.get("gravity")
        gravity = None if felt is None else Gravity.from_dict(felt)
    except DataError as error:
        raise DataError(f"camera {camera_id}: {error}") from error
    return CameraEntry(camera_id, name, model, pose, gravity)


def _images(frame: RgbdFrame) -> dict[str, npt.NDArray[Any]]:
    color = frame.color
    if color is None and frame.bayer is not None:
        color = cv2.cvtColor(frame.bayer, cv2.COLOR_BayerGRBG2BGR)  # type: ignore[assignment]
    depth_kind = "registered" if frame.depth_frame == "color" else "depth"
    images = {"color": color, "raw": frame.raw, depth_kind: frame.depth_mm}
    return {kind: image for kind, image in images.items() if image is not None}


def _png(image: npt.NDArray[Any]) -> bytes:
    made, data = cv2.imencode(".png", image)
    if not made:
        raise DataError(f"an image of {image.dtype} {image.shape} cannot become a PNG file")
    return bytes(data)


def _read_image(path: Path, dtype: np.dtype[Any]) -> npt.NDArray[Any] | None:
    if not path.is_file():
        return None
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise DataError(f"{path} is not a readable image")
    if image.dtype != dtype or (dtype == np.uint16 and image.ndim != 2):
        raise DataError(f"{path} holds {image.dtype} {image.shape}, expected {dtype}")
    return np.ascontiguousarray(image[..., :3] if image.ndim == 3 else image)
