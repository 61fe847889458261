"""How well pixels' noise would let a patch be placed: what perfect matching of the images could reach."""

import cv2
import numpy as np
import numpy.typing as npt

from rig_calib.view import CameraView
from support.offered_matches import Matches, Pair, Sigmas, TrueRig

Array = npt.NDArray[np.float64]

# Of the simulated colour sensor (color_sensor.py): variance per level and read noise, levels.
_PHOTON_VARIANCE, _READ_VARIANCE = 0.02, 1.0
_PATCH_SCALES, _LEAST_HALF_PX = 4.0, 4.0
_SOBEL_GAIN, _SOBEL_NOISE = 1 / 8, 12 / 64  # share of white noise's variance in the filter's output


def image_sigmas(true: TrueRig, matches: dict[Pair, Matches]) -> dict[Pair, Sigmas]:
    """σ² = σ_I²/Σ(∂I)², the mean of both axes, over a patch of eight scales around each keypoint.

    A pixel's information is shared among the patches that cover it.
    """
    sigmas: dict[Pair, list[Array]] = {pair: [] for pair in matches}
    for camera, view in enumerate(true.rig.views):
        own = [(pair, pair.index(camera)) for pair in matches if camera in pair]
        pixels = np.concatenate([matches[pair].pixels[side] for pair, side in own])
        scales = np.concatenate([matches[pair].scales_px[side] for pair, side in own])
        sigma = _patch_sigmas(view, pixels, scales)
        ends = np.cumsum([len(matches[pair]) for pair, _ in own])
        for (pair, side), values in zip(own, np.split(sigma, ends[:-1]), strict=True):
            sigmas[pair].insert(side, values)
    return {pair: (both[0], both[1]) for pair, both in sigmas.items()}


def _patch_sigmas(view: CameraView, pixels: Array, scales_px: Array) -> Array:
    grey = np.mean([cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in view.color], axis=0)
    variance = (_PHOTON_VARIANCE * grey + _READ_VARIANCE) / len(view.color)
    along, down = (cv2.Sobel(grey, cv2.CV_64F, *axes) * _SOBEL_GAIN for axes in ((1, 0), (0, 1)))
    squared = np.maximum((along**2 + down**2) / 2 - _SOBEL_NOISE * variance, 0)
    low, high = _patches(pixels, scales_px, grey.shape)
    covered = np.zeros(np.array(grey.shape) + 1)
    for sign, rows, columns in ((1, low, low), (-1, low, high), (-1, high, low), (1, high, high)):
        np.add.at(covered, (rows[:, 1], columns[:, 0]), sign)
    patches = np.maximum(covered.cumsum(axis=0).cumsum(axis=1)[:-1, :-1], 1)
    sums = np.pad(squared / variance / patches, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    information = sums[high[:, 1], high[:, 0]] - sums[low[:, 1], high[:, 0]]
    information -= sums[high[:, 1], low[:, 0]] - sums[low[:, 1], low[:, 0]]
    return np.asarray(1 / np.sqrt(np.maximum(information, 1e-6)))


def _patches(
    pixels: Array, scales_px: Array, shape: tuple[int, ...]
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp]]:
    """Corners (N,2), column and row, of the squares around keypoints; the second lies beyond the square."""
    half = np.rint(np.maximum(_PATCH_SCALES * scales_px, _LEAST_HALF_PX)).astype(int)[:, None]
    middle, limits = np.rint(pixels).astype(int), (shape[1], shape[0])
    return np.clip(middle - half, 0, limits), np.clip(middle + half + 1, 0, limits)
