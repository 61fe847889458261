"""One robust adjustment of all camera states and all landmarks (Triggs et al., "Bundle Adjustment", 2000).

Levenberg-Marquardt with a Cauchy kernel; the landmarks are eliminated by the Schur complement. Landmarks are
points, planes that cameras share, and the direction of gravity. Every camera carries priors: on its pose (the
drawing) and on what is wrong with its factory model.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg

from rig_calib.camera_priors import CameraPriors, prior_pose, weights_of
from rig_calib.depth_model import DepthGrid
from rig_calib.landmark_rows import GravityObservations, LandmarkCounts, LandmarkRows, Rows
from rig_calib.normal_equations import Groups, Landmarks, eliminate, landmark_steps, reweight, robust_cost
from rig_calib.observation_model import (
    GRID_INTRINSIC_TERMS,
    GRID_POSE_TERMS,
    CameraState,
    FactoryModels,
    Observations,
    PlaneObservations,
)
from rig_calib.rotations import rotation_matrices
from rig_protocol.camera import Intrinsics
from rig_protocol.gravity import KINECT_SIGMA_DEG
from rig_protocol.poses import Pose

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]

# Where the kernel starts to bend, in standard deviations: 95 % efficiency on clean data (Holland &
# Welsch 1977), squared, for a pixel's two coordinates and for a disparity.
_CAUCHY_SQUARED = 2.385**2
_LEAST_CURVATURE = 0.2  # beyond the kernel's bend its curvature is negative
_NEAR = 0.003  # relative decrease of the cost to be expected
_MAX_ITERATIONS = 40
CONVERGED, ROUGHLY_CONVERGED = 0.005, 0.1
"""What another step is expected to bring of the cost: one standard deviation of a state is worth a half."""
_FIRST_DAMPING, _LEAST_DAMPING, _MAX_DAMPING = 1e-6, 1e-12, 1e8
_RAISED_DAMPING = 0.1  # at least, after a step that led uphill: less changes nothing
_LEAST_INFORMATION = 1e-12
# From here on, 40 cameras or so, a ring is solved faster as a sparse system.
_MANY_STATES = 1000


@dataclass(frozen=True, slots=True, eq=False)
class AdjustedCamera:
    """One camera of a problem: factory models, priors, and the state to start from.

    `T_prior` with `pose_sigma` (6,) is the drawing's pose; None = no prior. A fixed pose defines the frame.
    The other `_sigma`s are standard deviations, about `expected` (None: the factory model), of a
    `CameraState`'s fields; 0 holds a term at its start. `gravity` (3,) is down in the camera frame, known to
    `gravity_sigma` rad.
    """

    color: Intrinsics
    grid: DepthGrid
    start: CameraState
    bias_sigma: Array
    intrinsics_sigma: Array
    grid_pose_sigma: Array = field(default_factory=lambda: np.zeros(GRID_POSE_TERMS))
    grid_intrinsics_sigma: Array = field(default_factory=lambda: np.zeros(GRID_INTRINSIC_TERMS))
    expected: CameraState | None = None
    T_prior: Pose | None = None
    pose_sigma: Array | None = None
    fixed_pose: bool = False
    gravity: Array | None = None
    gravity_sigma: float = float(np.deg2rad(KINECT_SIGMA_DEG))

    def sigma_beside_pose(self) -> Array:
        """Standard deviations (S−6,) in the order of `CameraState.beside_pose`."""
        return np.concatenate(
            [self.bias_sigma, self.intrinsics_sigma, self.grid_pose_sigma, self.grid_intrinsics_sigma]
        )


@dataclass(frozen=True, slots=True, eq=False)
class Adjustment:
    """The result: states, landmarks, and the normal matrix that is left when the landmarks are eliminated.

    `normal` (C·S, C·S) holds the information on all camera states (rows of what is held are zero); `weights`
    (M,2) are the kernel's for pixel and disparity; `residuals` (M,3) and `plane_residuals` are whitened.
    """

    states: tuple[CameraState, ...]
    points: Array
    planes: Array
    normal: Array
    residuals: Array
    plane_residuals: Array
    weights: Array
    cost: float
    iterations: int


def adjust(
    cameras: Sequence[AdjustedCamera],
    points: Array,
    seen: Observations,
    planes: Array | None = None,
    seen_planes: PlaneObservations | None = None,
    converged: float = CONVERGED,
) -> Adjustment:
    """Minimise the robust cost from the cameras' start states, `points` (P,3) and `planes` (K,3), rig frame.

    A plane π holds the points X with π · X = 1. Every point needs two observations or more. Without pose
    priors one pose must be fixed.
    """
    planes = np.empty((0, 3)) if planes is None else planes
    seen_planes = PlaneObservations.none() if seen_planes is None else seen_planes
    problem = _Problem.of(cameras, LandmarkCounts(len(points), len(planes)), seen, seen_planes)
    here = problem.evaluate(_start(cameras, points, planes))
    damping, gain, iterations = _FIRST_DAMPING, np.inf, 0
    while gain > converged and iterations < _MAX_ITERATIONS:
        iterations += 1
        here, damping, gain = _descend(problem, here, damping, near=gain < _NEAR * here.cost)
    return _result(problem, here, iterations)


@dataclass(frozen=True, slots=True, eq=False)
class _Estimate:
    """Poses (C,4,4), states beside them (C,S−6), and landmarks (L,3): points, planes, gravity."""

    T_rig_camera: Array
    beside_pose: Array
    landmarks: Array

    def moved(self, steps: Array, landmarks: Landmarks, groups: Groups) -> "_Estimate":
        """Steps of the cameras (C·S,) and of the landmarks that go with them; T · Exp(δ) to first order."""
        by_camera, by_landmark = steps.reshape(len(self.T_rig_camera), -1), np.empty_like(self.landmarks)
        landmark_steps(groups.camera, groups.first_group, *landmarks, by_camera, by_landmark)
        R = self.T_rig_camera[:, :3, :3]
        poses = self.T_rig_camera.copy()
        poses[:, :3, :3] = R @ rotation_matrices(by_camera[:, :3])
        poses[:, :3, 3] += (R @ by_camera[:, 3:6, None])[..., 0]
        return _Estimate(poses, self.beside_pose + by_camera[:, 6:], self.landmarks + by_landmark)


@dataclass(frozen=True, slots=True, eq=False)
class _Evaluation:
    """An estimate with its rows and cost."""

    estimate: _Estimate
    rows: Rows
    cost: float


@dataclass(frozen=True, slots=True, eq=False)
class _Reduced:
    """Normal equations of the cameras: lower triangle of `normal` (C·S,C·S), and `gradient` (C·S,)."""

    normal: Array
    gradient: Array
    landmarks: Landmarks


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    models: FactoryModels
    priors: CameraPriors
    observed: LandmarkRows
    free: Index  # columns of all states that are not held

    @classmethod
    def of(
        cls,
        cameras: Sequence[AdjustedCamera],
        counts: LandmarkCounts,
        seen: Observations,
        seen_planes: PlaneObservations,
    ) -> "_Problem":
        models = FactoryModels.of(
            [camera.color for camera in cameras],
            [camera.grid for camera in cameras],
            len(cameras[0].bias_sigma),
        )
        held = np.array([camera.fixed_pose for camera in cameras])
        varies = np.array([camera.sigma_beside_pose() > 0.0 for camera in cameras])
        free = np.concatenate([np.repeat(~held[:, None], 6, axis=1), varies], axis=1)
        observed = LandmarkRows(models, counts, seen, seen_planes, _gravity(cameras))
        return cls(models, _priors(cameras), observed, np.flatnonzero(free))

    def evaluate(self, estimate: _Estimate) -> _Evaluation:
        rows = self.observed.rows(
            self.models.with_states(estimate.T_rig_camera, estimate.beside_pose), estimate.landmarks
        )
        cost = robust_cost(self.observed.kernels, rows.residual, _CAUCHY_SQUARED)
        return _Evaluation(
            estimate, rows, cost + self.priors.cost(estimate.T_rig_camera, estimate.beside_pose)
        )

    def reduce(self, estimate: _Estimate, rows: Rows, damping: float) -> _Reduced:
        """Eliminate the landmarks from rows that are weighted."""
        count, size = len(estimate.T_rig_camera), self.models.state_size
        information, gradient = self.priors.normal_equations(estimate.T_rig_camera, estimate.beside_pose)
        normal = np.zeros((count, size, count, size))
        np.einsum("cscs->cs", normal)[:] = information
        landmarks = eliminate(self.observed.groups, *rows, damping, normal, gradient)
        return _Reduced(normal.reshape(count * size, count * size), gradient.ravel(), landmarks)


def _descend(
    problem: _Problem, here: _Evaluation, damping: float, near: bool
) -> tuple[_Evaluation, float, float]:
    """One step downhill: where it leads, the next one's damping, and the decrease of the cost expected of it.

    Far from the minimum reweighted least squares is safe; near it, the kernel's own curvature is fast. Turns
    the rows of `here` into weighted ones.
    """
    reweight(problem.observed.kernels, *here.rows, _CAUCHY_SQUARED, _LEAST_CURVATURE if near else 1.0)
    while damping < _MAX_DAMPING:
        system = problem.reduce(here.estimate, here.rows, damping)
        steps = _solve(system, problem.free, damping)
        there = problem.evaluate(here.estimate.moved(steps, system.landmarks, problem.observed.groups))
        gain = 0.5 * float((system.landmarks.pull**2).sum() - steps.ravel() @ system.gradient)
        if there.cost <= here.cost:
            return there, max(damping * 0.1, _LEAST_DAMPING), gain
        if gain <= CONVERGED:
            break
        damping = max(damping * 10.0, _RAISED_DAMPING)
    return here, damping, 0.0


def _solve(system: _Reduced, free: Index, damping: float) -> Array:
    """Steps (C·S,) of the cameras' states; zero for those that are held."""
    # A camera that nothing observes and no drawing holds has no information, no gradient, and stays.
    scale = 1.0 / np.sqrt(np.maximum(system.normal[free, free], _LEAST_INFORMATION))
    lower = system.normal[np.ix_(free, free)] * scale[:, None] * scale
    np.fill_diagonal(lower, 1.0 + damping)
    right = system.gradient[free] * scale
    if len(system.normal) <= _MANY_STATES:
        solution = scipy.linalg.cho_solve(
            scipy.linalg.cho_factor(lower, lower=True, check_finite=False), right
        )
    else:
        below = scipy.sparse.csc_array(np.tril(lower, -1))
        whole = scipy.sparse.csc_array(below + below.T + scipy.sparse.diags_array(np.diag(lower)))
        solution = scipy.sparse.linalg.spsolve(whole, right, permc_spec="MMD_AT_PLUS_A")
    steps = np.zeros(len(system.gradient))
    steps[free] = -scale * solution
    return steps


def _result(problem: _Problem, here: _Evaluation, iterations: int) -> Adjustment:
    """States, residuals, and the information that reweighted least squares has at the end."""
    end, observed = problem.evaluate(here.estimate), problem.observed
    points, planes = observed.split_landmarks(end.estimate.landmarks)
    residuals, plane_residuals = observed.split_residuals(end.rows.residual.copy())
    reweight(observed.kernels, *end.rows, _CAUCHY_SQUARED, 1.0)
    normal = problem.reduce(end.estimate, end.rows, 0.0).normal
    information = np.zeros_like(normal)
    free = np.ix_(problem.free, problem.free)
    information[free] = (np.tril(normal) + np.tril(normal, -1).T)[free]
    states = zip(end.estimate.T_rig_camera, end.estimate.beside_pose, strict=True)
    return Adjustment(
        states=tuple(CameraState.from_columns(T, others) for T, others in states),
        points=points,
        planes=planes,
        normal=information,
        residuals=residuals,
        plane_residuals=plane_residuals,
        weights=_weights(residuals),
        cost=end.cost,
        iterations=iterations,
    )


def _weights(residuals: Array) -> Array:
    """Cauchy weights (M,2) of pixels and disparities."""
    squares = np.column_stack([(residuals[:, :2] ** 2).sum(axis=1), residuals[:, 2] ** 2])
    return np.asarray(1.0 / (1.0 + squares / _CAUCHY_SQUARED))


def _start(cameras: Sequence[AdjustedCamera], points: Array, planes: Array) -> _Estimate:
    down = [
        camera.start.T_rig_camera[:3, :3] @ camera.gravity for camera in cameras if camera.gravity is not None
    ]
    gravity = np.mean(down, axis=0, keepdims=True) if down else np.empty((0, 3))
    return _Estimate(
        np.array([camera.start.T_rig_camera for camera in cameras]),
        np.array([camera.start.beside_pose() for camera in cameras]),
        np.concatenate([points, planes, gravity]),
    )


def _gravity(cameras: Sequence[AdjustedCamera]) -> GravityObservations:
    felt = [
        (c, camera.gravity, camera.gravity_sigma)
        for c, camera in enumerate(cameras)
        if camera.gravity is not None
    ]
    return GravityObservations(
        np.array([c for c, _, _ in felt], dtype=np.intp),
        np.array([direction for _, direction, _ in felt]).reshape(-1, 3),
        np.array([sigma for _, _, sigma in felt]),
    )


def _priors(cameras: Sequence[AdjustedCamera]) -> CameraPriors:
    poses = [prior_pose(camera.T_prior, camera.pose_sigma) for camera in cameras]
    expected = [
        np.zeros(len(camera.sigma_beside_pose()))
        if camera.expected is None
        else camera.expected.beside_pose()
        for camera in cameras
    ]
    return CameraPriors(
        np.array([T for T, _ in poses]),
        np.array([weight for _, weight in poses]),
        np.array(expected),
        np.array([weights_of(camera.sigma_beside_pose()) for camera in cameras]),
    )
