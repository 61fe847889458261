"""Residuals of an adjustment made comparable with the standard normal distribution."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rig_calib.rig_adjustment import AdjustedRig

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.intp]

_MIN_REDUNDANCY = 0.05  # below, a residual says nothing of its measurement


@dataclass(frozen=True, slots=True, eq=False)
class StandardisedResiduals:
    """Residuals (M,3) of an adjustment's observations over what the noise model expects of them.

    NaN where a measurement has nothing to be compared with. `camera` (M,) holds ids, `point` (M,) numbers.
    """

    values: Array
    camera: Index
    point: Index

    @classmethod
    def of(cls, rig: AdjustedRig) -> "StandardisedResiduals":
        """Whitened residuals over the square root of their redundancy (Baarda 1968).

        A point takes what its observations share: of one whose share of the point's weight is w/Σw, the
        residual keeps the part 1 − w/Σw of its variance. The cameras' own states are few beside the points.
        """
        seen = rig.scene.observations
        pixel = _redundancy(seen.point, seen.pixel_sigma)
        disparity = _redundancy(seen.point, seen.disparity_sigma)
        redundancy = np.column_stack([pixel, pixel, disparity])
        redundancy[~(redundancy > _MIN_REDUNDANCY)] = np.nan
        ids = np.array(rig.scene.cameras, dtype=np.intp)
        return cls(rig.adjustment.residuals / np.sqrt(redundancy), ids[seen.camera], seen.point)

    def of_pair(self, i: int, j: int) -> tuple[Array, Array]:
        """Of points that cameras i and j both see: pixel coordinates (2K,) and disparities (L,)."""
        by_i, by_j = self.camera == i, self.camera == j
        common = np.intersect1d(self.point[by_i], self.point[by_j])
        rows = (by_i | by_j) & np.isin(self.point, common)
        return _finite(self.values[rows, :2]), _finite(self.values[rows, 2])


def _redundancy(point: Index, sigma: Array) -> Array:
    """1 − w/Σw (M,) with the sum over a point's measurements; NaN where there is no measurement."""
    weight = np.where(np.isfinite(sigma), 1.0 / np.square(sigma), 0.0)
    total = np.bincount(point, weight)[point]
    return np.where(weight > 0.0, 1.0 - weight / np.where(total > 0.0, total, 1.0), np.nan)


def _finite(values: Array) -> Array:
    return np.asarray(values[np.isfinite(values)])
