"""Patches of images that are known in closed form: places, their information, and what is not found."""

import numpy as np
import pytest

from rig_calib.patch_alignment import AlignedPatches, align_patches, smoothed

SHAPE = (240, 320)
SHIFT_PX = np.array([1.37, -0.81])
IDENTITY = np.eye(2)
OFF_PX = np.array([0.9, -0.6])
_RNG = np.random.default_rng(5)
_ANGLES = _RNG.uniform(0, 2 * np.pi, 40)
_PERIODS_PX = _RNG.uniform(10.0, 40.0, 40)
WAVES = 2 * np.pi / _PERIODS_PX[:, None] * np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])
PHASES = _RNG.uniform(0, 2 * np.pi, 40)


def texture(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Grey levels at any place, around 128."""
    waves = sum(np.sin(a * u + b * v + phase) for (a, b), phase in zip(WAVES, PHASES, strict=True))
    return np.asarray(128.0 + 8.0 * waves)


def textured(warp: np.ndarray = IDENTITY, shift: np.ndarray | float = 0.0) -> np.ndarray:
    """The image in which the texture's place p is seen at pixel warp · p + shift."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float64)
    at = (np.stack([u, v], axis=-1) - shift) @ np.linalg.inv(warp).T
    return texture(at[..., 0], at[..., 1])


def lattice(step: int = 20, margin: int = 40) -> np.ndarray:
    v, u = np.mgrid[margin : SHAPE[0] - margin : step, margin : SHAPE[1] - margin : step]
    return np.column_stack([u.ravel(), v.ravel()])


def find(source: np.ndarray, target: np.ndarray, pixels: np.ndarray, start: np.ndarray) -> AlignedPatches:
    affine = np.tile(IDENTITY, (len(pixels), 1, 1))
    return align_patches(smoothed(source), smoothed(target), pixels, start, affine)


def test_a_shift_below_a_pixel_is_found_through_another_exposure() -> None:
    pixels = lattice()
    found = find(textured(), 0.7 * textured(shift=SHIFT_PX) + 25.0, pixels, pixels.astype(np.float64))
    errors = found.pixels - (pixels + SHIFT_PX)
    assert np.sqrt((errors**2).sum(axis=1).mean()) < 0.03
    # Where texture is poor, interpolation moves a patch further, but never beyond what its information says.
    assert np.einsum("ni,nij,nj->n", errors, found.information, errors).max() < 3.0**2
    assert found.correlation.min() > 0.99


def test_a_patch_that_is_turned_and_stretched_is_found_by_its_affine_map() -> None:
    warp = np.array([[0.92, -0.35], [0.38, 1.05]])
    pixels = lattice()
    pixels = pixels[np.linalg.norm(pixels - (160, 120), axis=1) < 70]
    shift = np.array([160.3, 120.6]) - warp @ (160, 120)
    expected = pixels @ warp.T + shift
    affine = np.tile(warp, (len(pixels), 1, 1))
    source, target = smoothed(textured()), smoothed(textured(warp, shift))
    found = align_patches(source, target, pixels, expected + OFF_PX, affine)
    assert len(pixels) > 20
    assert np.linalg.norm(found.pixels - expected, axis=1).max() < 0.06
    unturned = align_patches(source, target, pixels, expected + OFF_PX, affine.swapaxes(1, 2).copy())
    assert np.median(unturned.correlation) < 0.8


def test_errors_are_as_large_as_the_information_says() -> None:
    """Two images with white noise of their own: whitened errors have a spread of about one."""
    pixels, rng = lattice(step=12), np.random.default_rng(1)
    source, target = (textured(shift=shift) + rng.normal(0, 4.0, SHAPE) for shift in (np.zeros(2), SHIFT_PX))
    found = find(source, target, pixels, pixels.astype(np.float64))
    errors = found.pixels - (pixels + SHIFT_PX)
    squared = np.einsum("ni,nij,nj->n", errors, found.information, errors)
    assert len(pixels) > 250
    assert 0.7 < np.sqrt(squared.mean() / 2) < 1.4


def test_an_edge_says_where_it_is_across_and_nothing_along() -> None:
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float64)
    across, along = np.array([0.8, 0.6]), np.array([-0.6, 0.8])
    rng = np.random.default_rng(2)

    def edge(offset_px: float) -> np.ndarray:
        distance = (u - 160) * across[0] + (v - 120) * across[1] - offset_px
        return 128.0 + 60.0 * np.tanh(distance / 1.5) + rng.normal(0, 1.0, SHAPE)

    start = np.array([[160.0, 120.0]])
    found = find(edge(0.0), edge(0.6), start.astype(np.intp), start)
    information = found.information[0]
    assert abs((found.pixels[0] - start[0]) @ across - 0.6) < 0.05
    assert across @ information @ across > 1 / 0.05**2
    assert abs(along @ information @ along) < 0.01 * (across @ information @ across)
    assert abs((found.pixels[0] - start[0]) @ along) < 1.0, "an edge does not slide along itself"


def test_a_blank_patch_says_nothing_and_stays() -> None:
    pixels = lattice()
    start = pixels + SHIFT_PX
    found = find(np.full(SHAPE, 90.0), textured(), pixels, start)
    assert not found.information.any()
    assert (found.correlation == -1.0).all()
    np.testing.assert_array_equal(found.pixels, start)


@pytest.mark.parametrize(
    ("pixel", "start"),
    [((160, 120), (318.0, 120.0)), ((160, 120), (160.0, -3.0)), ((3, 120), (160.0, 120.0))],
    ids=["past the target's side", "above the target", "at the source's rim"],
)
def test_a_patch_that_leaves_an_image_is_lost(pixel: tuple[int, int], start: tuple[float, float]) -> None:
    found = find(textured(), textured(), np.array([pixel]), np.array([start]))
    assert found.correlation.tolist() == [-1.0]
    assert not found.information.any()


def test_rows_without_a_start_are_not_looked_for() -> None:
    pixels = np.array([[100, 100], [160, 120]])
    start = np.array([[np.nan, 100.0], [160.0, 120.0]])
    found = find(textured(), textured(), pixels, start)
    assert found.correlation[0] == -1.0
    assert found.correlation[1] > 0.99


def test_something_else_does_not_correlate() -> None:
    other = textured()[::-1, ::-1].copy()
    pixels = lattice()
    found = find(textured(), other, pixels, pixels.astype(np.float64))
    assert np.mean(found.correlation > 0.8) < 0.2


def test_no_patches_are_no_error() -> None:
    found = find(textured(), textured(), np.empty((0, 2), np.intp), np.empty((0, 2)))
    assert found.pixels.shape == (0, 2)
    assert found.information.shape == (0, 2, 2)


def test_the_same_images_give_the_same_bits() -> None:
    pixels, start = lattice(), lattice().astype(np.float64)
    first, second = (find(textured(), textured(shift=SHIFT_PX), pixels, start) for _ in range(2))
    assert first.pixels.tobytes() == second.pixels.tobytes()
    assert first.information.tobytes() == second.information.tobytes()
    assert first.correlation.tobytes() == second.correlation.tobytes()
    assert start.tobytes() == lattice().astype(np.float64).tobytes(), "the start is the caller's"
