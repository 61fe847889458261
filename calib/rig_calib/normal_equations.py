"""Normal equations of cameras and landmarks, the landmarks eliminated by the Schur complement; compiled.

A row is one scalar residual: it concerns one camera and one landmark of three numbers. The rows of one camera and
one landmark stand together, a group; so do the groups of one landmark, by rising camera.
(Triggs et al., "Bundle Adjustment", 2000, section 6.)
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from rig_protocol.compiled import compiled, inlined

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

    @classmethod
    def empty(cls, groups: Groups, state_size: int) -> "Landmarks":
        """To be filled by `eliminate`."""
        count = len(groups.first_group) - 1
        return cls(
            np.empty((count, 3, 3)), np.empty((len(groups.camera), 3, state_size)), np.empty((count, 3))
        )


@inlined
def _decompose(V: Array, root: Array) -> None:
    """Cholesky's root (3,3) of a matrix given by its lower triangle."""
    root[0, 0] = np.sqrt(V[0, 0])
    root[1, 0], root[2, 0] = V[1, 0] / root[0, 0], V[2, 0] / root[0, 0]
    root[1, 1] = np.sqrt(max(V[1, 1] - root[1, 0] ** 2, _NEXT_TO_NOTHING))
    root[2, 1] = (V[2, 1] - root[2, 0] * root[1, 0]) / root[1, 1]
    root[2, 2] = np.sqrt(max(V[2, 2] - root[2, 0] ** 2 - root[2, 1] ** 2, _NEXT_TO_NOTHING))


@inlined
def _own_information(
    by_landmark: Array, residual: Array, first: int, last: int, damping: float, V: Array, slope: Array
) -> None:
    """A landmark's information, damped, and gradient from its rows."""
    V[:] = 0.0
    slope[:] = 0.0
    for row in range(first, last):
        for i in range(3):
            slope[i] += by_landmark[row, i] * residual[row]
            for j in range(i + 1):
                V[i, j] += by_landmark[row, i] * by_landmark[row, j]
    for i in range(3):
        V[i, i] += damping * V[i, i] + _NEXT_TO_NOTHING


@inlined
def _add_rows(
    by_state: Array, residual: Array, first: int, last: int, c: int, normal: Array, gradient: Array
) -> None:
    """What the rows of camera c say of it."""
    for row in range(first, last):
        J = by_state[row]
        for i in range(len(J)):
            a = J[i]
            if a != 0.0:  # a pixel does not depend on half of the states
                gradient[c, i] += a * residual[row]
                line = normal[c, i, c]
                for j in range(i + 1):
                    line[j] += a * J[j]


@inlined
def _tie(by_state: Array, by_landmark: Array, first: int, last: int, root: Array, through: Array) -> None:
    """root⁻¹ Wᵀ of one group."""
    through[:] = 0.0
    for row in range(first, last):
        J = by_state[row]
        for i in range(3):
            a, line = by_landmark[row, i], through[i]
            for j in range(len(J)):
                line[j] += a * J[j]
    for j in range(through.shape[1]):
        through[0, j] /= root[0, 0]
        through[1, j] = (through[1, j] - root[1, 0] * through[0, j]) / root[1, 1]
        through[2, j] = (through[2, j] - root[2, 0] * through[0, j] - root[2, 1] * through[1, j]) / root[2, 2]


@inlined
def _subtract(left: Array, right: Array, c: int, d: int, normal: Array) -> None:
    """Take leftᵀ · right off the block of cameras c and d; of one on the diagonal, off its lower triangle."""
    for i in range(left.shape[1]):
        x, y, z, line = left[0, i], left[1, i], left[2, i], normal[c, i, d]
        for j in range(i + 1 if c == d else right.shape[1]):
            line[j] -= x * right[0, j] + y * right[1, j] + z * right[2, j]


@inlined
def _project_out(first: int, last: int, share: float, root: float, residual: Array, J: Array) -> None:
    """Take a share of what a block's derivatives have along its residual off them."""
    for j in range(J.shape[1]):
        along = 0.0
        for row in range(first, last):
            along += residual[row] * J[row, j]
        for row in range(first, last):
            J[row, j] = root * (J[row, j] - share * along * residual[row])


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
    first_row: Index, residual: Array, by_state: Array, by_landmark: Array, bend: float, least_curvature: float
) -> None:
    """Turn rows into those of a least-squares problem with the gradient of the robust cost; in place.

    Its curvature along a residual is the cost's own, at least the share `least_curvature` of the weight's
    (Triggs et al., section 4.3); 1 gives reweighted least squares, whose normal matrix is the information.
    """
    for k in range(len(first_row) - 1):
        first, last = first_row[k], first_row[k + 1]
        square = 0.0
        for row in range(first, last):
            square += residual[row] ** 2
        root = 1.0 / np.sqrt(1.0 + square / bend)
        curvature = max((bend - square) / (bend + square), least_curvature)
        along = 1.0 - np.sqrt(curvature)
        share = along / square if square > 0.0 else 0.0
        _project_out(first, last, share, root, residual, by_state)
        _project_out(first, last, share, root, residual, by_landmark)
        for row in range(first, last):
            residual[row] *= root / (1.0 - along)


@compiled()
def eliminate(
    groups: Groups,
    residual: Array,
    by_state: Array,
    by_landmark: Array,
    damping: float,
    normal: Array,
    gradient: Array,
    out: Landmarks,
) -> None:
    """Add rows (N,), (N,S), (N,3) to the cameras' `normal` (C,S,C,S) and `gradient` (C,S), landmarks eliminated.

    Of `normal`, the lower triangle is filled. `damping` raises the landmarks' information by that share.
    """
    V, slope = np.empty((3, 3)), np.empty(3)
    for p in range(len(groups.first_group) - 1):
        first, last = groups.first_group[p], groups.first_group[p + 1]
        root, pull = out.root[p], out.pull[p]
        _own_information(
            by_landmark, residual, groups.first_row[first], groups.first_row[last], damping, V, slope
        )
        _decompose(V, root)
        pull[0] = slope[0] / root[0, 0]
        pull[1] = (slope[1] - root[1, 0] * pull[0]) / root[1, 1]
        pull[2] = (slope[2] - root[2, 0] * pull[0] - root[2, 1] * pull[1]) / root[2, 2]
        for g in range(first, last):
            c, start, end, through = groups.camera[g], groups.first_row[g], groups.first_row[g + 1], out.through[g]
            _add_rows(by_state, residual, start, end, c, normal, gradient)
            _tie(by_state, by_landmark, start, end, root, through)
            for j in range(through.shape[1]):
                gradient[c, j] -= through[0, j] * pull[0] + through[1, j] * pull[1] + through[2, j] * pull[2]
            for h in range(first, g + 1):
                _subtract(through, out.through[h], c, groups.camera[h], normal)


@compiled()
def landmark_steps(groups: Groups, known: Landmarks, camera_steps: Array, out: Array) -> None:
    """Steps (L,3) of the landmarks that go with steps (C,S) of the cameras."""
    for p in range(len(groups.first_group) - 1):
        root, pull = known.root[p], known.pull[p]
        a, b, c = pull[0], pull[1], pull[2]
        for g in range(groups.first_group[p], groups.first_group[p + 1]):
            through, step = known.through[g], camera_steps[groups.camera[g]]
            for j in range(len(step)):
                a += through[0, j] * step[j]
                b += through[1, j] * step[j]
                c += through[2, j] * step[j]
        out[p, 2] = -c / root[2, 2]
        out[p, 1] = (-b - root[2, 1] * out[p, 2]) / root[1, 1]
        out[p, 0] = (-a - root[1, 0] * out[p, 1] - root[2, 0] * out[p, 2]) / root[0, 0]
