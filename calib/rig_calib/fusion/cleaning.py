"""Cleaning of depth images: averages over frames, smooth surfaces, nothing that floats between them."""

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from rig_calib.depth_model import DepthGrid, depth_edges
from rig_calib.projection import from_pixels

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

# Beyond this angle between surface and ray a Kinect measures nothing (Nguyen, Izadi & Lovell 2012):
# what looks so steep floats between two surfaces.
_MAX_INCIDENCE_DEG = 80.0
_MIN_PATCH_PX = 80  # smaller islands of depth are speckle of the correlator
_MAX_FLICKER = 1.5  # raw steps of standard deviation over frames, three times the noise: an edge flips
# The bilateral filter spans the 9×9 correlation window and keeps steps above three raw steps.
_SMOOTH_WINDOW_PX, _SMOOTH_SIGMA_PX, _SMOOTH_SIGMA_STEPS = 9, 3.0, 1.5

# A gap is bridged where the means of its sides differ by less than this, six deviations of the noise.
_SAME_STEPS, _BRIDGING_PAIRS = 3.0, 3


def mean_disparity(images: Sequence[Array]) -> Array:
    """Mean disparity (H,W) over frames, NaN where most frames have none or where it flickers."""
    count, total, squares = (np.zeros(images[0].shape) for _ in range(3))
    for image in images:
        valid = np.isfinite(image)
        value = np.where(valid, image, 0.0)
        count += valid
        total += value
        squares += value * value
    seen = np.maximum(count, 1.0)
    mean = total / seen
    variance = squares / seen - mean * mean
    return np.where((2 * count >= len(images)) & (count > 0) & (variance < _MAX_FLICKER**2), mean, np.nan)


def bridge_gaps(disparity: Array) -> Array:
    """Disparity (H,W) where single pixels without any take what opposite neighbours have in their midst.

    Of the four pairs at least three must be measured and agree. A plane stays a plane; what is bridged
    across a step stands out as one.
    """
    padded = np.pad(disparity, 1, constant_values=np.nan)
    height, width = disparity.shape
    pairs = []
    for down, across in ((0, 1), (1, 0), (1, 1), (1, -1)):
        before = padded[1 - down : 1 - down + height, 1 - across : 1 - across + width]
        after = padded[1 + down : 1 + down + height, 1 + across : 1 + across + width]
        pairs.append((before + after) / 2)
    means = np.stack(pairs)
    known = np.isfinite(means)
    count, total = known.sum(axis=0), np.where(known, means, 0.0).sum(axis=0)
    spread = np.where(known, means, -np.inf).max(axis=0) - np.where(known, means, np.inf).min(axis=0)
    bridged = ~np.isfinite(disparity) & (count >= _BRIDGING_PAIRS) & (spread < _SAME_STEPS)
    return np.where(bridged, total / np.maximum(count, 1), disparity)


def smooth_disparity(disparity: Array) -> Array:
    """Disparity with its noise smoothed along surfaces and its steps kept (bilateral filter).

    Planes are linear in disparity, so that smoothing over a symmetric window does not bend them.
    """
    known = np.isfinite(disparity)
    # A hole becomes 0, hundreds of steps from every measurement, and gets no weight.
    filled = np.where(known, disparity, 0.0).astype(np.float32)
    smooth = cv2.bilateralFilter(filled, _SMOOTH_WINDOW_PX, _SMOOTH_SIGMA_STEPS, _SMOOTH_SIGMA_PX)
    return np.where(known, smooth, np.nan)


def cos_incidence(grid: DepthGrid, disparity: Array) -> Array:
    """Cosine (H,W) of the angle between ray and surface normal, NaN beside holes.

    A plane n·X = h has 1/z = (n·(x, y, 1))/h: the gradient of inverse depth is the normal.
    """
    inverse_depth = (grid.raw_model.offset - disparity) / grid.raw_model.numerator_m
    by_row, by_column = np.gradient(inverse_depth)
    nx, ny = by_column * grid.intrinsics.fx, by_row * grid.intrinsics.fy
    rows, columns = np.indices(disparity.shape)
    rays = from_pixels(grid.intrinsics, np.stack([columns, rows], axis=-1).astype(np.float64))
    nz = inverse_depth - nx * rays[..., 0] - ny * rays[..., 1]
    length = np.sqrt(nx**2 + ny**2 + nz**2) * np.sqrt(1.0 + (rays**2).sum(axis=-1))
    return np.asarray(inverse_depth / length)


def solid_pixels(disparity: Array, incidence: Array) -> Mask:
    """Pixels (H,W) on surfaces: neither beside an edge or a hole, nor too steep, nor in a small island."""
    steep = ~(incidence > np.cos(np.deg2rad(_MAX_INCIDENCE_DEG)))
    edges = depth_edges(disparity) | steep
    beside_edge = cv2.dilate(edges.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    _, labels, stats, _ = cv2.connectedComponentsWithStats((~beside_edge).astype(np.uint8), connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] >= _MIN_PATCH_PX
    large[0] = False  # the background
    return np.asarray(large[labels])
