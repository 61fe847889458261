"""Unit noise for every frame at the price of a copy: random windows of one large field."""

import cv2
import numpy as np
import numpy.typing as npt

Field = npt.NDArray[np.float32]

_MARGIN = (240, 320)  # rows and columns by which windows can move

_WINDOW = (9, 7)  # columns and rows of the Kinect's correlation window
# Shares of the variance: the window itself, and a wider part that measured autocorrelations show
# beyond it (0.1-0.3 at 8-12 px).
_WINDOW_SHARE, _WIDE_SIGMA_PX = 0.6, 6.0
_BORDER = 24  # smoothing mirrors at the border: cut off what it touched


class NoiseBank:
    """A field of unit noise, white or correlated as a Kinect's disparity is, cut into windows of `shape`.

    Two windows at random offsets and with random signs are summed, so that no two frames share what
    could be seen as structure.
    """

    def __init__(self, rng: np.random.Generator, shape: tuple[int, int], *, correlated: bool) -> None:
        """Make the field."""
        self._shape = shape
        size = (shape[0] + _MARGIN[0], shape[1] + _MARGIN[1])
        self._field = correlated_noise(rng, size) if correlated else white_noise(rng, size)

    def draw(self, rng: np.random.Generator) -> Field:
        """Noise of one frame: `shape`, f32, unit variance."""
        signs = rng.choice((-1.0, 1.0), 2) * np.sqrt(0.5)
        return np.asarray(cv2.addWeighted(self._window(rng), signs[0], self._window(rng), signs[1], 0))

    def _window(self, rng: np.random.Generator) -> Field:
        row, column = (int(rng.integers(margin + 1)) for margin in _MARGIN)
        return self._field[row : row + self._shape[0], column : column + self._shape[1]]


def white_noise(rng: np.random.Generator, shape: tuple[int, int]) -> Field:
    """Independent unit normals, f32."""
    return rng.standard_normal(shape, dtype=np.float32)


def correlated_noise(rng: np.random.Generator, shape: tuple[int, int]) -> Field:
    """Unit-variance noise correlated as block matching leaves it, f32."""
    size = (shape[0] + 2 * _BORDER, shape[1] + 2 * _BORDER)
    window = cv2.blur(white_noise(rng, size), _WINDOW)
    wide = cv2.GaussianBlur(white_noise(rng, size), (0, 0), _WIDE_SIGMA_PX)
    shares = (np.sqrt(_WINDOW_SHARE) / window.std(), np.sqrt(1 - _WINDOW_SHARE) / wide.std())
    mixed = cv2.addWeighted(window, float(shares[0]), wide, float(shares[1]), 0)
    return np.ascontiguousarray(mixed[_BORDER:-_BORDER, _BORDER:-_BORDER], dtype=np.float32)
