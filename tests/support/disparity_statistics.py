"""Second moments of a simulated unit's disparity: correlated noise, windows of it, and its distortion."""

from functools import cache

import numpy as np
import numpy.typing as npt
import scipy.ndimage

from rig_agent.simulator.kinect_noise import smooth_field
from rig_agent.simulator.settings import SimulatorSettings
from rig_protocol.camera import RawDepthModel

Array = npt.NDArray[np.float64]

WINDOW_HALVES_PX = (8, 5, 3)
"""Half widths of the windows in which a disparity is read, the widest that fits first."""

# The noise as noise_bank.py makes it: a box, and a Gaussian blur, whose autocorrelation is √2 as wide.
_BOX, _BOX_SHARE, _BLUR_SIGMA_PX = (9, 7), 0.6, 6.0
_REACH_PX = 64
_DECAY = 0.002926  # Herrera, Kannala & Heikkila 2012
_QUOTED_AT_M = 1.5
_UNIT_SPREAD = 0.2  # of the distortion's amplitude, natural logarithm
_FIELDS, _FIELD_SHAPE, _FIELD_SHARE = 1000, (48, 64), 0.9999


def window_covariance(offsets: Array, half_a: int, half_b: int) -> Array:
    """Covariance (...) of the means over two square windows of unit noise, `offsets` (...,2) px apart.

    A plane fitted to a whole window has the window's mean in its middle.
    """
    table = _window_table(max(half_a, half_b), min(half_a, half_b))
    columns, rows = np.moveaxis(np.clip(np.abs(offsets), 0, _REACH_PX - 1), -1, 0)
    return np.asarray(scipy.ndimage.map_coordinates(table, [rows, columns], order=1))


@cache
def _window_table(half_a: int, half_b: int) -> Array:
    """`window_covariance` at whole offsets 0 to _REACH_PX."""
    lag = np.arange(-2 * _REACH_PX, 2 * _REACH_PX + 1)
    box = [np.maximum(width - np.abs(lag), 0) / width for width in _BOX]
    blur = np.exp(-(lag**2) / (4 * _BLUR_SIGMA_PX**2))
    means = [
        _twice_averaged(axis, half_a, half_b) for axis in (*box, blur)
    ]  # both kinds of noise are products of a column's and a row's part
    columns, rows, wide = (mean[2 * _REACH_PX : 3 * _REACH_PX] for mean in means)
    return np.asarray(_BOX_SHARE * np.outer(rows, columns) + (1 - _BOX_SHARE) * np.outer(wide, wide))


def _twice_averaged(correlation: Array, half_a: int, half_b: int) -> Array:
    for half in (half_a, half_b):
        width = 2 * half + 1
        correlation = np.convolve(correlation, np.full(width, 1 / width), mode="same")
    return correlation


def distortion_amplitude_lsb(settings: SimulatorSettings, model: RawDepthModel, disparity: Array) -> Array:
    """Root of the mean square, over units, of the distortion's peak to peak at these disparities, LSB."""
    quoted_lsb = settings.depth_distortion_mm / 1000 * model.numerator_m / _QUOTED_AT_M**2
    quoted_at = model.offset - model.numerator_m / _QUOTED_AT_M
    return np.asarray(quoted_lsb * np.exp(_UNIT_SPREAD**2) * np.exp(-_DECAY * (disparity - quoted_at)))


def distortion_modes(pixels: Array, shape: tuple[int, int]) -> Array:
    """Principal fields (N,K) of `smooth_field` (peak to peak 1) at pixels (N,2) of an image of `shape`.

    With unit normal coefficients their sum has the covariance of such fields.
    """
    modes = _principal_fields()
    scale = (np.array(_FIELD_SHAPE) / shape)[::-1]
    columns, rows = ((pixels + 0.5) * scale - 0.5).T
    sampled = [scipy.ndimage.map_coordinates(mode, [rows, columns], mode="nearest") for mode in modes]
    return np.asarray(np.stack(sampled, axis=1), dtype=np.float64)


@cache
def _principal_fields() -> npt.NDArray[np.float32]:
    """(K,rows,columns): principal components of many fields, each times its standard deviation."""
    rng = np.random.default_rng(0)
    fields = np.stack([smooth_field(rng, _FIELD_SHAPE).ravel() for _ in range(_FIELDS)])
    covariance = fields @ fields.T / _FIELDS
    values, vectors = np.linalg.eigh(covariance)
    kept = np.cumsum(values[::-1]) < _FIELD_SHARE * values.sum()
    count = int(kept.sum()) + 1
    components = vectors[:, ::-1][:, :count].T @ fields / np.sqrt(_FIELDS)
    return np.asarray(components.reshape(count, *_FIELD_SHAPE), dtype=np.float32)
