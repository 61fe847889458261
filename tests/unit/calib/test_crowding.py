"""How many measurements share a place."""

import numpy as np

from rig_calib.crowding import crowding

PIXELS = np.random.default_rng(0).uniform((0, 0), (640, 480), (300, 2))


def test_a_crowd_is_the_sum_of_what_its_members_share() -> None:
    squared = ((PIXELS[:, None] - PIXELS) ** 2).sum(axis=2)
    expected = np.where(squared <= 120.0**2, np.exp(-0.5 * squared / 40.0**2), 0.0).sum(axis=1)
    np.testing.assert_allclose(crowding(PIXELS, 40.0), expected)


def test_all_at_one_place_count_all_and_nobody_counts_nothing() -> None:
    np.testing.assert_array_equal(crowding(np.full((9, 2), 50.0), 8.0), np.full(9, 9.0))
    assert crowding(np.empty((0, 2)), 8.0).shape == (0,)
