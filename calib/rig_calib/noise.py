"""How far measurements can be trusted: white noise, errors that neighbours share, and how much there was."""

from dataclasses import astuple, dataclass

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
# The states follow some of what neighbours share, so that residuals show less of it than there is.
_ERROR_OF_RESIDUAL = 1.3
_SCATTER_OF_RESIDUAL = 1.2  # a point's depth takes some of its pixel's scatter
# A patch's source defines its point: its own residual is none.
_EXACT_PX = 0.015
_WORTH_REPEATING = 0.25  # of a standard deviation's size
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
    pixel_distortion: float = 0.02
    disparity_distortion: float = 0.3 * DISPARITY_SIGMA

    def differs_from(self, other: "NoiseModel") -> bool:
        """Whether an estimate with the other's weights is worth repeating with these."""
        ours, others = astuple(self), astuple(other)
        return any(abs(a - b) > _WORTH_REPEATING * b for a, b in zip(ours, others, strict=True))

    def pixel_whitener(self, information: Array, pixels: Array) -> Array:
        """Whiteners W (N,2,2) of one camera's pixels: WᵀW is what is known of each in its crowd.

        `information` (N,2,2) is what is known of each alone; where that is nothing in a direction, so is W.
        """
        share = np.linalg.eigh(information)
        shared = _crowded(self.pixel_distortion, pixels, _DISTORTION_LENGTH_PX)[:, None]
        known = np.maximum(share.eigenvalues, 0.0)
        root = np.sqrt(known / (self.pixel_scale**2 + known * shared))
        return np.asarray(root[:, :, None] * share.eigenvectors.transpose(0, 2, 1))

    def disparity_sigma(self, grid_pixels: Array, lookup_sigma: Array) -> Array:
        """Standard deviations (N,) of one camera's disparities, whose noise is shared over a window, too."""
        shared = _crowded(lookup_sigma, grid_pixels, _NOISE_LENGTH_PX)
        smooth = _crowded(self.disparity_distortion, grid_pixels, _DISTORTION_LENGTH_PX)
        return np.asarray(np.sqrt(shared + smooth))


def observed_noise(seen: Observations, residuals: Array) -> NoiseModel:
    """The noise that an adjustment's whitened residuals (M,3) show, at least that of a rig at rest."""
    assumed = NoiseModel()
    inlier = np.asarray((np.abs(residuals) < _OUTLIER_SIGMAS).all(axis=1))
    with_depth = np.asarray(inlier & np.isfinite(seen.disparity))
    pixel_error, pixel_weight = seen.pixel_error(residuals[:, :2]), _pixel_information(seen)
    measured = (seen.pixel_whitener != 0.0).any(axis=(1, 2)) & (pixel_weight < 1.0 / _EXACT_PX**2)
    whitened = residuals[measured, :2][(seen.pixel_whitener[measured] != 0.0).any(axis=2)]
    scatter = _MAD_TO_SIGMA * float(np.median(np.abs(whitened))) if len(whitened) else 0.0
    disparity_error = residuals[:, 2:] * seen.disparity_sigma[:, None]
    return NoiseModel(
        max(assumed.pixel_scale, _SCATTER_OF_RESIDUAL * scatter),
        max(
            assumed.pixel_distortion,
            _shared_error(seen.camera, seen.pixels, pixel_error, pixel_weight, inlier & measured),
        ),
        max(
            assumed.disparity_distortion,
            _shared_error(
                seen.camera, seen.grid_pixels, disparity_error, 1.0 / seen.disparity_sigma**2, with_depth
            ),
        ),
    )


def _pixel_information(seen: Observations) -> Array:
    """What is known (M,) of each pixel in its worse direction, 1/px²."""
    information = np.einsum("mki,mkj->mij", seen.pixel_whitener, seen.pixel_whitener)
    return np.asarray(np.maximum(np.linalg.eigvalsh(information)[:, 0], 0.0))


def _shared_error(
    camera: npt.NDArray[np.intp],
    pixels: Array,
    errors: Array,
    weights: Array,
    usable: npt.NDArray[np.bool_],
) -> float:
    """Standard deviation of what errors (M,D) near each other in one image have in common."""
    products, total = 0.0, 0.0
    for c in np.unique(camera[usable]):
        rows = np.flatnonzero(usable & (camera == c))
        near = scipy.spatial.KDTree(pixels[rows]).query_pairs(_NEIGHBOUR_PX, output_type="ndarray")
        a, b = rows[near[:, 0]], rows[near[:, 1]]
        weight = weights[a] * weights[b]
        products += float(weight @ (errors[a] * errors[b]).mean(axis=1))
        total += float(weight.sum())
    return _ERROR_OF_RESIDUAL * float(np.sqrt(max(products, 0.0) / max(total, 1e-12)))


def _crowded(sigma: float | Array, pixels: Array, length_px: float) -> Array:
    """Variances (N,) that give a crowd together what it knows of an error that its members share.

    n measurements with one error are worth one: the variance is multiplied by their number.
    """
    return np.asarray(np.square(sigma) * crowding(pixels, length_px))
