"""Live fusion of twelve simulated Kinects: rate, memory, Open3D's time, errors against the true surfaces.

make bench-fusion
"""

import os
import sys
import time
import tracemalloc
from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
# Last: Open3D lives in a folder of its own, for it brings a pytest plugin that the tests' settings refuse.
sys.path.append(str(Path(__file__).resolve().parents[2] / "build" / "open3d"))

from rig_agent.simulator.ring import VirtualRig, rig_description, true_poses
from rig_agent.simulator.settings import SimulatorSettings
from rig_calib.alignment import align_frames
from rig_calib.calibration import calibrate
from rig_calib.depth_model import depth_sigma_m
from rig_calib.fusion.live import FusedFrame, LiveFusion, LiveFusionSettings
from rig_calib.fusion.voxels import voxel_keys
from rig_calib.rig_calibration import RigCalibration
from rig_calib.settings import CalibrationSettings
from rig_calib.view import views_from_panoramas
from rig_protocol.camera import CameraModel
from rig_protocol.frames import NO_DISPARITY, PanoramicFrame
from rig_protocol.poses import inverse, transform_points
from support.benchmark_record import machine, merge_results, results_of, write_section
from support.true_optics import first_hits

FRAMES = 3
REPEATS = 25
FLAT_FRAMES = 200
STRIDE = 7
CELL_M = 0.05
LEAST_IN_CELL = 10
MODEL_MEDIAN = 0.6745
"""Median of |x| of a normal variable of standard deviation one."""

Array = npt.NDArray[np.float64]
Models = Mapping[int, CameraModel]


def captured(rig: VirtualRig) -> list[PanoramicFrame]:
    """What the cameras deliver."""
    ids = range(rig.settings.cameras)
    return [PanoramicFrame.of(k, {i: rig.camera(i).frame(k) for i in ids}) for k in range(FRAMES)]


def seconds_of(function: Callable[[int], object]) -> list[float]:
    """Times of several runs, the first of which does not count."""
    times = []
    for k in range(REPEATS + 1):
        start = time.perf_counter()
        function(k)
        times.append(time.perf_counter() - start)
    return times[1:]


def rate(calibration: RigCalibration, models: Models, frames: Sequence[PanoramicFrame], threads: int) -> Any:
    """Panoramas a second, of the quickest run and by the median, and processor time of one."""
    with LiveFusion(calibration, models, LiveFusionSettings(threads=threads)) as fusion:
        fusion.fuse(frames[0])
        before_s = time.process_time()
        times = seconds_of(lambda k: fusion.fuse(frames[k % len(frames)]))
        cpu_ms = 1e3 * (time.process_time() - before_s) / (REPEATS + 1)
    return {"best": 1 / min(times), "median": 1 / float(np.median(times)), "cpu_ms": cpu_ms}


def memory_growth_kib(fusion: LiveFusion, frames: Sequence[PanoramicFrame]) -> float:
    """What Python and NumPy hold more after many frames than after a few."""
    tracemalloc.start()
    for k in range(100):  # the interpreter's pools of small objects fill up first
        fusion.fuse(frames[k % len(frames)])
    before, _ = tracemalloc.get_traced_memory()
    for k in range(FLAT_FRAMES):
        fusion.fuse(frames[k % len(frames)])
    after, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return (after - before) / 1024


def open3d_rates(calibration: RigCalibration, models: Models, frame: PanoramicFrame) -> dict[str, float]:
    """Clouds a second of Open3D's two pipelines on images that are registered and in metres already."""
    import open3d as o3d

    prepared = []
    for camera_id, T in calibration.poses.items():
        image, model = frame.frames[camera_id], models[camera_id]
        assert image is not None
        assert image.raw is not None
        assert image.bayer is not None
        assert model.depth is not None
        raw = image.raw.astype(np.float64)
        depth = np.where(raw < NO_DISPARITY, model.raw_model.numerator_m / (model.raw_model.offset - raw), 0)
        color, at = np.repeat(image.bayer[..., None], 3, axis=2), model.depth
        prepared.append((color, depth.astype(np.float32), at, np.asarray(T @ model.T_color_depth)))

    def legacy(_: int) -> object:
        cloud = o3d.geometry.PointCloud()
        for color, depth, camera, T in pictures:
            rgbd = o3d.geometry.RGBDImage.create_from_color_and_depth(color, depth, 1.0, 8.0, False)
            cloud += o3d.geometry.PointCloud.create_from_rgbd_image(rgbd, camera).transform(T)
        return cloud

    def tensor(_: int) -> object:
        cloud = None
        for rgbd, camera, extrinsic in tensors:
            one = o3d.t.geometry.PointCloud.create_from_rgbd_image(rgbd, camera, extrinsic, 1.0, 8.0)
            cloud = one if cloud is None else cloud.append(one)
        return cloud

    pictures = [
        (
            o3d.geometry.Image(color),
            o3d.geometry.Image(depth),
            o3d.camera.PinholeCameraIntrinsic(640, 480, at.fx, at.fy, at.cx, at.cy),
            T,
        )
        for color, depth, at, T in prepared
    ]
    tensors = [
        (
            o3d.t.geometry.RGBDImage(o3d.t.geometry.Image(color), o3d.t.geometry.Image(depth)),
            o3d.core.Tensor([[at.fx, 0, at.cx], [0, at.fy, at.cy], [0, 0, 1]], o3d.core.float64),
            o3d.core.Tensor(inverse(T)),
        )
        for color, depth, at, T in prepared
    ]
    return {"open3d_s": 1 / min(seconds_of(legacy)), "open3d_tensor_s": 1 / min(seconds_of(tensor))}


def cloud_errors(
    rig: VirtualRig, calibration: RigCalibration, models: Models, fused: FusedFrame
) -> tuple[Array, Array, Array, npt.NDArray[np.intp]]:
    """Some points (N,3), errors (N,) along their true rays, σ (N,) of the noise model, cameras (N,)."""
    T_true_rig = align_frames(calibration.poses, true_poses(rig.settings))
    points, errors, sigmas, owners = [], [], [], []
    for k, camera_id in enumerate(fused.camera_ids):
        own = fused.points_m[fused.starts[k] : fused.starts[k + 1] : STRIDE].astype(np.float64)
        T_room_depth = rig.camera(camera_id).view().T_room_depth
        local = transform_points(inverse(T_room_depth) @ rig.scene.T_room_rig @ T_true_rig, own)
        hits = first_hits(rig.scene.surfaces, T_room_depth, local[:, :2] / local[:, 2:])
        errors.append(local[:, 2] - hits.points[:, 2])
        sigmas.append(depth_sigma_m(models[camera_id].raw_model, local[:, 2], rounded_to_mm=False))
        points.append(own)
        owners.append(np.full(len(own), k))
    return tuple(map(np.concatenate, (points, errors, sigmas, owners)))  # type: ignore[return-value]


def double_wall_mm(points: Array, errors: Array, owners: npt.NDArray[np.intp]) -> tuple[float, float, int]:
    """By how much two cameras' surfaces differ in cells that hold points of both: median, 90 %, cells."""
    keys = voxel_keys(points, CELL_M)
    order = np.lexsort((owners, keys))
    keys, errors, owners = keys[order], errors[order], owners[order]
    borders = np.flatnonzero((np.diff(keys) != 0) | (np.diff(owners) != 0)) + 1
    groups = np.split(np.arange(len(keys)), borders)
    groups = [group for group in groups if len(group) >= LEAST_IN_CELL]
    medians = [(keys[group[0]], float(np.median(errors[group]))) for group in groups]
    apart = [abs(a[1] - b[1]) for a, b in pairwise(medians) if a[0] == b[0]]
    return 1e3 * float(np.median(apart)), 1e3 * float(np.percentile(apart, 90)), len(apart)


def alone(calibration: RigCalibration, models: Models, frame: PanoramicFrame) -> FusedFrame:
    """Every camera for itself: what the cloud would be without arbitration."""
    parts = []
    for camera_id in calibration.poses:
        with LiveFusion(calibration, {camera_id: models[camera_id]}) as fusion:
            parts.append(fusion.fuse(frame))
    return FusedFrame(
        index=frame.index,
        timestamp_ns=frame.timestamp_ns,
        points_m=np.concatenate([part.points_m for part in parts]),
        colors=np.concatenate([part.colors for part in parts]),
        camera_ids=tuple(part.camera_ids[0] for part in parts),
        starts=np.cumsum([0, *(len(part.points_m) for part in parts)]),
        panorama=parts[0].panorama,
        panorama_depth_m=parts[0].panorama_depth_m,
        skipped=(),
    )


def accuracy(rig: VirtualRig, calibration: RigCalibration, models: Models, frame: PanoramicFrame) -> Any:
    """Errors of the fused cloud, and double walls with and without arbitration."""
    with LiveFusion(calibration, models) as fusion:
        fused = fusion.fuse(frame)
        points, errors, sigmas, owners = cloud_errors(rig, calibration, models, fused)
        filled = float(np.isfinite(fused.panorama_depth_m).mean())
        count = len(fused.points_m)
    apart = alone(calibration, models, frame)
    single, single_errors, _, single_owners = cloud_errors(rig, calibration, models, apart)
    doubled, doubled_90, cells = double_wall_mm(points, errors, owners)
    before, before_90, cells_before = double_wall_mm(single, single_errors, single_owners)
    return {
        "points": count,
        "points_without_arbitration": len(apart.points_m),
        "panorama_filled": filled,
        "cloud_median_error_mm": 1e3 * float(np.median(np.abs(errors))),
        "noise_model_median_mm": 1e3 * MODEL_MEDIAN * float(np.median(sigmas)),
        "error_over_sigma_median": float(np.median(np.abs(errors) / sigmas)),
        "farther_than_10_sigma": float(np.mean(np.abs(errors) > 10 * sigmas)),
        "double_wall_mm": doubled,
        "double_wall_90_mm": doubled_90,
        "seam_cells": cells,
        "double_wall_without_mm": before,
        "double_wall_without_90_mm": before_90,
        "shared_cells_without": cells_before,
    }


def run() -> dict[str, Any]:
    """The section `fusion` of bench.json."""
    settings = SimulatorSettings()
    rig, description = VirtualRig(settings), rig_description(settings)
    frames = captured(rig)
    models = {camera.id: camera.model for camera in description.cameras}
    views = views_from_panoramas(description, frames)
    calibration = calibrate(views, description.ring, CalibrationSettings()).calibration
    results: dict[str, Any] = {"cameras": settings.cameras, "load_before": os.getloadavg()[0]}
    results |= accuracy(rig, calibration, models, frames[0])
    rates = {str(threads): rate(calibration, models, frames, threads) for threads in (1, 2)}
    results |= {"panoramas_s": rates["2"]["best"], "rates": rates}
    try:
        results |= open3d_rates(calibration, models, frames[0])
        results["ratio_open3d"] = results["panoramas_s"] / results["open3d_s"]
        results["ratio_open3d_tensor"] = results["panoramas_s"] / results["open3d_tensor_s"]
    except ImportError as error:
        results["open3d_skipped"] = f"Open3D is not installed here ({error})"
    with LiveFusion(calibration, models) as fusion:
        results["growth_kib_200_frames"] = memory_growth_kib(fusion, frames)
    return results | {"load_after": os.getloadavg()[0]}


def open3d_sentence(results: Mapping[str, Any]) -> str:
    """What Open3D takes."""
    if "open3d_skipped" in results:
        return str(results["open3d_skipped"]) + "."
    return f"""Open3D in the same run, from images that are decoded and registered already, without cleaning,
arbitration or panorama: {results["open3d_s"]:.2f} clouds a second by `create_from_rgbd_image`,
`transform` and `+=` (live fusion is **{results["ratio_open3d"]:.2f} times** as fast),
{results["open3d_tensor_s"]:.2f} by its tensor API ({results["ratio_open3d_tensor"]:.2f} times)."""


def rate_sentences(results: Mapping[str, Any]) -> str:
    """Rate and memory."""
    one, two, growth = results["rates"]["1"], results["rates"]["2"], results["growth_kib_200_frames"]
    return f"""Twelve simulated Kinects, 640×480 raw disparity and Bayer, calibrated from {FRAMES} frames,
to a cloud of {results["points"] / 1e6:.2f} million points and a panorama of 3000 columns, colour and depth:
**{two["best"]:.1f} panoramas a second** on two threads (the quickest of {REPEATS}; {two["median"]:.1f} by
the median), {one["best"]:.1f} on one ({one["median"]:.1f}), of {one["cpu_ms"]:.0f} ms of processor time each.
After {FLAT_FRAMES} more frames Python and NumPy hold {growth:.0f} KiB more than before."""


def error_sentences(results: Mapping[str, Any]) -> str:
    """Errors and double walls."""
    fused = results["double_wall_mm"], results["double_wall_90_mm"], results["seam_cells"]
    without, without_90 = results["double_wall_without_mm"], results["double_wall_without_90_mm"]
    return f"""Against the simulator's surfaces, along the true rays: median error
**{results["cloud_median_error_mm"]:.1f} mm**, depth distortion and calibration included; noise alone makes it
{results["noise_model_median_mm"]:.1f} mm for a single pixel. The median of error over σ of the noise model is
{results["error_over_sigma_median"]:.2f} (of a normal variable {MODEL_MEDIAN:.2f});
{results["farther_than_10_sigma"]:.2%} of the points are off by more than ten σ.

Where two cameras have points in one cell of {CELL_M * 100:.0f} cm, their surfaces are
**{fused[0]:.1f} mm** apart (median; 90 %: {fused[1]:.1f} mm; {fused[2]} cells, all on seams).
Without arbitration it is {without:.1f} mm (90 %: {without_90:.1f} mm;
{results["shared_cells_without"]} cells), and the cloud has
{results["points_without_arbitration"] / 1e6:.2f} million points."""


def report(results: Mapping[str, Any]) -> str:
    """The fusion section of docs/performance.md."""
    return f"""## Live fusion

`make bench-fusion` on {machine("numpy", "numba")}; load {results["load_before"]:.1f} before and
{results["load_after"]:.1f} after, other programs' included.

{rate_sentences(results)}

{open3d_sentence(results)}

{error_sentences(results)}"""


def main() -> None:
    """Measure, record, print."""
    results = run()
    merge_results({"fusion": (results_of("fusion") or {}) | results})
    write_section("fusion", report(results))
    print(report(results))


if __name__ == "__main__":
    main()
