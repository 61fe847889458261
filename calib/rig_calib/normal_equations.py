"""Normal equations of cameras and landmarks, the landmarks eliminated by the Schur complement; compiled.

A row is one scalar residual: it concerns one camera and one landmark of three numbers. The rows of one camera
and one landmark stand together, a group; so do the groups of one landmark, by rising camera. (Triggs et al.,
"Bundle Adjustment", 2000, section 6.)

The loops take whole arrays and call nothing with them: an array that is handed on inside a loop is counted
there, which costs more than the arithmetic.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rig_protocol.compiled import compiled

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]

# Keeps a landmark where it is that the rows say nothing about.
_NEXT_TO_NOTHING = 1e-12


class Groups(NamedTuple):
    """The cameras (G,) of the groups, and where groups (G+1,) and landmarks (L+1,) begin."""

    camera: Index
    first_row: Index
    first_group: Index


class Landmarks(NamedTuple):
    """What brings the eliminated landmarks back. V = root · rootᵀ (L,3,3) is their own information;

    `through` (G,3,S) is root⁻¹ Wᵀ, with W what ties camera and landmark, and `pull` (L,3) root⁻¹ · gradient.
    """

    root: Array
    through: Array
    pull: Array


def eliminate(
    groups: Groups,
    residual: Array,
    by_state: Array,
    by_landmark: Array,
    damping: float,
    normal: Array,
    gradient: Array,
) -> Landmarks:
    """Add rows (N,), (N,S), (N,3) to the cameras' normal equations, landmarks eliminated.

    Of `normal` (C,S,C,S) the lower triangle is filled; `gradient` is (C,S). `damping` raises the landmarks'
    information by that share.
    """
    count, size = len(groups.first_group) - 1, by_state.shape[1]
    known = Landmarks(np.zeros((count, 3, 3)), np.zeros((len(groups.camera), 3, size)), np.zeros((count, 3)))
    _decompose_landmarks(
        groups.first_row, groups.first_group, residual, by_landmark, damping, known.root, known.pull
    )
    _tie(*groups, by_state, by_landmark, *known, gradient)
    _add_rows(groups.camera, groups.first_row, residual, by_state, normal, gradient)
    _subtract_ties(groups.camera, groups.first_group, known.through, normal)
    return known


@compiled()
def landmark_steps(
    camera: Index, first_group: Index, root: Array, through: Array, pull: Array, steps: Array, out: Array
) -> None:
    """Steps (L,3) of the landmarks that go with steps (C,S) of the cameras."""
    for p in range(len(first_group) - 1):
        a, b, c = pull[p, 0], pull[p, 1], pull[p, 2]
        for g in range(first_group[p], first_group[p + 1]):
            for j in range(steps.shape[1]):
                step = steps[camera[g], j]
                a += through[g, 0, j] * step
                b += through[g, 1, j] * step
                c += through[g, 2, j] * step
        out[p, 2] = -c / root[p, 2, 2]
        out[p, 1] = (-b - root[p, 2, 1] * out[p, 2]) / root[p, 1, 1]
        out[p, 0] = (-a - root[p, 1, 0] * out[p, 1] - root[p, 2, 0] * out[p, 2]) / root[p, 0, 0]


@compiled()
def robust_cost(first_row: Index, residual: Array, bend: float) -> float:
    """Sum of ½ b log(1 + |r|²/b) over blocks of rows (K+1,) that share a Cauchy kernel."""
    cost = 0.0
    for k in range(len(first_row) - 1):
        square = 0.0
        for row in range(first_row[k], first_row[k + 1]):
            square += residual[row] ** 2
        cost += 0.5 * bend * np.log1p(square / bend)
    return cost


@compiled()
def reweight(
    first_row: Index,
    residual: Array,
    by_state: Array,
    by_landmark: Array,
    bend: float,
    least_curvature: float,
) -> None:
    """Turn rows into those of a least-squares problem with the gradient of the robust cost; in place.

    Its curvature along a residual is the cost's own, at least the share `least_curvature` of the weight's
    (Triggs et al., section 4.3); 1 gives reweighted least squares, whose normal matrix is the information.
    """
    size = by_state.shape[1]
    along = np.empty(size + 3)
    for k in range(len(first_row) - 1):
        square = 0.0
        along[:] = 0.0
        for row in range(first_row[k], first_row[k + 1]):
            square += residual[row] ** 2
            for j in range(size):
                along[j] += residual[row] * by_state[row, j]
            for j in range(3):
                along[size + j] += residual[row] * by_landmark[row, j]
        root = 1.0 / np.sqrt(1.0 + square / bend)
        kept = np.sqrt(max((bend - square) / (bend + square), least_curvature))
        share = (1.0 - kept) / square if square > 0.0 else 0.0
        for row in range(first_row[k], first_row[k + 1]):
            off = share * residual[row]
            for j in range(size):
                by_state[row, j] = root * (by_state[row, j] - off * along[j])
            for j in range(3):
                by_landmark[row, j] = root * (by_landmark[row, j] - off * along[size + j])
            residual[row] *= root / kept


@compiled()
def _decompose_landmarks(
    first_row: Index,
    first_group: Index,
    residual: Array,
    by_landmark: Array,
    damping: float,
    root: Array,
    pull: Array,
) -> None:
    """Cholesky's root of every landmark's information, and its pull."""
    V, slope = np.empty((3, 3)), np.empty(3)
    for p in range(len(first_group) - 1):
        V[:] = 0.0
        slope[:] = 0.0
        for row in range(first_row[first_group[p]], first_row[first_group[p + 1]]):
            for i in range(3):
                slope[i] += by_landmark[row, i] * residual[row]
                for j in range(i + 1):
                    V[i, j] += by_landmark[row, i] * by_landmark[row, j]
        for i in range(3):
            V[i, i] += damping * V[i, i] + _NEXT_TO_NOTHING
            for j in range(i):
                for k in range(j):
                    V[i, j] -= root[p, i, k] * root[p, j, k]
                root[p, i, j] = V[i, j] / root[p, j, j]
                V[i, i] -= root[p, i, j] ** 2
                slope[i] -= root[p, i, j] * pull[p, j]
            root[p, i, i] = np.sqrt(max(V[i, i], _NEXT_TO_NOTHING))
            pull[p, i] = slope[i] / root[p, i, i]


@compiled()
def _tie(
    camera: Index,
    first_row: Index,
    first_group: Index,
    by_state: Array,
    by_landmark: Array,
    root: Array,
    through: Array,
    pull: Array,
    gradient: Array,
) -> None:
    """What ties every group's camera to its landmark, and what that takes off the camera's gradient."""
    size = by_state.shape[1]
    for p in range(len(first_group) - 1):
        a, b, c = 1.0 / root[p, 0, 0], 1.0 / root[p, 1, 1], 1.0 / root[p, 2, 2]
        ba, ca, cb = root[p, 1, 0], root[p, 2, 0], root[p, 2, 1]
        for g in range(first_group[p], first_group[p + 1]):
            for row in range(first_row[g], first_row[g + 1]):
                x = by_landmark[row, 0] * a
                y = (by_landmark[row, 1] - ba * x) * b
                z = (by_landmark[row, 2] - ca * x - cb * y) * c
                for j in range(size):
                    through[g, 0, j] += x * by_state[row, j]
                    through[g, 1, j] += y * by_state[row, j]
                    through[g, 2, j] += z * by_state[row, j]
            x, y, z = pull[p, 0], pull[p, 1], pull[p, 2]
            for j in range(size):
                pulled = x * through[g, 0, j] + y * through[g, 1, j] + z * through[g, 2, j]
                gradient[camera[g], j] -= pulled


@compiled()
def _add_rows(
    camera: Index, first_row: Index, residual: Array, by_state: Array, normal: Array, gradient: Array
) -> None:
    """What the rows say of their cameras alone."""
    size = by_state.shape[1]
    for g in range(len(camera)):
        c = camera[g]
        for row in range(first_row[g], first_row[g + 1]):
            for i in range(size):
                gradient[c, i] += residual[row] * by_state[row, i]
                x = by_state[row, i]
                if x != 0.0:  # a pixel depends on half of the states only
                    for j in range(i + 1):
                        normal[c, i, c, j] += x * by_state[row, j]


@compiled()
def _subtract_ties(camera: Index, first_group: Index, through: Array, normal: Array) -> None:
    """Take off what cameras and landmarks share: throughᵀ · through of every two groups of a landmark."""
    size = through.shape[2]
    for p in range(len(first_group) - 1):
        for g in range(first_group[p], first_group[p + 1]):
            for h in range(first_group[p], g + 1):
                c, d = camera[g], camera[h]
                for i in range(size):
                    x, y, z = through[g, 0, i], through[g, 1, i], through[g, 2, i]
                    for j in range(i + 1 if g == h else size):
                        normal[c, i, d, j] -= (
                            x * through[h, 0, j] + y * through[h, 1, j] + z * through[h, 2, j]
                        )
