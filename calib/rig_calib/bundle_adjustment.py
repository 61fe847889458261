"""One robust adjustment of all camera states and all points (Triggs et al., "Bundle Adjustment", 2000).

Levenberg-Marquardt on iteratively reweighted least squares with a Cauchy kernel; the points are eliminated
by the Schur complement. Every camera carries priors: on its pose (the drawing), depth bias, intrinsics.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from rig_calib.depth_model import DepthGrid
from rig_calib.observation_model import (
    INTRINSIC_TERMS,
    POSE,
    CameraState,
    Observations,
    jacobians,
    residuals,
)
from rig_protocol.camera import Intrinsics
from rig_protocol.poses import Pose, inverse, se3_exp, se3_log

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]

# Where the kernel starts to bend, in standard deviations: 95 % efficiency on clean data (Holland &
# Welsch 1977), squared, for a pixel's two coordinates and for a disparity.
_CAUCHY_SQUARED = 2.385**2
# The same for the six numbers of a pose prior: their 95 % quantile.
_CAUCHY_SQUARED_POSE = 12.6
_MAX_ITERATIONS = 40
_CONVERGED = 1e-6  # relative decrease of the cost


@dataclass(frozen=True, slots=True, eq=False)
class AdjustedCamera:
    """One camera of a problem: fixed models, priors, and the state to start from.

    `T_prior` with `pose_sigma` (6,) is the drawing's pose; None = no prior. `bias_sigma` (B,) and
    `intrinsics_sigma` (3,) are standard deviations about zero. A fixed pose defines the frame.
    """

    color: Intrinsics
    grid: DepthGrid
    start: CameraState
    bias_sigma: Array
    intrinsics_sigma: Array
    T_prior: Pose | None = None
    pose_sigma: Array | None = None
    fixed_pose: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Adjustment:
    """The result: states, points, and the normal matrix that is left when the points are eliminated.

    `normal` (C·S, C·S) holds the information on all camera states (rows of fixed poses are zero);
    `weights` (M,2) are the kernel's for pixel and disparity; `residuals` (M,3) are whitened.
    """

    states: tuple[CameraState, ...]
    points: Array
    normal: Array
    residuals: Array
    weights: Array
    cost: float
    iterations: int


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    cameras: Sequence[AdjustedCamera]
    seen: Observations
    rows: tuple[Index, ...]  # observations of each camera
    pairs: Mapping[tuple[int, int], tuple[Index, Index]]  # observations of one point by two cameras
    point_count: int
    state_size: int = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "state_size", 6 + len(self.cameras[0].bias_sigma) + INTRINSIC_TERMS)


@dataclass(frozen=True, slots=True, eq=False)
class _Linearised:
    """Normal equations [[U, W], [Wᵀ, V]] with gradients; W stays factored by observation."""

    U: Array  # (C,S,S)
    V: Array  # (P,3,3)
    W: Array  # (M,S,3)
    camera_gradient: Array  # (C,S)
    point_gradient: Array  # (P,3)


def adjust(cameras: Sequence[AdjustedCamera], points: Array, seen: Observations) -> Adjustment:
    """Minimise the robust cost from the cameras' start states and `points` (P,3), rig frame.

    Every point needs two observations or more. Without pose priors one pose must be fixed.
    """
    problem = _Problem(cameras, seen, _rows(seen.camera, len(cameras)), _co_observations(seen), len(points))
    states = tuple(camera.start for camera in cameras)
    errors = _residuals(problem, states, points)
    cost, damping, iterations = _cost(problem, states, errors), 1e-4, 0
    while iterations < _MAX_ITERATIONS:
        iterations += 1
        system = _linearise(problem, states, points, errors)
        previous = cost
        while damping < 1e8:
            new_states, new_points = _step(problem, states, points, system, damping)
            new_errors = _residuals(problem, new_states, new_points)
            new_cost = _cost(problem, new_states, new_errors)
            if new_cost <= cost:
                states, points, errors, cost = new_states, new_points, new_errors, new_cost
                damping = max(damping * 0.1, 1e-12)
                break
            damping *= 10.0
        if previous - cost <= _CONVERGED * previous:
            break
    system = _linearise(problem, states, points, errors)
    normal, _, _ = _reduce(problem, system, 0.0)
    return Adjustment(states, points, normal, errors, _weights(errors), cost, iterations)


def _rows(camera: Index, count: int) -> tuple[Index, ...]:
    return tuple(np.flatnonzero(camera == c) for c in range(count))


def _co_observations(seen: Observations) -> dict[tuple[int, int], tuple[Index, Index]]:
    """For every ordered pair of cameras: the rows of `seen` where both observe the same point."""
    order = np.argsort(seen.point, kind="stable")
    count = np.bincount(seen.point)
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    left = np.repeat(np.arange(len(order)), count[seen.point[order]])
    within = np.arange(len(left)) - np.repeat(
        np.cumsum(count[seen.point[order]]) - count[seen.point[order]], count[seen.point[order]]
    )
    right = order[first[seen.point[order[left]]] + within]
    left = order[left]
    key = seen.camera[left] * (seen.camera.max() + 1) + seen.camera[right]
    by_key = np.argsort(key, kind="stable")
    groups = np.split(by_key, np.flatnonzero(np.diff(key[by_key])) + 1)
    return {
        (int(seen.camera[left[g[0]]]), int(seen.camera[right[g[0]]])): (left[g], right[g]) for g in groups
    }


def _residuals(problem: _Problem, states: Sequence[CameraState], points: Array) -> Array:
    errors = np.empty((len(problem.seen), 3))
    for camera, state, rows in zip(problem.cameras, states, problem.rows, strict=True):
        seen = problem.seen.select(rows)
        errors[rows] = residuals(camera.color, camera.grid, state, points[seen.point], seen)
    return errors


def _weights(errors: Array) -> Array:
    """Cauchy weights (M,2) of pixels and disparities."""
    pixel = 1.0 / (1.0 + (errors[:, 0] ** 2 + errors[:, 1] ** 2) / _CAUCHY_SQUARED)
    return np.column_stack([pixel, 1.0 / (1.0 + errors[:, 2] ** 2 / _CAUCHY_SQUARED)])


def _cost(problem: _Problem, states: Sequence[CameraState], errors: Array) -> float:
    if not np.isfinite(errors).all():
        return np.inf
    pixel = np.log1p((errors[:, 0] ** 2 + errors[:, 1] ** 2) / _CAUCHY_SQUARED).sum()
    disparity = np.log1p(errors[:, 2] ** 2 / _CAUCHY_SQUARED).sum()
    cost = 0.5 * _CAUCHY_SQUARED * float(pixel + disparity)
    for camera, state in zip(problem.cameras, states, strict=True):
        pose = _pose_prior(camera, state)
        cost += 0.5 * _CAUCHY_SQUARED_POSE * float(np.log1p(pose @ pose / _CAUCHY_SQUARED_POSE))
        cost += 0.5 * float(((state.bias / camera.bias_sigma) ** 2).sum())
        cost += 0.5 * float(((state.intrinsics / camera.intrinsics_sigma) ** 2).sum())
    return cost


def _pose_prior(camera: AdjustedCamera, state: CameraState) -> Array:
    """Whitened difference (6,) between the drawing's pose and the state's; zero without a drawing."""
    if camera.T_prior is None or camera.pose_sigma is None:
        return np.zeros(6)
    return se3_log(inverse(camera.T_prior) @ state.T_rig_camera) / camera.pose_sigma


def _linearise(problem: _Problem, states: Sequence[CameraState], points: Array, errors: Array) -> _Linearised:
    size = problem.state_size
    root = np.sqrt(_weights(errors))[:, (0, 0, 1)]
    by_state, by_point = np.empty((len(errors), 3, size)), np.empty((len(errors), 3, 3))
    for camera, state, rows in zip(problem.cameras, states, problem.rows, strict=True):
        seen = problem.seen.select(rows)
        by_state[rows], by_point[rows] = jacobians(camera.color, camera.grid, state, points[seen.point], seen)
        if camera.fixed_pose:
            by_state[rows, :, POSE] = 0.0
    by_state, by_point, weighted = by_state * root[..., None], by_point * root[..., None], errors * root

    V, point_gradient = np.zeros((problem.point_count, 3, 3)), np.zeros((problem.point_count, 3))
    np.add.at(V, problem.seen.point, np.einsum("mki,mkj->mij", by_point, by_point))
    np.add.at(point_gradient, problem.seen.point, np.einsum("mki,mk->mi", by_point, weighted))
    U, camera_gradient = np.zeros((len(states), size, size)), np.zeros((len(states), size))
    for c, (camera, state, rows) in enumerate(zip(problem.cameras, states, problem.rows, strict=True)):
        J = by_state[rows].reshape(-1, size)
        information, gradient = _prior(camera, state)
        U[c], camera_gradient[c] = J.T @ J + information, J.T @ weighted[rows].ravel() + gradient
    return _Linearised(U, V, np.einsum("mks,mki->msi", by_state, by_point), camera_gradient, point_gradient)


def _prior(camera: AdjustedCamera, state: CameraState) -> tuple[Array, Array]:
    """Information (S,S) and gradient (S,) of one camera's priors."""
    pose = _pose_prior(camera, state)
    weight = 0.0 if camera.T_prior is None else 1.0 / (1.0 + pose @ pose / _CAUCHY_SQUARED_POSE)
    sigma = np.ones(6) if camera.pose_sigma is None else camera.pose_sigma
    if camera.fixed_pose:
        weight = 0.0
    value = np.concatenate([state.bias / camera.bias_sigma, state.intrinsics / camera.intrinsics_sigma])
    others = np.concatenate([camera.bias_sigma, camera.intrinsics_sigma])
    information = np.diag(np.concatenate([weight / sigma**2, 1.0 / others**2]))
    return information, np.concatenate([weight * pose / sigma, value / others])


def _reduce(problem: _Problem, system: _Linearised, damping: float) -> tuple[Array, Array, Array]:
    """Eliminate the points: the reduced normal matrix and gradient, and the inverse (P,3,3) of V."""
    size, count = problem.state_size, len(problem.cameras)
    diagonal = np.einsum("pii->pi", system.V)
    V_inverse = np.linalg.inv(system.V + (damping * diagonal + 1e-12)[:, :, None] * np.eye(3))
    point = problem.seen.point
    through = np.einsum("msi,mij->msj", system.W, V_inverse[point])
    normal = np.zeros((count, size, count, size))
    for c in range(count):
        normal[c, :, c, :] = system.U[c] + damping * np.diag(np.diag(system.U[c]))
    for (c, d), (left, right) in problem.pairs.items():
        normal[c, :, d, :] -= np.tensordot(through[left], system.W[right], axes=([0, 2], [0, 2]))
    gradient = system.camera_gradient.copy()
    np.add.at(gradient, problem.seen.camera, -np.einsum("msi,mi->ms", through, system.point_gradient[point]))
    return normal.reshape(count * size, count * size), gradient.ravel(), V_inverse


def _step(
    problem: _Problem, states: Sequence[CameraState], points: Array, system: _Linearised, damping: float
) -> tuple[tuple[CameraState, ...], Array]:
    normal, gradient, V_inverse = _reduce(problem, system, damping)
    free = np.diag(normal) > 0.0
    delta = np.zeros(len(gradient))
    delta[free] = -np.linalg.solve(normal[np.ix_(free, free)], gradient[free])
    by_camera = delta.reshape(len(states), problem.state_size)
    pull = system.point_gradient.copy()
    np.add.at(pull, problem.seen.point, np.einsum("msi,ms->mi", system.W, by_camera[problem.seen.camera]))
    moved = tuple(_moved(state, change) for state, change in zip(states, by_camera, strict=True))
    return moved, points - np.einsum("pij,pj->pi", V_inverse, pull)


def _moved(state: CameraState, delta: Array) -> CameraState:
    terms = len(state.bias)
    return CameraState(
        state.T_rig_camera @ se3_exp(delta[POSE]),
        state.bias + delta[6 : 6 + terms],
        state.intrinsics + delta[6 + terms :],
    )
