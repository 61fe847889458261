"""One trial: a rig of known truth calibrated once, and all that is asked of the result."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rig_calib.calibration import CalibrationResult
from rig_calib.evaluation import Evaluation, PoseError, evaluate
from rig_calib.rig_adjustment import AdjustedRig
from rig_calib.view import CameraView
from rig_protocol.poses import Pose, adjoint, inverse, se3_log

Array = npt.NDArray[np.float64]
Pair = tuple[int, int]


@dataclass(frozen=True, slots=True)
class Consistency:
    """Normalised error squared per degree of freedom of several errors of one rig: 1 where σ is honest.

    Errors of one rig are correlated: their mean scatters like a χ² of `dof` degrees of freedom over `dof`
    (Satterthwaite 1946, from the joint covariance).
    """

    nees: float
    dof: float


@dataclass(frozen=True, slots=True)
class Trial:
    """What came of one calibration; errors of the drawing are those of the cameras that were placed."""

    seed: int
    seconds: Mapping[str, float]
    failures: tuple[str, ...]
    warnings: tuple[str, ...]
    missing: tuple[int, ...]
    edges: Mapping[Pair, PoseError]
    near: tuple[PoseError, ...]
    opposite: tuple[PoseError, ...]
    absolute_mm: float
    nominal_mm: float
    pairs_nees: Consistency | None
    cameras_nees: Consistency | None
    edge_nees: Mapping[Pair, float]
    matches: int
    crashed: bool = False

    @property
    def deg(self) -> float:
        """Mean rotation error of the neighbours."""
        return float(np.mean([error.deg for error in self.edges.values()])) if self.edges else np.nan

    @property
    def mm(self) -> float:
        """Mean translation error of the neighbours."""
        return float(np.mean([error.mm for error in self.edges.values()])) if self.edges else np.nan


def crash(seed: int, error: Exception) -> Trial:
    """The trial of a calibration that raised, which none should."""
    return Trial(
        seed=seed,
        seconds={"total": np.nan},
        failures=(f"it crashed: {error!r}",),
        warnings=(),
        missing=(),
        edges={},
        near=(),
        opposite=(),
        absolute_mm=np.nan,
        nominal_mm=np.nan,
        pairs_nees=None,
        cameras_nees=None,
        edge_nees={},
        matches=0,
        crashed=True,
    )


def judge(
    seed: int, result: CalibrationResult, views: Sequence[CameraView], truth: Mapping[int, Pose]
) -> Trial:
    """Errors of a result and what it said about them."""
    calibration = result.calibration
    nominal = {view.camera_id: view.T_rig_nominal for view in views if view.T_rig_nominal is not None}
    found = evaluate(calibration, truth) if calibration.poses else None
    placed = {camera: nominal[camera] for camera in nominal.keys() & calibration.poses.keys()}
    drawn = evaluate(placed, truth) if placed else None
    rig = result.rig
    neighbours = () if found is None else found.neighbours
    return Trial(
        seed=seed,
        seconds=dict(calibration.seconds),
        failures=calibration.failures,
        warnings=calibration.warnings,
        missing=tuple(sorted(truth)) if found is None else found.missing,
        edges={} if found is None else {pair: found.pairs[pair] for pair in neighbours},
        near=() if found is None else tuple(found.pairs[pair] for pair in found.near),
        opposite=() if found is None else _opposite(found, truth),
        absolute_mm=_mean_absolute_mm(found),
        nominal_mm=_mean_absolute_mm(drawn),
        pairs_nees=None if rig is None else _pairs_consistency(rig, truth, neighbours),
        cameras_nees=None if rig is None else _cameras_consistency(rig, truth),
        edge_nees={} if rig is None else {pair: _pair_nees(rig, truth, pair) for pair in neighbours},
        matches=sum(edge.inliers for edge in calibration.edges if edge.used),
    )


def _mean_absolute_mm(evaluation: Evaluation | None) -> float:
    summary = None if evaluation is None else evaluation.absolute
    return np.nan if summary is None else summary.mean.mm


def _opposite(found: Evaluation, truth: Mapping[int, Pose]) -> tuple[PoseError, ...]:
    """Errors of the pairs half a ring apart."""
    half = len(truth) // 2
    return tuple(error for (i, j), error in found.pairs.items() if j - i == half)


def pose_error(estimated: Pose, true: Pose) -> Array:
    """δ (6,) with T_true = T_estimated · Exp(δ)."""
    return np.asarray(se3_log(inverse(estimated) @ true))


def _pair_error(rig: AdjustedRig, truth: Mapping[int, Pose], pair: Pair) -> tuple[Array, Array]:
    """δ (6,) of a pair's relative pose, and its covariance."""
    T_i_j, covariance = rig.relative(*pair)
    return pose_error(T_i_j, inverse(truth[pair[0]]) @ truth[pair[1]]), covariance


def _pair_nees(rig: AdjustedRig, truth: Mapping[int, Pose], pair: Pair) -> float:
    error, covariance = _pair_error(rig, truth, pair)
    return float(error @ np.linalg.solve(covariance, error)) / 6


def _pairs_consistency(rig: AdjustedRig, truth: Mapping[int, Pose], pairs: Sequence[Pair]) -> Consistency:
    order = rig.scene.cameras
    linear, nees = [], []
    for i, j in pairs:
        row = np.zeros((6, len(order), 6))
        row[:, order.index(j)] = np.eye(6)
        row[:, order.index(i)] = -adjoint(inverse(rig.relative(i, j)[0]))
        linear.append(row.reshape(6, -1))
        nees.append(_pair_nees(rig, truth, (i, j)))
    return Consistency(float(np.mean(nees)), _degrees_of_freedom(rig, linear))


def _cameras_consistency(rig: AdjustedRig, truth: Mapping[int, Pose]) -> Consistency:
    """Of the cameras in the rig's frame; the camera that defines the frame has no error to speak of."""
    order = rig.scene.cameras
    linear, nees = [], []
    for k, camera in enumerate(order):
        covariance = rig.covariance_of(camera)
        if not covariance.any():
            continue
        row = np.zeros((6, len(order), 6))
        row[:, k] = np.eye(6)
        linear.append(row.reshape(6, -1))
        error = pose_error(rig.poses[camera], truth[camera])
        nees.append(float(error @ np.linalg.solve(covariance, error)) / 6)
    return Consistency(float(np.mean(nees)), _degrees_of_freedom(rig, linear))


def _degrees_of_freedom(rig: AdjustedRig, linear: Sequence[Array]) -> float:
    """Of the mean over k of e_kᵀ C_k⁻¹ e_k / 6 with e_k = A_k δ: two over its variance, 2 tr(MΣMΣ)."""
    size = linear[0].shape[1]
    joint = rig.covariance.blocks.reshape(size, size)
    M = sum(A.T @ np.linalg.solve(A @ joint @ A.T, A) for A in linear) / (6 * len(linear))
    MC = M @ joint
    return float(1 / np.trace(MC @ MC))
