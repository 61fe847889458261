"""Support of an edge: its covariance decides, not the number of matches."""

import numpy as np
import pytest

from rig_calib.edges import measure_edge
from rig_calib.settings import CalibrationSettings
from rig_calib.uncertainty import weakest_direction
from rig_protocol.poses import inverse, transform_points
from support.synthetic_rig import SyntheticRig, pose_distance, true_matches

NOISE = {"pixel_sigma": 0.3, "disparity_sigma": 0.4}
BETWEEN_DEG = 15.0
"""Azimuth of the overlap of cameras 0 and 1."""


def rig_with_points(world: np.ndarray) -> SyntheticRig:
    rig = SyntheticRig(cameras=2, points=len(world))
    rig.world = world
    return rig


def overlap_frame() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unit vectors out of the middle of the overlap, sideways and up."""
    a = np.deg2rad(BETWEEN_DEG)
    return np.array([np.cos(a), np.sin(a), 0]), np.array([-np.sin(a), np.cos(a), 0]), np.array([0, 0, 1.0])


@pytest.mark.parametrize("method", ["joint", "paper"])
def test_many_matches_on_one_line_are_a_weak_edge(method: str) -> None:
    out, _, up = overlap_frame()
    line = 2.0 * out + np.linspace(-0.9, 0.9, 150)[:, None] * up
    rig = rig_with_points(line)
    a, b = rig.observe(0, **NOISE), rig.observe(1, **NOISE)
    edge = measure_edge(a, b, true_matches(a, b), CalibrationSettings(method=method))
    assert edge.inlier.sum() > 100
    assert edge.reason is not None
    assert "direction open" in edge.reason


@pytest.mark.parametrize("method", ["joint", "paper"])
def test_fewer_matches_spread_in_space_are_a_good_edge(method: str) -> None:
    rig = SyntheticRig(cameras=2, points=1200)
    a, b = rig.observe(0, **NOISE), rig.observe(1, **NOISE)
    edge = measure_edge(a, b, true_matches(a, b), CalibrationSettings(method=method))
    assert edge.reason is None
    assert edge.T_i_j is not None
    deg, mm = pose_distance(edge.T_i_j, inverse(rig.truth[0]) @ rig.truth[1])
    assert deg < 0.5
    assert mm < 20.0


def test_many_matches_in_one_corner_are_known_less_well_than_few_spread_ones() -> None:
    out, side, up = overlap_frame()
    rng = np.random.default_rng(0)
    corner = 2.0 * out + rng.uniform(-0.08, 0.08, (200, 3)) @ np.stack([out, side, up]) + 0.8 * up
    counts, sigmas = [], []
    for rig in (rig_with_points(corner), SyntheticRig(cameras=2, points=1200)):
        a, b = rig.observe(0, **NOISE), rig.observe(1, **NOISE)
        edge = measure_edge(a, b, true_matches(a, b), CalibrationSettings())
        assert edge.covariance is not None
        counts.append(edge.inlier.sum())
        sigmas.append(weakest_direction(edge.covariance)[0])
    assert counts[0] > 5 * counts[1]
    assert sigmas[0] > 1.5 * sigmas[1]


def test_too_few_matches_say_how_many_there_were() -> None:
    rig = SyntheticRig(cameras=2)
    a, b = rig.observe(0), rig.observe(1)
    edge = measure_edge(a, b, true_matches(a, b)[:5], CalibrationSettings())
    assert edge.T_i_j is None
    assert edge.reason == "of 5 matches fewer than 8 agree on one pose"


def test_an_edge_without_any_match_is_no_error() -> None:
    rig = SyntheticRig(cameras=2)
    nothing = np.empty((0, 2), dtype=np.intp)
    assert measure_edge(rig.observe(0), rig.observe(1), nothing, CalibrationSettings()).reason is not None


def test_the_points_of_the_synthetic_rig_are_where_its_truth_says() -> None:
    """The yardstick itself: a camera's points, moved by its true pose, are the world's."""
    rig = SyntheticRig(cameras=2)
    seen = rig.observe(0)
    world = {row.tobytes(): point for row, point in zip(rig.descriptors, rig.world, strict=True)}
    expected = np.array([world[row.tobytes()] for row in seen.keypoints.descriptors])
    np.testing.assert_allclose(transform_points(rig.truth[0], seen.points), expected, atol=1e-9)
