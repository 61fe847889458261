"""Rules of the SE(3) functions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm

from rig_protocol.poses import (
    adjoint,
    hat,
    inverse,
    is_pose,
    left_jacobian,
    rotation_angle_deg,
    se3_exp,
    se3_log,
    so3_exp,
    so3_log,
    transform_points,
)

tangents = arrays(np.float64, 6, elements=st.floats(-1.7, 1.7))


def generator(delta: np.ndarray) -> np.ndarray:
    """The 4×4 matrix whose matrix exponential defines Exp."""
    G = np.zeros((4, 4))
    G[:3, :3], G[:3, 3] = hat(delta[:3]), delta[3:]
    return G


@given(tangents)
def test_exp_is_the_matrix_exponential(delta: np.ndarray) -> None:
    np.testing.assert_allclose(se3_exp(delta), expm(generator(delta)), atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 0.999e-3, 1.001e-3, 0.5, 3.0])
def test_exp_is_exact_on_both_sides_of_the_series_switch(angle: float) -> None:
    delta = np.array([0.0, angle, 0.0, 0.3, -0.2, 0.1])
    np.testing.assert_allclose(se3_exp(delta), expm(generator(delta)), atol=1e-13)


@given(tangents)
def test_log_undoes_exp(delta: np.ndarray) -> None:
    np.testing.assert_allclose(se3_log(se3_exp(delta)), delta, atol=1e-9)


@pytest.mark.parametrize("angle", [np.pi, np.pi - 1e-6, np.pi - 1e-3])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0.6, 0, -0.8), (-0.36, 0.48, 0.8)])
def test_log_finds_rotations_near_half_a_turn(angle: float, axis: tuple[float, float, float]) -> None:
    R = so3_exp(np.array(axis) * angle)
    phi = so3_log(R)
    assert np.linalg.norm(phi) == pytest.approx(angle, abs=1e-6)
    np.testing.assert_allclose(so3_exp(phi), R, atol=1e-6)


@given(tangents, tangents)
def test_adjoint_moves_a_tangent_across_a_pose(delta: np.ndarray, epsilon: np.ndarray) -> None:
    T = se3_exp(delta)
    np.testing.assert_allclose(T @ se3_exp(epsilon) @ inverse(T), se3_exp(adjoint(T) @ epsilon), atol=1e-9)


def test_left_jacobian_is_the_derivative_of_exp() -> None:
    phi, step = np.array([0.3, -0.8, 0.5]), 1e-6
    for axis in range(3):
        moved = so3_exp(phi + step * np.eye(3)[axis]) @ so3_exp(phi).T
        np.testing.assert_allclose(so3_log(moved) / step, left_jacobian(phi)[:, axis], atol=1e-5)


@given(tangents)
def test_inverse_undoes_a_pose(delta: np.ndarray) -> None:
    T, points = se3_exp(delta), np.arange(12.0).reshape(4, 3)
    np.testing.assert_allclose(transform_points(inverse(T), transform_points(T, points)), points, atol=1e-12)


def test_rotation_angle_is_in_degrees() -> None:
    assert rotation_angle_deg(se3_exp(np.array([0, np.deg2rad(30), 0, 5, 6, 7]))) == pytest.approx(30)


@pytest.mark.parametrize(
    "T",
    [
        np.eye(3),
        np.diag([1.0, 1.0, -1.0, 1.0]),  # left-handed
        np.diag([1.1, 1.0, 1.0, 1.0]),  # not orthonormal
        np.full((4, 4), np.nan),
        np.vstack([np.eye(4)[:3], [0, 0, 0, 2]]),
    ],
)
def test_what_is_no_rigid_transform_is_recognised(T: np.ndarray) -> None:
    assert not is_pose(T)
    assert is_pose(np.eye(4))
