"""Rules of the printed patterns: what a Kinect finds in them, and that a seed fixes them to the byte."""

import hashlib

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from rig_calib.features import Keypoints, detect
from rig_calib.overlap import Region
from rig_calib.pattern import CELLS_MM, descriptor_pattern
from rig_protocol.frames import ImageU8

PIXEL_MM = 0.5
A3_SHAPE = (772, 554)  # the printed part of a sheet
FOCAL_PX = 525.0
SIGMA_PX = 0.25
SHARE_OF_SCALE = 0.05  # to which a keypoint is placed
FRAME_PX = 30  # of plain wall around the sheet


def seen_from(distance_m: float, raster: ImageU8) -> ImageU8:
    """The sheet on a plain wall as a colour camera shows it: soft lens, half the contrast, noise."""
    scale = FOCAL_PX * PIXEL_MM * 1e-3 / distance_m
    size = (round(raster.shape[1] * scale), round(raster.shape[0] * scale))
    sheet = cv2.resize(raster, size, interpolation=cv2.INTER_AREA)
    image = cv2.copyMakeBorder(sheet, *[FRAME_PX] * 4, cv2.BORDER_CONSTANT, value=(200,))
    soft = cv2.GaussianBlur(image.astype(np.float64), (0, 0), 0.7) * 0.5 + 30
    noisy = soft + np.random.default_rng(0).normal(0, 1.8, soft.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def keypoints_on_sheet(image: ImageU8) -> Keypoints:
    height, width = image.shape
    return detect(image, Region(FRAME_PX, FRAME_PX, width - FRAME_PX, height - FRAME_PX), 0, SIGMA_PX)


def band_energy(raster: ImageU8, cell_mm: float) -> float:
    """Variance of the blobs that an octave is there for."""
    scale = 4 * PIXEL_MM / cell_mm  # four pixels a cell are enough, and quick
    small = cv2.resize(raster.astype(np.float32), None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    fine, coarse = (cv2.GaussianBlur(small, (0, 0), 4 * k) for k in (0.5, 1.0))
    return float(np.var(fine - coarse))


def test_a_seed_fixes_the_pattern_to_the_byte() -> None:
    raster = descriptor_pattern(7, 3, (200, 150), PIXEL_MM)
    digest = hashlib.sha256(raster.tobytes()).hexdigest()
    assert digest == "bf50e712c1a1410584f35514fdb5c270c8eb0ef293fc0837a262f14856c843e6", (
        "who prints a lost sheet again must get the same one"
    )


@pytest.mark.parametrize("other", [(7, 4), (8, 3)])
def test_no_two_patterns_are_alike(other: tuple[int, int]) -> None:
    a = descriptor_pattern(7, 3, A3_SHAPE, PIXEL_MM).astype(np.float64)
    b = descriptor_pattern(*other, A3_SHAPE, PIXEL_MM).astype(np.float64)
    # Between independent patterns the few cells of the coarsest octave alone leave some correlation.
    assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 0.25


def test_every_octave_carries_energy() -> None:
    energy = np.array([band_energy(descriptor_pattern(1, 1, (1200, 1200), PIXEL_MM), c) for c in CELLS_MM])
    assert energy.min() > 0.5 * energy.max()
    single = np.array(
        [band_energy(descriptor_pattern(1, 1, (1200, 1200), PIXEL_MM, (8.0,)), c) for c in CELLS_MM]
    )
    assert single.min() < 0.2 * single.max(), "the measure must tell octaves apart"


@pytest.mark.parametrize("distance_m", [1.0, 2.0, 3.0])
def test_a_sheet_is_full_of_keypoints_from_one_to_three_metres(distance_m: float) -> None:
    image = seen_from(distance_m, descriptor_pattern(1, 1, A3_SHAPE, PIXEL_MM))
    keypoints = keypoints_on_sheet(image)
    area_px = (image.shape[0] - 2 * FRAME_PX) * (image.shape[1] - 2 * FRAME_PX)
    assert len(np.unique(keypoints.place)) > 0.012 * area_px
    assert emptiest_quarter(keypoints.pixels, image.shape) > 0.15 * len(keypoints)
    octaves = np.floor(np.log2(scales_px(keypoints)))
    assert all((octaves >= octave).sum() >= count for octave, count in ((1, 10), (2, 3)))


def scales_px(keypoints: Keypoints) -> npt.NDArray[np.float64]:
    """Sizes (N,) of the keypoints, by how well each is placed."""
    return np.sqrt(1 / keypoints.information[:, 0, 0] - SIGMA_PX**2) / SHARE_OF_SCALE


def emptiest_quarter(pixels: npt.NDArray[np.float64], shape: tuple[int, ...]) -> int:
    right, low = pixels[:, 0] > shape[1] / 2, pixels[:, 1] > shape[0] / 2
    return int(np.bincount(2 * right.astype(int) + low, minlength=4).min())


def test_the_same_spot_is_recognised_from_one_and_from_two_metres() -> None:
    raster = descriptor_pattern(1, 1, A3_SHAPE, PIXEL_MM)
    near, far = (keypoints_on_sheet(seen_from(z, raster)) for z in (1.0, 2.0))
    matcher = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True)
    matches = matcher.match(near.descriptors, far.descriptors)
    error_px = [
        np.linalg.norm((near.pixels[m.queryIdx] - FRAME_PX) / 2 - (far.pixels[m.trainIdx] - FRAME_PX))
        for m in matches
    ]
    assert sum(error < 1.5 for error in error_px) > 40
