"""Windows of disparity against NumPy's medians and least squares."""

import numpy as np

from rig_calib.disparity_windows import fitted_planes, window_medians

RNG = np.random.default_rng(0)
HALF = 4


def disparity_with_holes() -> np.ndarray:
    v, u = np.mgrid[0:60, 0:80]
    image = 700.0 + 0.7 * u - 0.4 * v + RNG.normal(0, 0.5, (60, 80))
    image[RNG.random(image.shape) < 0.2] = np.nan
    return image


def places() -> np.ndarray:
    """In the image, at its borders, outside, nowhere."""
    inside = RNG.uniform((0, 0), (79, 59), (60, 2))
    return np.concatenate([inside, [[0, 0], [79.4, 59.4], [-30, 10], [40, 1e9], [np.nan, 3]]])


def window(image: np.ndarray, at: np.ndarray, half: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Offsets and values of what is known around a place."""
    v, u = np.mgrid[0 : image.shape[0], 0 : image.shape[1]]
    column, row = np.rint(at)
    near = (np.abs(u - column) <= half) & (np.abs(v - row) <= half) & np.isfinite(image)
    return u[near] - at[0], v[near] - at[1], image[near]


def test_medians_are_those_of_what_is_known_around_a_place() -> None:
    image, at = disparity_with_holes(), places()
    expected = [np.median(known) if len(known := window(image, one, 1)[2]) else np.nan for one in at]
    np.testing.assert_array_equal(window_medians(image, at), expected)


def test_planes_are_least_squares_and_few_pixels_make_none() -> None:
    image, at = disparity_with_holes(), places()
    planes = np.full((len(at), 3), np.nan)
    fitted_planes(image, at, HALF, 0.6, 5.0, 20.0, planes)
    for one, plane in zip(at, planes, strict=True):
        du, dv, known = window(image, one, HALF)
        if len(known) < 0.6 * (2 * HALF + 1) ** 2:
            assert np.isnan(plane).all()
        else:
            basis = np.column_stack([np.ones_like(du), du, dv])
            np.testing.assert_allclose(plane, np.linalg.lstsq(basis, known)[0], rtol=1e-9)
    assert 10 < np.isfinite(planes[:, 0]).sum() < len(at)


def test_a_window_that_one_plane_does_not_explain_makes_none() -> None:
    step = np.full((40, 40), 700.0)
    step[:, 20:] = 760.0
    planes = np.full((2, 3), np.nan)
    fitted_planes(step, np.array([[19.0, 20.0], [8.0, 20.0]]), HALF, 0.6, 0.8, 2.5, planes)
    assert np.isnan(planes[0]).all()
    np.testing.assert_allclose(planes[1], [700.0, 0.0, 0.0], atol=1e-9)


def test_a_plane_that_is_there_stays() -> None:
    planes = np.array([[1.0, 2.0, 3.0]])
    fitted_planes(np.full((40, 40), 700.0), np.array([[20.0, 20.0]]), HALF, 0.6, 0.8, 2.5, planes)
    np.testing.assert_array_equal(planes, [[1.0, 2.0, 3.0]])
