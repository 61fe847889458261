"""Per-unit depth correction: how far a unit's metres are from true ones."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rig_protocol.errors import DataError

MODEL_NAME = "polynomial-scale"
MAX_TERMS = 6


@dataclass(frozen=True, slots=True)
class DepthCorrection:
    """z_true = z · (1 + Σ c_k b_k(x, y)), with b = (1, x, y, x², xy, y²) as far as there are coefficients.

    x = (u − cx)/fx and y = (v − cy)/fy of the pixel (u, v) that holds the
    depth, in the camera whose grid it is on.
    """

    coefficients: tuple[float, ...]

    def to_dict(self) -> dict[str, Any]:
        """The `depth_correction` object of `calibration.json`."""
        return {
            "model": MODEL_NAME,
            "equation": "z_true = z * (1 + sum c_k b_k(x, y)); b = 1, x, y, x^2, xy, y^2; "
            "x = (u - cx)/fx, y = (v - cy)/fy",
            "coefficients": list(self.coefficients),
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "DepthCorrection":
        """Read the `depth_correction` object; DataError for another model."""
        if values.get("model") != MODEL_NAME:
            raise DataError(f"depth correction model {values.get('model')!r} is not {MODEL_NAME!r}")
        coefficients = tuple(float(c) for c in values["coefficients"])
        if not 0 < len(coefficients) <= MAX_TERMS or not np.isfinite(coefficients).all():
            raise DataError(f"a depth correction has one to {MAX_TERMS} finite coefficients")
        return cls(coefficients)

    def factor(self, x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """What to multiply measured depth by, at normalised pixel coordinates x, y (any shape)."""
        terms = depth_basis(x, y, len(self.coefficients))
        return np.asarray(1.0 + terms @ np.array(self.coefficients))


def depth_basis(
    x: npt.NDArray[np.float64], y: npt.NDArray[np.float64], terms: int
) -> npt.NDArray[np.float64]:
    """The basis (..., terms) of the correction: 1, x, y, x², xy, y²."""
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y][:terms], axis=-1)
