"""Landmarks: places of a still image where a shift of the image would be seen, with their points in space."""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rig_calib.drift.look import HALF
from rig_calib.drift.motion import Measurements
from rig_protocol.frames import ImageU8

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]

WINDOW_PX = 17  # of the halved image
_CELL_PX = 16  # one landmark each
_LEVELS = 3  # of the pyramid: shifts up to some 30 halved pixels are found where there is coarse texture
_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 8, 0.02)
_MIN_EIGENVALUE = 1e-6
# What interpolation and changing light leave, however much texture there is; halved pixels.
_LEAST_SIGMA_PX = 0.04
_NOISE_SHARED = 2.0  # the noise of reference and present image, and of neighbouring windows that overlap


def choose_landmarks(contrast: ImageU8, allowed: Mask) -> Array:
    """Pixels (N,2) of the halved image: the most textured allowed one of every cell."""
    texture = np.asarray(cv2.cornerEigenValsAndVecs(contrast, WINDOW_PX, 3))[..., :2].sum(axis=2)
    border = WINDOW_PX // 2
    usable = np.zeros(allowed.shape, bool)
    usable[border:-border, border:-border] = allowed[border:-border, border:-border]
    texture = np.where(usable, texture, -1.0)
    chosen = []
    for top in range(0, texture.shape[0], _CELL_PX):
        for left in range(0, texture.shape[1], _CELL_PX):
            cell = texture[top : top + _CELL_PX, left : left + _CELL_PX]
            row, column = np.unravel_index(int(cell.argmax()), cell.shape)
            if cell[row, column] > 0:
                chosen.append((left + column, top + row))
    return np.array(chosen, dtype=np.float64).reshape(-1, 2)


def gradient_tensors(contrast: ImageU8, pixels: Array) -> Array:
    """Σ ∇I ∇Iᵀ (N,2,2) over the window around each pixel (N,2), levels² a pixel²."""
    image = contrast.astype(np.float32)
    gx, gy = (cv2.Sobel(image, cv2.CV_32F, *order, ksize=3, scale=1 / 8) for order in ((1, 0), (0, 1)))
    at = np.rint(pixels).astype(np.intp)
    sums = [
        cv2.boxFilter(product, -1, (WINDOW_PX, WINDOW_PX), normalize=False)[at[:, 1], at[:, 0]]
        for product in (gx * gx, gx * gy, gy * gy)
    ]
    return np.stack([sums[0], sums[1], sums[1], sums[2]], axis=-1).reshape(-1, 2, 2).astype(np.float64)


@dataclass(frozen=True, slots=True, eq=False)
class Shifts:
    """Shifts (N,2) of landmarks, full pixels, and their information (N,2,2)."""

    shift: Array
    information: Array

    def whitened(self, jacobian: Array, use: Mask) -> Measurements:
        """Of the chosen ones, with the derivative (N,2,6) of the shift by the motion."""
        root = np.swapaxes(np.linalg.cholesky(self.information[use]), 1, 2)
        return Measurements(np.einsum("nij,nj->ni", root, self.shift[use]), root @ jacobian[use], rows=2)


def track(
    before: ImageU8,
    now: ImageU8,
    pixels: Array,
    tensors: Array,
    noise_levels: float,
    least_sigma_px: float = _LEAST_SIGMA_PX,
    expected: Array | None = None,
    levels: int = _LEVELS,
) -> tuple[Shifts, Mask]:
    """By how much landmarks (N,2) moved from one contrast image to another, and which were found.

    `expected` (N,2): shifts in full pixels to begin from. Lucas & Kanade 1981, pyramidal; a window's shift is
    known to 2 σ² (Σ ∇I ∇Iᵀ)⁻¹.
    """
    places = pixels.astype(np.float32).reshape(-1, 1, 2)
    guess = None if expected is None else places + (expected / HALF).astype(np.float32).reshape(-1, 1, 2)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        before,
        now,
        places,
        guess,  # type: ignore[arg-type]  # the stubs want an array to begin from
        winSize=(WINDOW_PX, WINDOW_PX),
        maxLevel=levels,
        criteria=_CRITERIA,
        flags=0 if guess is None else cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=_MIN_EIGENVALUE,
    )
    shift = HALF * (found.reshape(-1, 2).astype(np.float64) - pixels)
    covariance = _NOISE_SHARED * noise_levels**2 * np.linalg.inv(tensors + 1e-3 * np.eye(2))
    covariance = 4 * (covariance + least_sigma_px**2 * np.eye(2))  # halved pixels to full ones
    return Shifts(shift, np.asarray(np.linalg.inv(covariance), dtype=np.float64)), status.ravel() == 1
