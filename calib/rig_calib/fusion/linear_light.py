"""Linear light of the values that cameras give."""

import numpy as np
import numpy.typing as npt


def _undone() -> npt.NDArray[np.float64]:
    value = np.arange(256) / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


LINEAR_LIGHT = _undone()
"""(256,) 0 to 1: sRGB's curve (IEC 61966-2-1) undone."""
