"""Rotations of many cameras against those of one."""

import numpy as np

from rig_calib.rotations import right_jacobians, rotation_matrices, rotation_vectors
from rig_protocol.poses import left_jacobian, so3_exp, so3_log

AXES = np.random.default_rng(0).normal(size=(60, 3))
ANGLES = np.concatenate(
    [[0.0, 1e-9, 1e-5, 1e-3, 2e-3], np.linspace(0.01, 3.1, 50), np.pi - np.logspace(-9, -2, 5)]
)
PHI = AXES / np.linalg.norm(AXES, axis=1, keepdims=True) * ANGLES[:, None]


def test_matrices_are_those_of_one_rotation() -> None:
    np.testing.assert_allclose(rotation_matrices(PHI), [so3_exp(phi) for phi in PHI], atol=1e-14)


def test_right_jacobians_are_left_ones_of_the_opposite_rotation() -> None:
    np.testing.assert_allclose(right_jacobians(PHI), [left_jacobian(-phi) for phi in PHI], atol=1e-9)


def test_vectors_are_found_again_up_to_half_a_turn() -> None:
    R = rotation_matrices(PHI)
    np.testing.assert_allclose(rotation_vectors(R), [so3_log(one) for one in R], atol=1e-9)
    np.testing.assert_allclose(rotation_vectors(R)[:-5], PHI[:-5], atol=1e-9)


def test_no_rotation_is_exactly_no_rotation() -> None:
    assert np.array_equal(rotation_matrices(np.zeros((2, 3))), np.tile(np.eye(3), (2, 1, 1)))
