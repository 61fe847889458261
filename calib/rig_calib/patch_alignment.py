"""Direct alignment of small image patches (Lucas & Kanade 1981; Baker & Matthews 2004).

A patch of one image is looked for in another, where a start and the local affine map say that it should
be. Gain and offset of the two exposures are free for every patch. What comes back is the place, and the
information on it, which is of rank one on an edge and nothing on a blank wall.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from rig_protocol.compiled import compiled, inlined

Array = npt.NDArray[np.float64]
ImageF32 = npt.NDArray[np.float32]

RADIUS_PX = 7
_BLUR_PX = 0.8  # so that bilinear interpolation is exact enough, and the noise of the mosaic is less
_ITERATIONS = 12
_CONVERGED_PX = 0.01
_RIDGE = 1e-3  # of the curvature: an edge does not slide far along itself
_LEAST_VARIANCE = 1.0  # levels², of a patch with anything on it
_LEAST_GAIN = 0.05
_LEAST_DETERMINANT = 1e-3
# Blurred noise is shared by neighbouring pixels: information counts a pixel as this share of one.
_INDEPENDENT_SHARE = 0.3
_MIN_SIGMA_LEVELS = 0.7  # no patch is known better than rounding and interpolation allow
# Noise has gradients, too: this share of the residual's variance, which is that of two images.
_NOISE_GRADIENT = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class AlignedPatches:
    """N patches found: place `pixels` (N,2) in the other image, `information` (N,2,2) on it in 1/px².

    `correlation` (N,) is the normalised cross-correlation there, −1 where a patch left the image.
    """

    pixels: Array
    information: Array
    correlation: Array


def smoothed(image: npt.NDArray[np.floating] | npt.NDArray[np.uint8]) -> ImageF32:
    """The grey image (H,W) that patches are taken from."""
    return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), _BLUR_PX), dtype=np.float32)


def align_patches(
    source: ImageF32,
    target: ImageF32,
    source_pixels: npt.NDArray[np.intp],
    start_pixels: Array,
    affine: Array,
    radius_px: int = RADIUS_PX,
) -> AlignedPatches:
    """Find patches around whole `source_pixels` (N,2) of `source` in `target`, from `start_pixels` (N,2).

    `affine` (N,2,2) maps steps in the source to steps in the target. Rows with NaN are not looked for.
    """
    count = len(source_pixels)
    pixels, information = np.array(start_pixels, dtype=np.float64), np.zeros((count, 2, 2))
    correlation = np.full(count, -1.0)
    if count:
        window = _window(radius_px)
        _align(
            source, target, source_pixels.astype(np.int64), affine, window, pixels, information, correlation
        )
    return AlignedPatches(pixels, information, correlation)


def _window(radius_px: int) -> Array:
    """Weights (2r+1, 2r+1): a Gaussian, so that the patch's rim does not decide."""
    steps = np.arange(-radius_px, radius_px + 1) / (0.6 * radius_px)
    return np.exp(-0.5 * (steps[:, None] ** 2 + steps[None, :] ** 2))


@compiled()
def _align(
    source: ImageF32,
    target: ImageF32,
    at: npt.NDArray[np.int64],
    affine: Array,
    window: Array,
    pixels: Array,
    information: Array,
    correlation: Array,
) -> None:
    """Align all patches; `pixels` holds the starts and then the places."""
    side = len(window)
    buffers = np.empty((4, side, side))
    patch, by_u, by_v, seen = buffers[0], buffers[1], buffers[2], buffers[3]
    for k in range(len(at)):
        A = affine[k]
        determinant = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
        sound = (
            np.isfinite(pixels[k, 0] + pixels[k, 1] + determinant) and abs(determinant) > _LEAST_DETERMINANT
        )
        if sound and _cut_out(source, at[k, 0], at[k, 1], A, window, patch, by_u, by_v):
            power = (window * patch * patch).sum()
            if power > window.sum() * _LEAST_VARIANCE:
                found = pixels[k], information[k], correlation[k : k + 1]
                _align_one(target, A, window, patch, by_u, by_v, seen, power, *found)


@inlined
def _cut_out(
    image: ImageF32, u: int, v: int, A: Array, window: Array, patch: Array, by_u: Array, by_v: Array
) -> bool:
    """The patch around (u, v) without its mean, and its gradient by pixels of the target: A⁻ᵀ∇."""
    side = len(window)
    left, top = u - side // 2, v - side // 2
    if left < 1 or top < 1 or left + side >= image.shape[1] or top + side >= image.shape[0]:
        return False
    determinant = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
    mean = 0.0
    for r in range(side):
        for c in range(side):
            row, column = top + r, left + c
            du = 0.5 * (image[row, column + 1] - image[row, column - 1])
            dv = 0.5 * (image[row + 1, column] - image[row - 1, column])
            by_u[r, c] = (A[1, 1] * du - A[1, 0] * dv) / determinant
            by_v[r, c] = (A[0, 0] * dv - A[0, 1] * du) / determinant
            patch[r, c] = image[row, column]
            mean += window[r, c] * patch[r, c]
    patch -= mean / window.sum()
    return True


@inlined
def _align_one(
    target: ImageF32,
    A: Array,
    window: Array,
    patch: Array,
    by_u: Array,
    by_v: Array,
    seen: Array,
    power: float,
    pixel: Array,
    information: Array,
    correlation: Array,
) -> None:
    """Gauss-Newton on the place of one patch; its correlation is −1 where it is lost."""
    total, x, y, residual = window.sum(), pixel[0], pixel[1], 0.0
    huu, huv, hvv = _curvature(window, patch, by_u, by_v, power)
    ridge = _RIDGE * (huu + hvv) + 1e-9
    determinant = (huu + ridge) * (hvv + ridge) - huv * huv
    for _ in range(_ITERATIONS):
        if not _sample(target, x, y, A, window, seen):
            correlation[0] = -1.0
            return
        cross, square = (window * seen * patch).sum(), (window * seen * seen).sum()
        gain = cross / power
        if gain < _LEAST_GAIN:
            correlation[0] = -1.0
            return
        correlation[0] = cross / np.sqrt(square * power + 1e-12)
        error = seen / gain - patch
        gu, gv = (window * by_u * error).sum(), (window * by_v * error).sum()
        residual = (window * error * error).sum()
        step_u = (huv * gv - (hvv + ridge) * gu) / determinant
        step_v = (huv * gu - (huu + ridge) * gv) / determinant
        length = np.sqrt(step_u * step_u + step_v * step_v)
        shorter = 1.0 / max(length, 1.0)
        x, y = x + step_u * shorter, y + step_v * shorter
        if length < _CONVERGED_PX:
            break
    noise = _NOISE_GRADIENT * residual
    scale = _INDEPENDENT_SHARE / max(residual / total, _MIN_SIGMA_LEVELS**2)
    pixel[0], pixel[1] = x, y
    information[0, 0], information[1, 1] = (huu - noise) * scale, (hvv - noise) * scale
    information[0, 1] = information[1, 0] = huv * scale


@inlined
def _curvature(
    window: Array, patch: Array, by_u: Array, by_v: Array, power: float
) -> tuple[float, float, float]:
    """Σ w ∇∇ᵀ with offset and gain marginalised: gradients without their parts along 1 and the patch."""
    total = window.sum()
    mu, mv = (window * by_u).sum(), (window * by_v).sum()
    pu, pv = (window * by_u * patch).sum(), (window * by_v * patch).sum()
    return (
        (window * by_u * by_u).sum() - mu * mu / total - pu * pu / power,
        (window * by_u * by_v).sum() - mu * mv / total - pu * pv / power,
        (window * by_v * by_v).sum() - mv * mv / total - pv * pv / power,
    )


@inlined
def _sample(target: ImageF32, x: float, y: float, A: Array, window: Array, seen: Array) -> bool:
    """The target's values, without their mean, where A maps the patch's pixels; False outside."""
    side = len(window)
    reach, mean = side // 2, 0.0
    for r in range(side):
        for c in range(side):
            px = x + A[0, 0] * (c - reach) + A[0, 1] * (r - reach)
            py = y + A[1, 0] * (c - reach) + A[1, 1] * (r - reach)
            if px < 0 or py < 0 or px >= target.shape[1] - 1 or py >= target.shape[0] - 1:
                return False
            column, row = int(px), int(py)
            a, b = px - column, py - row
            upper = (1.0 - a) * target[row, column] + a * target[row, column + 1]
            lower = (1.0 - a) * target[row + 1, column] + a * target[row + 1, column + 1]
            seen[r, c] = (1.0 - b) * upper + b * lower
            mean += window[r, c] * seen[r, c]
    seen -= mean / window.sum()
    return True
