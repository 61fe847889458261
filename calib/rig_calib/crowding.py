"""How many measurements share a place in an image; compiled."""

import numpy as np
import numpy.typing as npt

from rig_protocol.compiled import compiled

Array = npt.NDArray[np.float64]

_REACH = 3.0  # lengths; what is further apart shares nothing


def crowding(pixels: Array, length_px: float) -> Array:
    """Σ exp(−r²/2L²) over all points (N,2) within 3 L, itself included: how many share a place (N,)."""
    by_row = np.argsort(pixels[:, 1], kind="stable")
    out = np.empty(len(pixels))
    out[by_row] = _crowding(np.ascontiguousarray(pixels[by_row]), length_px)
    return out


@compiled()
def _crowding(pixels: Array, length_px: float) -> Array:
    """The same of points that are sorted by their row."""
    reach = _REACH * length_px
    out = np.ones(len(pixels))
    for i in range(len(pixels)):
        for j in range(i + 1, len(pixels)):
            down = pixels[j, 1] - pixels[i, 1]
            if down > reach:
                break
            square = (pixels[j, 0] - pixels[i, 0]) ** 2 + down**2
            if square <= reach**2:
                shared = np.exp(-0.5 * square / length_px**2)
                out[i] += shared
                out[j] += shared
    return out
