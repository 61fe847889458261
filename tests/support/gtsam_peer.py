"""GTSAM on the matches of a calibration: the bundle adjustment that its own C++ factors offer.

Poses and points, pixels and disparities (as the right image of a stereo camera with the sensor's numerator),
the drawing as a prior, Cauchy kernels. It knows no states of depth bias or intrinsics.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt

from rig_calib.depth_model import DepthCorrection
from rig_calib.rig_adjustment import AdjustedRig
from rig_calib.view import CameraView
from rig_protocol.camera import CameraModel
from rig_protocol.poses import Pose, transform_points
from rig_protocol.rig_folder import RingDrawing

Array = npt.NDArray[np.float64]

_KERNEL = 2.385  # of Cauchy's, 95 % efficiency on clean data (Holland & Welsch 1977)


@dataclass(frozen=True, slots=True, eq=False)
class PeerSolution:
    """Poses by camera id, and the seconds that the optimiser took and that building its graph took."""

    poses: Mapping[int, Pose]
    seconds: float
    build_seconds: float


def solve_with_gtsam(
    views: Mapping[int, CameraView],
    rig: AdjustedRig,
    ring: RingDrawing,
    corrections: Mapping[int, DepthCorrection | None] | None = None,
) -> PeerSolution:
    """Adjust the tracks of `rig` from the drawing's poses; `corrections` are applied to depth beforehand."""
    started_s = time.perf_counter()
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    _add_cameras(graph, start, views, rig, ring)
    _add_observations(graph, start, views, rig, corrections or {})
    built_s = time.perf_counter()
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-6)
    found = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters).optimize()
    done_s = time.perf_counter()
    poses = {
        camera: np.asarray(found.atPose3(gtsam.symbol("x", k)).matrix())
        for k, camera in enumerate(rig.scene.cameras)
    }
    return PeerSolution(poses, done_s - built_s, built_s - started_s)


def _add_cameras(
    graph: gtsam.NonlinearFactorGraph,
    start: gtsam.Values,
    views: Mapping[int, CameraView],
    rig: AdjustedRig,
    ring: RingDrawing,
) -> None:
    tolerance = np.repeat([np.deg2rad(ring.tolerance_deg), ring.tolerance_m], 3)
    prior = gtsam.noiseModel.Diagonal.Sigmas(tolerance)
    for k, camera in enumerate(rig.scene.cameras):
        drawn = gtsam.Pose3(views[camera].T_rig_nominal)
        graph.add(gtsam.PriorFactorPose3(gtsam.symbol("x", k), drawn, prior))
        start.insert(gtsam.symbol("x", k), drawn)


def _add_observations(
    graph: gtsam.NonlinearFactorGraph,
    start: gtsam.Values,
    views: Mapping[int, CameraView],
    rig: AdjustedRig,
    corrections: Mapping[int, DepthCorrection | None],
) -> None:
    kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(_KERNEL)
    seen, started = rig.scene.observations, set()
    for k, camera in enumerate(rig.scene.cameras):
        rows = np.flatnonzero(seen.camera == k)
        model, T = views[camera].model, views[camera].T_rig_nominal
        if T is None:
            raise ValueError(f"camera {camera} has no nominal pose to start from")
        color, numerator = model.color, model.raw_model.numerator_m
        z_m = _depth_in_color(model, seen.grid_pixels[rows], seen.disparity[rows], corrections.get(camera))
        mono = gtsam.Cal3_S2(color.fx, color.fy, 0.0, color.cx, color.cy)
        stereo = gtsam.Cal3_S2Stereo(color.fx, color.fy, 0.0, color.cx, color.cy, numerator / color.fx)
        rays = (seen.pixels[rows] - (color.cx, color.cy)) / (color.fx, color.fy)
        points = transform_points(T, np.column_stack([rays, np.ones(len(rows))]) * z_m[:, None])
        for n, row in enumerate(rows.tolist()):
            number, (u, v), whitener = int(seen.point[row]), seen.pixels[row], seen.pixel_whitener[row]
            keys = gtsam.symbol("x", k), gtsam.symbol("l", number)
            if not np.isfinite(z_m[n]):
                robust = gtsam.noiseModel.Robust.Create(kernel, _noise(whitener))
                graph.add(gtsam.GenericProjectionFactorCal3_S2((u, v), robust, *keys, mono))
                continue
            # Order: column, column in the right image, row. The right image differs by the disparity.
            weight = 1 / seen.disparity_sigma[row]
            root = np.vstack([np.insert(whitener, 1, 0.0, axis=1), [weight, -weight, 0.0]])
            robust = gtsam.noiseModel.Robust.Create(kernel, _noise(root))
            both = gtsam.StereoPoint2(u, u - numerator / z_m[n], v)
            graph.add(gtsam.GenericStereoFactor3D(both, robust, *keys, stereo))
            if number not in started:
                start.insert(keys[1], points[n])
                started.add(number)


def _noise(root: Array) -> gtsam.noiseModel.Gaussian:
    """The noise whose square root of information this is; it may leave directions open."""
    return gtsam.noiseModel.Gaussian.SqrtInformation(root, False)


def _depth_in_color(
    model: CameraModel, grid_pixels: Array, disparity: Array, correction: DepthCorrection | None
) -> Array:
    """Depth (N,) along the colour camera's axis of disparities read at pixels of the depth camera."""
    if model.depth is None or model.T_color_depth is None:
        raise ValueError("GTSAM's stereo factors here need raw disparity")
    depth = model.depth
    z_m = model.raw_model.numerator_m / (model.raw_model.offset - disparity)
    x, y = ((grid_pixels - (depth.cx, depth.cy)) / (depth.fx, depth.fy)).T
    if correction is not None:
        z_m = z_m * correction.factor(x, y)
    return np.asarray(transform_points(model.T_color_depth, np.column_stack([x * z_m, y * z_m, z_m]))[:, 2])
