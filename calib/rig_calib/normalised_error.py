"""Is a stated covariance true? Normalised errors squared (Bar-Shalom et al. 2001, ch. 5.4) of known poses."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy.stats

from rig_protocol.poses import Pose, inverse, se3_log

Array = npt.NDArray[np.float64]

_DOF = 6
_MAX_CONDITION = 1e14  # beyond, the covariance is that of a pose that defines the frame


def normalised_error(estimated: Pose, true: Pose, covariance: Array | None) -> float | None:
    """δᵀ C⁻¹ δ / 6 with T_true = T_estimated · Exp(δ): 1 on the mean when C is right.

    None without a covariance, or with one that has no inverse.
    """
    if covariance is None or not np.linalg.cond(covariance) < _MAX_CONDITION:
        return None
    delta = se3_log(inverse(estimated) @ true)
    return float(delta @ np.linalg.solve(covariance, delta)) / _DOF


@dataclass(frozen=True, slots=True)
class Consistency:
    """Mean normalised error squared per degree of freedom of several poses.

    Above 1 the covariances promise too much, below 1 too little. `low` to `high` hold 95 % of means of so
    many independent poses; poses of one rig share errors, and stray further.
    """

    count: int
    nees: float
    low: float
    high: float

    @classmethod
    def of(cls, errors: Iterable[float]) -> "Consistency | None":
        """The mean; None of nothing."""
        values = list(errors)
        if not values:
            return None
        dof = _DOF * len(values)
        low, high = (float(scipy.stats.chi2.ppf(share, dof)) / dof for share in (0.025, 0.975))
        return cls(len(values), float(np.mean(values)), low, high)

    def to_dict(self) -> dict[str, float]:
        """Flat numbers for JSON."""
        return {"count": self.count, "nees": self.nees, "low": self.low, "high": self.high}
