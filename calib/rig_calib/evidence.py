"""EdgeEvidence: the matches that one edge rests on, kept for people who want to see them."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, slots=True, eq=False)
class EdgeEvidence:
    """Matches between the colour images of cameras i and j in one frame, and what became of them.

    `pixels_i`, `pixels_j`: (N,2) in the image as delivered (distorted, pixel centres at integers).
    `inlier`: (N,) bool, kept by the final estimate. `residual_px`: (N,) reprojection error of each match
    under the final poses, NaN where it has none (no depth). `frame` indexes `CameraView.color`.
    `pixel_errors` (K,), `disparity_errors` (L,): standardised residuals of the adjustment, empty without one.
    """

    i: int
    j: int
    pixels_i: npt.NDArray[np.float64]
    pixels_j: npt.NDArray[np.float64]
    inlier: npt.NDArray[np.bool_]
    residual_px: npt.NDArray[np.float64]
    frame: int = 0
    pixel_errors: npt.NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    disparity_errors: npt.NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
