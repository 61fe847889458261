"""Descriptor patterns: noise in which SIFT finds keypoints at every scale and nothing repeats.

Several octaves of noise of equal energy (Li, Heng, Köser & Pollefeys 2013, "A multiple-camera system
calibration toolbox using a feature descriptor-based calibration pattern").
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from rig_protocol.frames import ImageU8

Array = npt.NDArray[np.float64]

CELLS_MM = (4.0, 8.0, 16.0, 32.0, 64.0)
"""Cell of each octave: from two and a half pixels of a Kinect at 0.8 m to eleven pixels at 3 m."""

# Energy of one axis of white noise through a cubic B-spline: the integral of its square.
_SPLINE_ENERGY = 151 / 315
_UNIFORM_ENERGY = 1 / 3  # of numbers in -1..1
_CONTRAST = 1.6  # at one standard deviation the ink is at 92 % of what it could be
_INK, _PAPER = 8.0, 247.0  # a printer clips beyond, and clipped noise is flat


def descriptor_pattern(
    seed: int, pattern: int, shape: tuple[int, int], pixel_mm: float, cells_mm: Sequence[float] = CELLS_MM
) -> ImageU8:
    """Pattern number `pattern` of a seed, grey (rows, columns), one pixel `pixel_mm` wide.

    The same arguments give the same bytes on every machine: only guaranteed random bits and correctly
    rounded operations are used. No two patterns of a seed share anything.
    """
    noise = np.zeros(shape)
    for octave, cell_mm in enumerate(cells_mm):
        noise += _octave(seed, pattern, octave, shape, cell_mm / pixel_mm)
    noise *= _CONTRAST / np.sqrt(len(cells_mm))
    ink = noise / np.sqrt(1.0 + noise * noise)  # soft limit in -1..1
    return np.rint((_INK + _PAPER) / 2 + (_PAPER - _INK) / 2 * ink).astype(np.uint8)


def _octave(seed: int, pattern: int, octave: int, shape: tuple[int, int], cell_px: float) -> Array:
    """Noise (rows, columns) of unit variance without detail finer than a cell."""
    grid_shape = (int(shape[0] / cell_px) + 4, int(shape[1] / cell_px) + 4)
    bits = np.random.Philox(key=[seed, pattern], counter=[0, 0, 0, octave])
    raw = bits.random_raw(grid_shape[0] * grid_shape[1])
    grid = (np.asarray(raw) >> np.uint64(11)).astype(np.float64).reshape(grid_shape) * 2.0**-52 - 1.0
    rows = _interpolated(grid, shape[0], cell_px)
    noise = _interpolated(rows.T, shape[1], cell_px).T
    return np.asarray(noise / (_SPLINE_ENERGY * np.sqrt(_UNIFORM_ENERGY)))


def _interpolated(grid: Array, size: int, cell_px: float) -> Array:
    """The first axis of a grid (N,M) through cubic B-splines (size, M): no kinks, no direction preferred."""
    at = np.arange(size) / cell_px
    first = at.astype(np.intp)
    t = (at - first)[:, None]
    weights = ((1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3)
    total = np.zeros((size, grid.shape[1]))
    for k, weight in enumerate(weights):
        total += weight / 6 * grid[first + k]
    return total
