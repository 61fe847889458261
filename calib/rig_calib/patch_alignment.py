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
Map = tuple[float, float, float, float]
"""A (2,2), row by row: steps in the source to steps in the target."""
Moments = tuple[float, float, float, float, float, float, float, float]

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
    side, total = len(window), window.sum()
    weighted = np.empty((side, side, 3))  # gradient and patch, times the window
    for k in range(len(at)):
        A = affine[k, 0, 0], affine[k, 0, 1], affine[k, 1, 0], affine[k, 1, 1]
        determinant = A[0] * A[3] - A[1] * A[2]
        sound = (
            np.isfinite(pixels[k, 0] + pixels[k, 1] + determinant) and abs(determinant) > _LEAST_DETERMINANT
        )
        if sound and _holds(source, at[k, 0], at[k, 1], (1.0, 0.0, 0.0, 1.0), side // 2 + 1):
            moments = _cut_out(source, at[k, 0], at[k, 1], A, window, total, weighted)
            if moments[0] > total * _LEAST_VARIANCE:
                found = _align_one(target, pixels[k, 0], pixels[k, 1], A, window, total, weighted, moments)
                correlation[k] = found[0]
                if found[0] > 0.0:
                    pixels[k, 0], pixels[k, 1] = found[1], found[2]
                    information[k, 0, 0], information[k, 1, 1] = found[3], found[5]
                    information[k, 0, 1] = information[k, 1, 0] = found[4]


@inlined
def _holds(image: ImageF32, x: float, y: float, A: Map, reach: int) -> bool:
    """Whether the corners that A gives a patch around (x, y), and so all of it, lie inside the image."""
    across = (abs(A[0]) + abs(A[1])) * reach
    down = (abs(A[2]) + abs(A[3])) * reach
    height, width = image.shape
    return x - across >= 0 and y - down >= 0 and x + across < width - 1 and y + down < height - 1


@inlined
def _cut_out(
    image: ImageF32, u: int, v: int, A: Map, window: Array, total: float, weighted: Array
) -> Moments:
    """Fill `weighted` with gradient and patch around (u, v); the gradient is by the target's pixels, A⁻ᵀ∇.

    Returned are the sums over the window w of p², ∇u, ∇v, ∇u p, ∇v p, ∇u², ∇u ∇v and ∇v²; p is the patch
    without its mean.
    """
    side = len(window)
    left, top = u - side // 2, v - side // 2
    determinant = A[0] * A[3] - A[1] * A[2]
    level = np.float64(image[v, u])  # near all values: sums of squares keep their digits
    s, pp, mu, mv, pu, pv, uu, uv, vv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for r in range(side):
        for c in range(side):
            row, column, w = top + r, left + c, window[r, c]
            across = 0.5 * (image[row, column + 1] - image[row, column - 1])
            down = 0.5 * (image[row + 1, column] - image[row - 1, column])
            gu, gv = (A[3] * across - A[2] * down) / determinant, (A[0] * down - A[1] * across) / determinant
            p = image[row, column] - level
            wu, wv, wp = w * gu, w * gv, w * p
            weighted[r, c, 0], weighted[r, c, 1], weighted[r, c, 2] = wu, wv, wp
            s, pp, mu, mv = s + wp, pp + wp * p, mu + wu, mv + wv
            pu, pv, uu, uv, vv = pu + wu * p, pv + wv * p, uu + wu * gu, uv + wu * gv, vv + wv * gv
    mean = s / total
    for r in range(side):
        for c in range(side):
            weighted[r, c, 2] -= mean * window[r, c]
    return pp - mean * s, mu, mv, pu - mean * mu, pv - mean * mv, uu, uv, vv


@inlined
def _align_one(
    target: ImageF32,
    x: float,
    y: float,
    A: Map,
    window: Array,
    total: float,
    weighted: Array,
    moments: Moments,
) -> tuple[float, float, float, float, float, float]:
    """Gauss-Newton on the place of one patch: correlation (−1: lost), place, and information uu, uv, vv."""
    lost = (-1.0, x, y, 0.0, 0.0, 0.0)
    power, mu, mv, pu, pv, uu, uv, vv = moments
    # Offset and gain marginalised: gradients without their parts along 1 and the patch.
    huu = uu - mu * mu / total - pu * pu / power
    huv = uv - mu * mv / total - pu * pv / power
    hvv = vv - mv * mv / total - pv * pv / power
    ridge = _RIDGE * (huu + hvv) + 1e-9
    determinant = (huu + ridge) * (hvv + ridge) - huv * huv
    residual, correlation = 0.0, -1.0
    for _ in range(_ITERATIONS):
        if not _holds(target, x, y, A, len(window) // 2):
            return lost
        square, along_u, along_v, cross = _compare(target, x, y, A, window, total, weighted, mu, mv)
        gain = cross / power
        if gain < _LEAST_GAIN:
            return lost
        correlation = cross / np.sqrt(square * power + 1e-12)
        gu, gv = along_u / gain - pu, along_v / gain - pv
        residual = max(square / gain**2 - power, 0.0)
        step_u = (huv * gv - (hvv + ridge) * gu) / determinant
        step_v = (huv * gu - (huu + ridge) * gv) / determinant
        length = np.sqrt(step_u * step_u + step_v * step_v)
        shorter = 1.0 / max(length, 1.0)
        x, y = x + step_u * shorter, y + step_v * shorter
        if length < _CONVERGED_PX:
            break
    noise = _NOISE_GRADIENT * residual
    scale = _INDEPENDENT_SHARE / max(residual / total, _MIN_SIGMA_LEVELS**2)
    return correlation, x, y, (huu - noise) * scale, huv * scale, (hvv - noise) * scale


@inlined
def _compare(
    target: ImageF32,
    x: float,
    y: float,
    A: Map,
    window: Array,
    total: float,
    weighted: Array,
    mu: float,
    mv: float,
) -> tuple[float, float, float, float]:
    """Sums of w t², ∇u t, ∇v t and p t over the window; t are the target's values without their mean."""
    side = len(window)
    reach = side // 2
    level = np.float64(target[int(y), int(x)])
    s, tt, ut, vt, pt = 0.0, 0.0, 0.0, 0.0, 0.0
    for r in range(side):
        for c in range(side):
            px = x + A[0] * (c - reach) + A[1] * (r - reach)
            py = y + A[2] * (c - reach) + A[3] * (r - reach)
            column, row = int(px), int(py)
            a, b = px - column, py - row
            upper = target[row, column] + a * (target[row, column + 1] - target[row, column])
            lower = target[row + 1, column] + a * (target[row + 1, column + 1] - target[row + 1, column])
            t = upper + b * (lower - upper) - level
            wt = window[r, c] * t
            s, tt = s + wt, tt + wt * t
            ut, vt, pt = ut + weighted[r, c, 0] * t, vt + weighted[r, c, 1] * t, pt + weighted[r, c, 2] * t
    mean = s / total
    return tt - mean * s, ut - mean * mu, vt - mean * mv, pt
