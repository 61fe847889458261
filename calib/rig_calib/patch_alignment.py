"""Direct alignment of small image patches (Lucas & Kanade 1981; Baker & Matthews 2004).

A patch of one image is looked for in another, where a start and the local affine map say that it should
be. Gain and offset of the two exposures are free for every patch. What comes back is the place, and the
information on it, which is of rank one on an edge and nothing on a blank wall.
"""

from dataclasses import dataclass

import cv2
import numba
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
ImageF32 = npt.NDArray[np.float32]

RADIUS_PX = 7
_BLUR_PX = 0.8  # so that bilinear interpolation is exact enough, and the noise of the mosaic is less
_ITERATIONS = 12
_CONVERGED_PX = 0.01
_MIN_INSIDE = 0.999  # of a patch
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
        _align(source, target, source_pixels.astype(np.int64), affine, window, pixels, information, correlation)
    return AlignedPatches(pixels, information, correlation)


def _window(radius_px: int) -> Array:
    """Weights (2r+1, 2r+1): a Gaussian, so that the patch's rim does not decide."""
    steps = np.arange(-radius_px, radius_px + 1) / (0.6 * radius_px)
    return np.exp(-0.5 * (steps[:, None] ** 2 + steps[None, :] ** 2))


@numba.njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _align(source, target, at, affine, window, pixels, information, correlation):  # type: ignore[no-untyped-def]
    radius = window.shape[0] // 2
    side = window.shape[0]
    height, width = source.shape
    template = np.empty((side, side))
    by_u = np.empty((side, side))
    by_v = np.empty((side, side))
    seen = np.empty((side, side))
    total = window.sum()
    for k in range(len(at)):
        u, v = at[k, 0], at[k, 1]
        x, y = pixels[k, 0], pixels[k, 1]
        A = affine[k]
        determinant = A[0, 0] * A[1, 1] - A[0, 1] * A[1, 0]
        if not np.isfinite(x + y + determinant) or abs(determinant) < 1e-3:
            continue
        if u < radius + 1 or v < radius + 1 or u >= width - radius - 1 or v >= height - radius - 1:
            continue
        mean = 0.0
        for r in range(side):
            for c in range(side):
                template[r, c] = source[v + r - radius, u + c - radius]
                mean += window[r, c] * template[r, c]
        mean /= total
        power = 0.0
        h00 = h01 = h11 = 0.0
        m0 = m1 = t0 = t1 = 0.0
        for r in range(side):
            for c in range(side):
                row, column = v + r - radius, u + c - radius
                du = 0.5 * (source[row, column + 1] - source[row, column - 1])
                dv = 0.5 * (source[row + 1, column] - source[row - 1, column])
                # the gradient in the target's pixels: A^-T times the source's
                by_u[r, c] = (A[1, 1] * du - A[1, 0] * dv) / determinant
                by_v[r, c] = (-A[0, 1] * du + A[0, 0] * dv) / determinant
                template[r, c] -= mean
                w = window[r, c]
                power += w * template[r, c] ** 2
                m0 += w * by_u[r, c]
                m1 += w * by_v[r, c]
                t0 += w * by_u[r, c] * template[r, c]
                t1 += w * by_v[r, c] * template[r, c]
                h00 += w * by_u[r, c] ** 2
                h01 += w * by_u[r, c] * by_v[r, c]
                h11 += w * by_v[r, c] ** 2
        if power < total * 1.0:  # a blank patch: less than a level of contrast
            continue
        # Gain and offset are marginalised: project the gradients off (1, template).
        h00 -= m0 * m0 / total + t0 * t0 / power
        h01 -= m0 * m1 / total + t0 * t1 / power
        h11 -= m1 * m1 / total + t1 * t1 / power
        ridge = 1e-3 * (h00 + h11) + 1e-9
        d = (h00 + ridge) * (h11 + ridge) - h01 * h01
        found = False
        gain = 1.0
        residual = 0.0
        for _ in range(_ITERATIONS):
            inside = True
            mean = 0.0
            for r in range(side):
                for c in range(side):
                    dx, dy = c - radius, r - radius
                    px = x + A[0, 0] * dx + A[0, 1] * dy
                    py = y + A[1, 0] * dx + A[1, 1] * dy
                    if px < 0 or py < 0 or px >= width - 1 or py >= height - 1:
                        inside = False
                        break
                    i, j = int(px), int(py)
                    a, b = px - i, py - j
                    value = (1 - b) * ((1 - a) * target[j, i] + a * target[j, i + 1]) + b * (
                        (1 - a) * target[j + 1, i] + a * target[j + 1, i + 1]
                    )
                    seen[r, c] = value
                    mean += window[r, c] * value
                if not inside:
                    break
            if not inside:
                found = False
                break
            mean /= total
            cross = square = 0.0
            for r in range(side):
                for c in range(side):
                    seen[r, c] -= mean
                    cross += window[r, c] * seen[r, c] * template[r, c]
                    square += window[r, c] * seen[r, c] ** 2
            gain = cross / power
            correlation[k] = cross / np.sqrt(square * power + 1e-12)
            if gain <= 0.05:
                found = False
                break
            g0 = g1 = residual = 0.0
            for r in range(side):
                for c in range(side):
                    e = seen[r, c] / gain - template[r, c]
                    w = window[r, c]
                    g0 += w * by_u[r, c] * e
                    g1 += w * by_v[r, c] * e
                    residual += w * e * e
            found = True
            sx = -((h11 + ridge) * g0 - h01 * g1) / d
            sy = -((h00 + ridge) * g1 - h01 * g0) / d
            length = np.sqrt(sx * sx + sy * sy)
            if length > 1.0:
                sx, sy = sx / length, sy / length
            x += sx
            y += sy
            if length < _CONVERGED_PX:
                break
        if not found:
            correlation[k] = -1.0
            continue
        variance = max(residual / total, _MIN_SIGMA_LEVELS**2)
        scale = _INDEPENDENT_SHARE / variance
        pixels[k, 0], pixels[k, 1] = x, y
        noise = _NOISE_GRADIENT * residual
        information[k, 0, 0] = (h00 - noise) * scale
        information[k, 0, 1] = information[k, 1, 0] = h01 * scale
        information[k, 1, 1] = (h11 - noise) * scale
