"""What counts as a plane in one camera's depth: large and flat things, whatever the unit does to depth."""

import numpy as np

from rig_calib.depth_model import DepthCorrection, disparity_of_depth
from rig_calib.depth_planes import depth_planes
from support.flat_rooms import GRID, RAYS, Piece, Unit, box, inverse_depth

LOOKING = np.array([[0.0, 0.0, 1.0, 0.1], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
"""T_rig_grid of a level camera that looks along x."""
RNG = np.random.default_rng


def planes_in(inverse: np.ndarray, unit: Unit | None = None) -> list[np.ndarray]:
    found = depth_planes(GRID, (unit or Unit()).disparity(inverse, RNG(1)), None)
    return [plane.normal for plane in found]


def test_a_wall_is_one_plane_however_its_unit_bends_it() -> None:
    inverse = inverse_depth(box((2.0, 9.0, 9.0)), LOOKING)
    for seed in range(4):
        disparity = Unit(scale=0.01, bend=0.023).disparity(inverse, RNG(seed))
        found = depth_planes(GRID, disparity, None)
        assert len(found) == 1
        assert len(found[0].disparity) > 0.9 * 27 * 20
        assert np.abs(found[0].misfit).max() < 1.5


def test_a_correction_is_applied_to_the_plane_and_not_to_what_was_measured() -> None:
    inverse = inverse_depth(box((2.0, 9.0, 9.0)), LOOKING)
    measured = Unit(scale=0.02, noise=0.0).disparity(inverse, RNG(0))
    raw, corrected = (
        depth_planes(GRID, measured, correction)[0] for correction in (None, DepthCorrection((-0.02,)))
    )
    np.testing.assert_allclose(raw.normal / corrected.normal, 0.98, rtol=1e-3)
    np.testing.assert_array_equal(raw.disparity, corrected.disparity)
    np.testing.assert_allclose(corrected.points_m @ corrected.normal, 1.0)


def test_walls_floor_and_ceiling_are_told_apart() -> None:
    pieces = box((2.6, 2.2, 0.6))
    found = planes_in(inverse_depth(pieces, LOOKING))
    truth = [LOOKING[:3, :3].T @ p.plane / (1 - p.plane @ LOOKING[:3, 3]) for p in pieces]
    assert len(found) >= 3
    for normal in found:
        assert min(np.linalg.norm(normal - one) / np.linalg.norm(one) for one in truth) < 0.01


def test_a_column_is_no_plane() -> None:
    for radius_m in (0.3, 0.6, 1.0):
        middle = np.array([0.0, radius_m + 1.2])
        x, z = RAYS[..., 0], RAYS[..., 2]
        a, b, c = x**2 + z**2, x * middle[0] + z * middle[1], middle @ middle - radius_m**2
        with np.errstate(invalid="ignore"):
            depth = (b - np.sqrt(b**2 - a * c)) / a
        column = np.where(np.isfinite(depth), 1.0 / depth, 0.0)
        assert not planes_in(column), radius_m


def test_a_ball_is_no_plane() -> None:
    middle, radius_m = np.array([0.1, 0.0, 2.0]), 0.8
    a, b, c = (RAYS**2).sum(axis=2), RAYS @ middle, middle @ middle - radius_m**2
    with np.errstate(invalid="ignore"):
        depth = (b - np.sqrt(b**2 - a * c)) / a
    assert not planes_in(np.where(np.isfinite(depth), 1.0 / depth, 0.0))


def test_small_things_are_no_planes() -> None:
    """Books on a shelf: each of them flat, none of them large."""
    rng = RNG(2)
    books = [
        Piece(
            np.array([1 / (1.5 + rng.uniform(0, 0.3)), 0, 0]),
            np.array([-9, left, bottom]),
            np.array([9, left + 0.18, bottom + 0.25]),
        )
        for left in np.arange(-0.9, 0.9, 0.2)
        for bottom in np.arange(-0.7, 0.7, 0.3)
    ]
    assert not planes_in(inverse_depth(books, LOOKING))


def test_a_poster_does_not_make_a_second_plane_of_its_wall() -> None:
    wall = Piece(np.array([0.5, 0, 0]))
    poster = Piece(np.array([1 / 1.99, 0, 0]), np.array([-9, -0.5, -0.5]), np.array([9, 0.5, 0.5]))
    assert len(planes_in(inverse_depth([wall, poster], LOOKING))) == 1


def test_without_depth_there_are_no_planes() -> None:
    assert not depth_planes(GRID, np.full((480, 640), np.nan), None)
    speck = np.full((480, 640), np.nan)
    speck[100:130, 100:130] = disparity_of_depth(GRID.raw_model, np.array(1.5))
    assert not depth_planes(GRID, speck, None)
