"""The files of one calibration: calibration.json, report.html, cloud.ply, panorama.png, and its meshes."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from rig_calib.evidence import EdgeEvidence
from rig_calib.fusion.fused import FusedRig, fuse_rig
from rig_calib.fusion.panorama_picture import write_panorama
from rig_calib.fusion.ply import write_ply
from rig_calib.fusion.viewpoint import rig_viewpoint
from rig_calib.report import write_report
from rig_calib.rig_calibration import RigCalibration
from rig_calib.tsdf.extraction import extract_mesh
from rig_calib.tsdf.mesh import Mesh
from rig_calib.tsdf.mesh_files import write_mesh_glb, write_mesh_ply
from rig_calib.tsdf.volume import Volume
from rig_calib.view import CameraView
from rig_calib.whole_file import whole_file
from rig_protocol.errors import ConfigurationError
from rig_protocol.poses import Pose

MESH_PLY, MESH_GLB = "mesh.ply", "mesh.glb"
NAME, BEFORE = "calibration.json", "calibration-before.json"


def make_output_folder(folder: Path) -> None:
    """Make the folder before the work begins; ConfigurationError when nothing can be written there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ConfigurationError(f"cannot write to {folder}: {error.strerror}") from error


def known_calibration(recalibrate: str | None, file: Path | None, folder: Path) -> RigCalibration | None:
    """The calibration that `--recalibrate` starts from: the given file, else that of the output folder.

    None without `--recalibrate`. ConfigurationError for a file without it, or when there is none.
    """
    if recalibrate is None:
        if file is not None:
            raise ConfigurationError("--calibration needs --recalibrate CAMERA")
        return None
    path = file or folder / NAME
    if not path.is_file():
        raise ConfigurationError(
            f"--recalibrate {recalibrate} needs a calibration of the rig, and there is no {path}: name one "
            "with --calibration FILE, or calibrate the whole rig"
        )
    return RigCalibration.load(path)


def keep_before(folder: Path) -> None:
    """Copy a calibration.json that is about to be written anew to calibration-before.json."""
    if (folder / NAME).is_file():
        with whole_file(folder / BEFORE) as file:
            file.write((folder / NAME).read_bytes())


def write_outputs(
    folder: Path,
    calibration: RigCalibration,
    views: Sequence[CameraView],
    evidence: Sequence[EdgeEvidence] = (),
    poses_before: Mapping[int, Pose] | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> FusedRig:
    """Write all four files, also of a calibration that failed its gate; calibration.json comes first.

    `poses_before` are T_rig_camera before loop closure. There is no panorama.png when no camera could be
    placed.
    """
    tell = progress or (lambda _stage, _share: None)
    calibration.save(folder / NAME)
    tell("fusion", 0.0)
    fused = write_fused(folder, calibration, views)
    tell("report", 0.5)
    write_report(folder / "report.html", calibration, views, evidence, poses_before, fused)
    tell("report", 1.0)
    return fused


def write_fused(folder: Path, calibration: RigCalibration, views: Sequence[CameraView]) -> FusedRig:
    """Fuse a capture and write cloud.ply and, when any camera could be placed, panorama.png."""
    fused = fuse_rig(views, calibration)
    write_ply(folder / "cloud.ply", fused.cloud)
    if fused.panorama is not None:
        write_panorama(folder / "panorama.png", fused.panorama)
    return fused


def write_mesh(folder: Path, volume: Volume, calibration: RigCalibration) -> Mesh:
    """Write mesh.ply and mesh.glb of a volume, small floating pieces left out; needs the extra `mesh`."""
    mesh = extract_mesh(volume).without_small_pieces()
    write_mesh_ply(folder / MESH_PLY, mesh)
    write_mesh_glb(
        folder / MESH_GLB, mesh, rig_viewpoint(calibration.poses, calibration.rig_frame).T_rig_view
    )
    return mesh
