"""The cameras that an export shows: those of the capture that its calibration places."""

from collections.abc import Sequence
from dataclasses import dataclass

from rig_calib.depth_model import DepthCorrection, DepthGrid, depth_grid
from rig_calib.frame_exports.job import ExportJob
from rig_calib.view import CameraView, views_from_panoramas
from rig_protocol.camera import CameraModel
from rig_protocol.errors import DataError
from rig_protocol.frames import DepthFrame, PanoramicFrame
from rig_protocol.poses import Pose
from rig_protocol.rig_folder import RigDescription


@dataclass(frozen=True, slots=True, eq=False)
class PlacedCamera:
    """One unit: its name, its model, where its colour camera is, and what corrects its depth."""

    id: int
    name: str
    model: CameraModel
    T_rig_camera: Pose
    correction: DepthCorrection | None

    def grid(self, depth_frame: DepthFrame) -> DepthGrid:
        """The pixels of its depth images; DataError when its model lacks what they need."""
        try:
            return depth_grid(self.model, depth_frame)
        except DataError as error:
            raise DataError(f"{self.name}: {error}") from error


def placed_cameras(job: ExportJob) -> tuple[PlacedCamera, ...]:
    """Those that the calibration places, in the capture's order.

    ConfigurationError without a calibration; DataError when it places none, or two share a name.
    """
    calibration = job.needed_calibration()
    placed = tuple(
        PlacedCamera(entry.id, entry.name, entry.model, known.T_rig_camera, known.depth_correction)
        for entry in job.capture.description.cameras
        if (known := calibration.camera(entry.id)) is not None
    )
    if not placed:
        raise DataError(f"the calibration places no camera of {job.capture.path}: there is nothing to export")
    if len({camera.name for camera in placed}) < len(placed):
        raise DataError("two cameras share a name, which is how other programs tell them apart")
    return placed


def unplaced_notes(job: ExportJob, placed: Sequence[PlacedCamera]) -> list[str]:
    """A sentence for every camera that is left out."""
    ids = {camera.id for camera in placed}
    left_out = [entry.name for entry in job.capture.description.cameras if entry.id not in ids]
    return [f"{name}: left out, the calibration could not place it" for name in left_out]


def missing_notes(names: Sequence[str], written: Sequence[int], wanted: int) -> list[str]:
    """A sentence for every camera of which fewer images were written than there are panoramic frames."""
    return [
        f"{name}: {wanted - count} of {wanted} frames are missing or damaged, and left out"
        for name, count in zip(names, written, strict=True)
        if count < wanted
    ]


def views_by_id(description: RigDescription, panorama: PanoramicFrame) -> dict[int, CameraView]:
    """The views of one panoramic frame, of the cameras that delivered an undamaged image of colour."""
    views = views_from_panoramas(description, [panorama])
    return {view.camera_id: view for view in views if view.color}
