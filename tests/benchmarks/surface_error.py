"""Rooms as large as those of the paper's Figure 6, fused to meshes: errors and pictures.

make bench-fusion, or python tests/benchmarks/surface_error.py
"""

import dataclasses
import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
# Last: Open3D lives in a folder of its own, for it brings a pytest plugin that the tests' settings refuse.
sys.path.append(str(Path(__file__).resolve().parents[2] / "build" / "open3d"))

import numpy as np

from rig_agent.simulator.ring import VirtualRig
from rig_agent.simulator.settings import SimulatorSettings
from rig_calib.alignment import align_frames
from rig_calib.calibration import calibrate
from rig_calib.fusion.gains import Gain, color_gains
from rig_calib.fusion.surface import camera_surfaces
from rig_calib.fusion.viewpoint import rig_viewpoint
from rig_calib.rig_calibration import RigCalibration
from rig_calib.settings import CalibrationSettings
from rig_calib.tsdf.extraction import extract_mesh
from rig_calib.tsdf.fusing import fuse_volume
from rig_calib.tsdf.mesh import Mesh
from rig_calib.tsdf.range_image import range_images
from rig_calib.view import CameraView
from rig_protocol.poses import Pose, inverse
from support.benchmark_record import (
    REPOSITORY,
    machine,
    markdown_table,
    merge_results,
    results_of,
    write_section,
)
from support.mesh_picture import mesh_picture
from support.rendered_rig import RenderedRig, rendered_rig
from support.true_surfaces import (
    MESH_POINTS,
    SPACING_M,
    SeenSurfaces,
    accuracy_mm,
    completeness,
    seen_surfaces,
)

ROOMS = {"bedroom": (3.3, 3.0, 2.6), "living room": (9.0, 3.5, 2.6)}
AZIMUTHS_DEG = {"bedroom": 25.0, "living room": 115.0}
CALIBRATION_FRAMES = 3
FRAMES = (1, 10)
VOXEL_M = 0.01
OPEN3D_TRUNCATION_VOXELS = 4.0
PAGE = REPOSITORY / "docs" / "surface.md"
PICTURES = REPOSITORY / "docs" / "images"
MAX_PICTURE_BYTES = 300_000


def first_frames(views: Sequence[CameraView], count: int) -> list[CameraView]:
    """The views of the first frames alone."""
    return [dataclasses.replace(view, color=view.color[:count], raw=view.raw[:count]) for view in views]


def with_true_poses(calibration: RigCalibration, truth: Mapping[int, Pose]) -> RigCalibration:
    """The calibration, its depth corrections included, with the cameras where they really are."""
    cameras = [dataclasses.replace(one, T_rig_camera=truth[one.id]) for one in calibration.cameras]
    return dataclasses.replace(calibration, cameras=tuple(cameras))


def gains_of(views: Sequence[CameraView], calibration: RigCalibration) -> dict[int, Gain]:
    """As `rig-calib fuse` matches colours."""
    return color_gains(camera_surfaces(views, calibration)[0], calibration.poses)


def fused(views: Sequence[CameraView], calibration: RigCalibration) -> tuple[Mesh, float]:
    """The mesh, and the seconds of processor time that it took."""
    gains = gains_of(views, calibration)
    started_s = time.process_time()
    mesh = extract_mesh(fuse_volume(views, calibration, gains, VOXEL_M)).without_small_pieces()
    return mesh, time.process_time() - started_s


def open3d_mesh(views: Sequence[CameraView], calibration: RigCalibration) -> Mesh:
    """What Open3D's VoxelBlockGrid makes of the same cleaned, corrected depth."""
    import open3d as o3d

    names, kinds, sizes = ("tsdf", "weight", "color"), (o3d.core.float32,) * 3, (1, 1, 3)
    grid = o3d.t.geometry.VoxelBlockGrid(names, kinds, sizes, VOXEL_M, 16, 40_000, o3d.core.Device("CPU:0"))
    for image in range_images(views, calibration, {})[0]:
        at = image.grid.intrinsics
        with np.errstate(divide="ignore"):
            depth = np.where(image.inverse_depth > 0, 1 / image.inverse_depth, 0).astype(np.float32)
        shown = o3d.t.geometry.Image(depth), o3d.t.geometry.Image(image.colors.astype(np.float32) / 255)
        camera = o3d.core.Tensor([[at.fx, 0, at.cx], [0, at.fy, at.cy], [0, 0, 1]], o3d.core.float64)
        extrinsic, limits = o3d.core.Tensor(inverse(image.T_rig_grid)), (1.0, 8.0, OPEN3D_TRUNCATION_VOXELS)
        blocks = grid.compute_unique_block_coordinates(shown[0], camera, extrinsic, *limits)
        grid.integrate(blocks, *shown, camera, camera, extrinsic, *limits)
    mesh = grid.extract_triangle_mesh(weight_threshold=0.5)
    colors = np.rint(255 * mesh.vertex.colors.numpy()).clip(0, 255).astype(np.uint8)
    vertices, faces = mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy()
    return Mesh(vertices.astype(np.float64), faces.astype(np.int64), colors)


def errors(mesh: Mesh, T_room_rig: Pose, truth: SeenSurfaces) -> dict[str, float]:
    """Accuracy, completeness and size of a mesh."""
    size = {"triangles": len(mesh.faces), "area_m2": mesh.area_m2()}
    return accuracy_mm(mesh, T_room_rig, truth) | completeness(mesh, T_room_rig, truth) | size


def cases(
    room: str, rendered: RenderedRig, rig: VirtualRig, calibration: RigCalibration
) -> Iterator[dict[str, Any]]:
    """A record for every number of frames, with the calibration's poses and with the true ones."""
    truth = seen_surfaces(rig)
    known = {"calibrated": calibration, "true": with_true_poses(calibration, rendered.truth)}
    for frames in FRAMES:
        views = first_frames(rendered.views, frames)
        for poses, one in known.items():
            T_room_rig = rig.scene.T_room_rig @ align_frames(one.poses, rendered.truth)
            mesh, cpu_s = fused(views, one)
            if frames == 1 and poses == "calibrated":
                draw(room, mesh, one)
            case = {"room": room, "frames": frames, "poses": poses, "cpu_s": cpu_s}
            yield case | errors(mesh, T_room_rig, truth)
            try:
                peer = open3d_mesh(views, one).without_small_pieces()
                yield {**case, "by": "Open3D"} | errors(peer, T_room_rig, truth)
            except ImportError:
                pass


def draw(room: str, mesh: Mesh, calibration: RigCalibration) -> None:
    """The room from outside and above."""
    view = rig_viewpoint(calibration.poses, calibration.rig_frame)
    picture = mesh_picture(mesh, view.T_rig_view, AZIMUTHS_DEG[room])
    target = PICTURES / f"surface_{room.replace(' ', '_')}.jpg"
    for quality in range(90, 40, -5):
        encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
        if len(encoded) < MAX_PICTURE_BYTES:
            target.write_bytes(encoded)
            return
    raise ValueError(f"{target} would be larger than {MAX_PICTURE_BYTES} bytes")


def run() -> list[dict[str, Any]]:
    """All records."""
    records: list[dict[str, Any]] = []
    for room, size_m in ROOMS.items():
        settings = SimulatorSettings(room_m=size_m)
        rendered = rendered_rig(settings, max(FRAMES))
        views = first_frames(rendered.views, CALIBRATION_FRAMES)
        calibration = calibrate(views, rendered.ring, CalibrationSettings()).calibration
        for record in cases(room, rendered, VirtualRig(settings), calibration):
            print(record, flush=True)
            records.append(record)
    return records


def row(record: Mapping[str, Any]) -> list[str]:
    """A line of the table."""
    name = f"{record['room']}, {record['frames']} frame{'s' if record['frames'] > 1 else ''}"
    return [
        name + (f", {record['by']}" if "by" in record else ""),
        record["poses"],
        f"{record['median_mm']:.1f}",
        f"{record['p90_mm']:.1f}",
        f"{record['rms_mm']:.1f}",
        f"{record['beyond_50_mm']:.2%}",
        f"{record['within_20_mm']:.1%}",
        f"{record['within_50_mm']:.1%}",
        f"{record['area_m2']:.1f}",
    ]


def report(records: Sequence[Mapping[str, Any]], load: tuple[float, float]) -> str:
    """The section of docs/surface.md."""
    header = ["", "poses", "median mm", "90 % mm", "RMS mm", "> 5 cm", "within 2 cm", "within 5 cm", "m²"]
    cpu = {record["room"]: record["cpu_s"] for record in records if record["frames"] == 1}
    cost = " and ".join(f"{cpu_s:.1f} s ({room})" for room, cpu_s in cpu.items())
    return f"""`python tests/benchmarks/surface_error.py` on {machine("numpy", "numba", "scikit-image")};
load {load[0]:.1f} before and {load[1]:.1f} after, other programs' included. Voxels of
{VOXEL_M * 1e3:.0f} mm; twelve cameras, calibrated from {CALIBRATION_FRAMES} frames. A volume of one panoramic
frame and its mesh take {cost} of processor time.

{markdown_table(header, [row(record) for record in records])}

Accuracy (the first four figures) is the distance of {MESH_POINTS:,} points of the mesh, evenly by area,
from the simulator's rectangles: an exact distance, to rectangles of which a camera sees something nearby.
Completeness is the share of the true surface that has mesh within 2 and 5 cm, over points every
{SPACING_M * 1e3:.0f} mm; the mesh is taken by its vertices and the middles of its faces, some 4 mm apart. Of
the true surface counts what a depth camera sees: in its image, 0.5 to 5 m away, at less than 80° from the
normal, nothing in between; the shadow of a Kinect's projector is not taken off. With the *true* poses the
calibration's depth corrections stay: the difference is what its poses cost. Open3D's `VoxelBlockGrid` gets
the same cleaned and corrected depth, truncated at {OPEN3D_TRUNCATION_VOXELS:.0f} voxels; it weighs all
measurements alike."""


def main() -> None:
    """Measure, record, print."""
    before = os.getloadavg()[0]
    records = run()
    load = before, os.getloadavg()[0]
    known = results_of("fusion") or {}
    merge_results({"fusion": known | {"surface": {"load": load, "cases": records}}})
    write_section("surface", report(records, load), PAGE)
    print(report(records, load))


if __name__ == "__main__":
    main()
