"""Predicted covariance against what really happens."""

import numpy as np

from rig_calib.alignment import align_frames
from rig_calib.rig_adjustment import AdjustedRig, adjust_rig
from rig_calib.settings import CalibrationSettings
from rig_calib.uncertainty import PoseCovariance, weakest_direction
from rig_protocol.poses import adjoint, inverse, se3_exp, se3_log
from rig_protocol.rig_folder import RingDrawing
from support.synthetic_rig import SyntheticRig, true_matches

# The observations' standard deviations are what the adjustment believes of keypoints one pixel wide.
SETTINGS = CalibrationSettings(bias_terms=1, bias_scale_sigma=0.01, pixel_sigma=0.3)


def adjusted(seed: int) -> tuple[SyntheticRig, AdjustedRig]:
    """Three cameras, new depth scales and new noise every time."""
    rig = SyntheticRig(cameras=3, points=500, bias=0.01, seed=seed)
    cameras = {c: rig.observe(c, pixel_sigma=0.304, disparity_sigma=0.4, seed=seed) for c in range(3)}
    matches = {pair: true_matches(cameras[pair[0]], cameras[pair[1]]) for pair in ((0, 1), (1, 2))}
    start = {c: inverse(rig.truth[0]) @ T for c, T in rig.truth.items()}
    return rig, adjust_rig(cameras, matches, start, None, SETTINGS)


def test_normalised_errors_are_as_large_as_the_covariance_says() -> None:
    """Mean of 60 six-dimensional χ²/6: its own deviation is 0.075; lens errors are assumed but not there."""
    squares = []
    for seed in range(30):
        rig, result = adjusted(seed)
        for c in (1, 2):
            delta = se3_log(inverse(result.poses[c]) @ inverse(rig.truth[0]) @ rig.truth[c])
            squares.append(float(delta @ np.linalg.solve(result.covariance_of(c), delta)) / 6)
    assert 0.3 < np.mean(squares) < 1.2


def test_the_covariance_of_a_relative_pose_counts_what_the_poses_share() -> None:
    """Monte Carlo over the joint distribution of two poses."""
    rng = np.random.default_rng(0)
    root = rng.normal(0, 1e-3, (12, 12))
    joint = root @ root.T
    T_i, T_j = (se3_exp(rng.normal(0, 0.5, 6)) for _ in range(2))
    T_i_j = inverse(T_i) @ T_j
    samples = rng.multivariate_normal(np.zeros(12), joint, 4000)
    deltas = [se3_log(inverse(T_i_j) @ inverse(T_i @ se3_exp(d[:6])) @ T_j @ se3_exp(d[6:])) for d in samples]
    predicted = PoseCovariance(joint.reshape(2, 6, 2, 6)).relative(0, 1, T_i_j)
    measured = np.cov(np.array(deltas).T)
    scale = np.sqrt(np.outer(np.diag(predicted), np.diag(predicted)))
    assert np.abs((measured - predicted) / scale).max() < 0.1


def sampled_ring(seed: int) -> tuple[list[np.ndarray], np.ndarray]:
    """Poses of four cameras around a rig, and a joint covariance of them."""
    rng = np.random.default_rng(seed)
    poses = [RingDrawing().T_rig_camera(3 * k) for k in range(4)]
    root = rng.normal(0, 5e-4, (24, 24))
    return poses, root @ root.T


def test_the_aligned_covariance_is_of_what_alignment_leaves() -> None:
    """Monte Carlo: truths are drawn, the rig is laid on each as the evaluation does."""
    poses, joint = sampled_ring(3)
    aligned = PoseCovariance(joint.reshape(4, 6, 4, 6)).aligned(poses)
    rng = np.random.default_rng(4)
    left = []
    for draw in rng.multivariate_normal(np.zeros(24), joint, 3000).reshape(-1, 4, 6):
        truth = {k: T @ se3_exp(delta) for k, (T, delta) in enumerate(zip(poses, draw, strict=True))}
        T_truth_rig = align_frames(dict(enumerate(poses)), truth)
        left.append([se3_log(inverse(T_truth_rig @ poses[k]) @ truth[k]) for k in range(4)])
    measured = np.cov(np.array(left).reshape(-1, 24).T)
    predicted = aligned.blocks.reshape(24, 24)
    scale = np.sqrt(np.outer(np.diag(predicted), np.diag(predicted)))
    assert np.abs((measured - predicted) / scale).max() < 0.1


def test_a_common_motion_of_the_rig_is_not_in_the_aligned_covariance_and_relative_poses_stay() -> None:
    poses, joint = sampled_ring(5)
    common = np.concatenate([adjoint(inverse(T)) for T in poses])  # the rig turned and shifted as one
    moved = joint + common @ np.diag(np.repeat([0.02, 0.1], 3) ** 2) @ common.T
    plain, loose = (PoseCovariance(C.reshape(4, 6, 4, 6)) for C in (joint, moved))
    np.testing.assert_allclose(loose.aligned(poses).blocks, plain.aligned(poses).blocks, atol=1e-15)
    T_i_j = inverse(poses[1]) @ poses[2]
    np.testing.assert_allclose(
        plain.aligned(poses).relative(1, 2, T_i_j), plain.relative(1, 2, T_i_j), atol=1e-15
    )
    assert np.trace(loose.of(0)) > 100 * np.trace(loose.aligned(poses).of(0))


def test_covariances_are_symmetric_and_positive() -> None:
    _, result = adjusted(0)
    for c in (1, 2):
        C = result.covariance_of(c)
        np.testing.assert_array_equal(C, C.T)
        assert np.linalg.eigvalsh(C)[0] > 0


def test_the_weakest_direction_need_not_be_an_axis() -> None:
    along = np.array([1.0, 1.0, 0.0]) / np.sqrt(2)
    C = np.zeros((6, 6))
    C[:3, :3] = np.deg2rad(0.5) ** 2 * np.outer(along, along)
    C[3:, 3:] = np.diag([1e-6, 4e-6, 1e-6])
    deg, m = weakest_direction(C)
    np.testing.assert_allclose((deg, m), (0.5, 2e-3))
