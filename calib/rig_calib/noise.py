"""How far measurements can be trusted: white noise, errors that neighbours share, and how much there was."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.spatial

from rig_calib.crowding import crowding
from rig_calib.depth_model import DISPARITY_SIGMA
from rig_calib.observation_model import Observations

Array = npt.NDArray[np.float64]

# Distances in the depth image over which noise and distortion are alike.
_NOISE_LENGTH_PX, _DISTORTION_LENGTH_PX = 8.0, 40.0
_NEIGHBOUR_PX = 25.0
# A blob is placed to a share of its size (0.05 on two renderers' images, where nothing else is wrong).
_POSITION_SHARE_OF_SCALE = 0.05
# Two cameras that see a point share its error between them, so that each shows 1/√2 of its own; the bias
# states follow about as much of what is left.
_ERROR_OF_RESIDUAL = 2.0
_MAD_TO_SIGMA = 1.4826  # of a normal distribution
_OUTLIER_SIGMAS = 3.0


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """How noisy a capture is; the defaults are a rig at rest with good lenses.

    `pixel_scale` multiplies the keypoints' standard deviations. `pixel_distortion` (pixels) and
    `disparity_distortion` (raw steps) are the parts of the errors that neighbours in an image share: a
    rolling shutter that moved, a lens or a depth camera that bends what no state follows.
    """

    pixel_scale: float = 1.0
    pixel_distortion: float = 0.0
    disparity_distortion: float = 0.3 * DISPARITY_SIGMA

    def keypoint_sigma(self, pixel_sigma: float, pixels: Array, scale_px: Array) -> Array:
        """Standard deviations (N,) of one camera's keypoints: a floor, a share of their size, a crowd's."""
        white = (self.pixel_scale * np.hypot(pixel_sigma, _POSITION_SHARE_OF_SCALE * scale_px)) ** 2
        return np.asarray(np.sqrt(white + _crowded(self.pixel_distortion, pixels, _DISTORTION_LENGTH_PX)))

    def disparity_sigma(self, grid_pixels: Array, lookup_sigma: Array) -> Array:
        """Standard deviations (N,) of one camera's disparities, whose noise is shared over a window, too."""
        shared = _crowded(lookup_sigma, grid_pixels, _NOISE_LENGTH_PX)
        smooth = _crowded(self.disparity_distortion, grid_pixels, _DISTORTION_LENGTH_PX)
        return np.asarray(np.sqrt(shared + smooth))


def observed_noise(seen: Observations, residuals: Array, point_count: int) -> NoiseModel:
    """The noise that an adjustment's whitened residuals (M,3) show, at least that of a rig at rest."""
    assumed = NoiseModel()
    count = 2 * len(residuals)
    left = max(count - 2 * point_count, 1)  # each point takes two coordinates for itself
    scatter = float(np.median(np.abs(residuals[:, :2])))
    pixel_error = seen.pixel_error(residuals[:, :2])
    disparity_error = residuals[:, 2:] * seen.disparity_sigma[:, None]
    inlier = np.asarray((np.abs(residuals) < _OUTLIER_SIGMAS).all(axis=1))
    with_depth = np.asarray(inlier & np.isfinite(seen.disparity))
    return NoiseModel(
        max(assumed.pixel_scale, _MAD_TO_SIGMA * scatter * float(np.sqrt(count / left))),
        max(assumed.pixel_distortion, _shared_error(seen.camera, seen.pixels, pixel_error, inlier)),
        max(
            assumed.disparity_distortion,
            _shared_error(seen.camera, seen.grid_pixels, disparity_error, with_depth),
        ),
    )


def _shared_error(
    camera: npt.NDArray[np.intp], pixels: Array, errors: Array, usable: npt.NDArray[np.bool_]
) -> float:
    """Standard deviation of what errors (M,D) near each other in one image have in common."""
    products, count = 0.0, 0
    for c in np.unique(camera[usable]):
        rows = np.flatnonzero(usable & (camera == c))
        near = scipy.spatial.KDTree(pixels[rows]).query_pairs(_NEIGHBOUR_PX, output_type="ndarray")
        products += float((errors[rows[near[:, 0]]] * errors[rows[near[:, 1]]]).sum())
        count += near.shape[0] * errors.shape[1]
    return _ERROR_OF_RESIDUAL * float(np.sqrt(max(products, 0.0) / max(count, 1)))


def _crowded(sigma: float | Array, pixels: Array, length_px: float) -> Array:
    """Variances (N,) that give a crowd together what it knows of an error that its members share.

    n measurements with one error are worth one: the variance is multiplied by their number.
    """
    return np.asarray(np.square(sigma) * crowding(pixels, length_px))
