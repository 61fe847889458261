"""SE(3) on stacks agrees with SE(3) one by one, and its derivative with finite differences."""

import numpy as np
import numpy.typing as npt
import pytest

from rig_calib.pose_graph.se3_batches import (
    adjoints,
    exponentials,
    inverse_right_jacobians,
    inverses,
    logarithms,
)
from rig_calib.rotations import quaternions, rotations_of
from rig_protocol.poses import adjoint, inverse, se3_exp, se3_log

Array = npt.NDArray[np.float64]
# Below, at and above the angle where the closed forms take over from the series, and near half a turn.
ANGLES_RAD = (0.0, 1e-8, 1e-3, 0.0499, 0.0501, 0.7, 2.0, 3.1, np.pi - 1e-7)


def tangents(angle: float) -> Array:
    rng = np.random.default_rng(3)
    axes = rng.standard_normal((40, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return np.concatenate([angle * axes, rng.standard_normal((40, 3))], axis=1)


@pytest.mark.parametrize("angle", ANGLES_RAD)
def test_a_stack_is_what_its_poses_are_one_by_one(angle: float) -> None:
    delta = tangents(angle)
    T = exponentials(delta)
    np.testing.assert_allclose(T, [se3_exp(one) for one in delta], atol=1e-14)
    np.testing.assert_allclose(inverses(T), [inverse(one) for one in T], atol=1e-14)
    np.testing.assert_allclose(adjoints(T), [adjoint(one) for one in T], atol=1e-14)
    np.testing.assert_allclose(logarithms(T), delta, atol=1e-8 if angle > 3.0 else 1e-13)
    if angle < 3.0:
        np.testing.assert_allclose(logarithms(T), [se3_log(one) for one in T], atol=1e-10)


@pytest.mark.parametrize("angle", ANGLES_RAD)
def test_quaternions_give_the_rotations_back(angle: float) -> None:
    R = exponentials(tangents(angle))[:, :3, :3]
    q = quaternions(R)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0)
    assert (q[:, 0] >= 0).all()
    np.testing.assert_allclose(rotations_of(q), R, atol=1e-14)


@pytest.mark.parametrize("angle", [angle for angle in ANGLES_RAD if angle < 3.14])
def test_the_jacobian_of_the_logarithm_is_its_numeric_derivative(angle: float) -> None:
    delta, h = tangents(angle), 1e-5
    T = exponentials(delta)
    numeric = [
        (logarithms(T @ exponentials(h * axis)) - logarithms(T @ exponentials(-h * axis))) / (2 * h)
        for axis in np.eye(6)[:, None]
    ]
    np.testing.assert_allclose(inverse_right_jacobians(delta), np.stack(numeric, axis=2), atol=1e-7)
