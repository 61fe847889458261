"""Relative poses of pairs: alignment, RANSAC, the paper's Gauss-Newton."""

import numpy as np
import pytest

from rig_calib.registration import (
    Side,
    Tolerance,
    agreeing,
    align,
    align_batch,
    minimise_distances,
    ransac,
)
from rig_protocol.poses import inverse, se3_exp, transform_points
from support.synthetic_rig import COLOR, SyntheticRig, pose_distance, true_matches

T_I_J = se3_exp(np.array([0.1, 0.5, -0.2, 0.05, -0.1, 0.02]))
P_J = np.random.default_rng(0).uniform((-1, -1, 1), (1, 1, 3), (40, 3))
P_I = transform_points(T_I_J, P_J)
RIG = SyntheticRig(cameras=2)


def sides(outliers: float = 0.0, without_depth: float = 0.0) -> tuple[Side, Side, np.ndarray]:
    """Matches of two neighbours, the last share of them false, and which are true."""
    a, b = (RIG.observe(c, pixel_sigma=0.3, disparity_sigma=0.4) for c in (0, 1))
    matches = true_matches(a, b)
    rng = np.random.default_rng(1)
    false = int(outliers * len(matches))
    true = np.arange(len(matches)) < len(matches) - false
    matches[~true, 1] = rng.permutation(np.roll(matches[~true, 1], 1))
    i, j = a.side(matches[:, 0]), b.side(matches[:, 1])
    points = i.points.copy()
    points[rng.random(len(points)) < without_depth] = np.nan
    return Side(COLOR, i.pixels, points), j, true


def test_alignment_without_noise_is_exact() -> None:
    np.testing.assert_allclose(align(P_I, P_J), T_I_J, atol=1e-12)
    np.testing.assert_allclose(align_batch(P_I[None], P_J[None])[0], T_I_J, atol=1e-12)


def test_alignment_never_mirrors() -> None:
    flat = P_J * (1, 1, 0)
    assert np.linalg.det(align(flat * (1, 1, -1), flat)[:3, :3]) > 0


def test_weightless_points_do_not_count() -> None:
    spoiled = P_I.copy()
    spoiled[0] += 5.0
    weights = np.ones(len(P_I))
    weights[0] = 0.0
    np.testing.assert_allclose(align(spoiled, P_J, weights), T_I_J, atol=1e-12)


def test_minimising_distances_without_noise_is_exact_from_a_rough_start() -> None:
    T, normal = minimise_distances(P_I, P_J, T_I_J @ se3_exp(np.full(6, 0.1)))
    np.testing.assert_allclose(T, T_I_J, atol=1e-10)
    assert np.linalg.matrix_rank(normal) == 6


def test_minimising_distances_agrees_with_the_closed_form() -> None:
    noisy = P_I + 0.01 * np.random.default_rng(2).standard_normal(P_I.shape)
    np.testing.assert_allclose(minimise_distances(noisy, P_J, np.eye(4))[0], align(noisy, P_J), atol=1e-8)


def test_ransac_finds_the_pose_among_sixty_percent_false_matches() -> None:
    i, j, true = sides(outliers=0.6)
    found = ransac(i, j, Tolerance(), np.random.default_rng(0), 8)
    assert found is not None
    T, inlier = found
    deg, mm = pose_distance(T, inverse(RIG.truth[0]) @ RIG.truth[1])
    assert deg < 0.5
    assert mm < 15.0
    assert inlier[true].mean() > 0.95
    assert inlier[~true].mean() < 0.1


def test_ransac_is_the_same_in_every_run() -> None:
    i, j, _ = sides(outliers=0.5)
    first, second = (ransac(i, j, Tolerance(), np.random.default_rng(5), 8) for _ in range(2))
    assert first is not None
    assert second is not None
    assert first[0].tobytes() == second[0].tobytes()


def test_matches_with_depth_on_one_side_only_are_judged_too() -> None:
    i, j, true = sides(outliers=0.3, without_depth=0.5)
    found = ransac(i, j, Tolerance(), np.random.default_rng(0), 8)
    assert found is not None
    one_sided = ~i.known
    assert found[1][true & one_sided].mean() > 0.95
    assert found[1][~true & one_sided].mean() < 0.1


def test_matches_of_chance_give_no_pose() -> None:
    i, j, _ = sides(outliers=1.0)
    few = slice(0, 40)
    assert (
        ransac(
            Side(COLOR, i.pixels[few], i.points[few]),
            Side(COLOR, j.pixels[few], j.points[few]),
            Tolerance(),
            np.random.default_rng(0),
            8,
        )
        is None
    )


def test_two_matches_with_depth_give_no_pose() -> None:
    few_i, few_j = (with_few_points(side, kept=2) for side in sides()[:2])
    assert ransac(few_i, few_j, Tolerance(), np.random.default_rng(0), 8) is None


@pytest.mark.parametrize("depthless", ["i", "j"])
def test_depth_of_one_camera_and_pixels_of_the_other_give_the_pose(depthless: str) -> None:
    i, j, truth = sides(outliers=0.3)
    i, j = (with_few_points(i), j) if depthless == "i" else (i, with_few_points(j))
    found = ransac(i, j, Tolerance(), np.random.default_rng(0), 8)
    assert found is not None
    deg, mm = pose_distance(found[0], inverse(RIG.truth[0]) @ RIG.truth[1])
    assert deg < 0.6
    assert mm < 25.0
    assert found[1][truth].mean() > 0.9
    assert found[1][~truth].mean() < 0.05


def with_few_points(side: Side, kept: int = 0) -> Side:
    points = np.full_like(side.points, np.nan)
    points[:kept] = side.points[:kept]
    return Side(COLOR, side.pixels, points)


def test_a_match_of_the_right_pixel_and_the_wrong_depth_does_not_agree() -> None:
    i, j, _ = sides()
    deeper = Side(COLOR, j.pixels, j.points * 1.5)
    T = inverse(RIG.truth[0]) @ RIG.truth[1]
    assert agreeing(T, i, j, Tolerance()).mean() > 0.98
    assert not agreeing(T, i, deeper, Tolerance()).any()
