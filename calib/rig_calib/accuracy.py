"""How well a relative pose is expected to be known, and how well a user wants it to be known."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True, slots=True)
class Accuracy:
    """Expected error of a pose: root mean square of its angle (degrees) and of its distance (millimetres)."""

    deg: float
    mm: float

    @classmethod
    def of(cls, covariance: npt.NDArray[np.float64]) -> "Accuracy":
        """Of a pose with this covariance (6,6), rotation first: E|δ|² is the trace."""
        rotation, translation = np.trace(covariance[:3, :3]), np.trace(covariance[3:, 3:])
        return cls(float(np.rad2deg(np.sqrt(rotation))), float(1e3 * np.sqrt(translation)))

    def within(self, limit: "Accuracy") -> bool:
        """Whether both errors are at most those of the limit."""
        return self.deg <= limit.deg and self.mm <= limit.mm

    def __str__(self) -> str:
        """For people."""
        return f"{self.deg:.2f}° and {self.mm:.1f} mm"


@dataclass(frozen=True, slots=True)
class AccuracyTarget:
    """The largest expected errors that a user wants of every pair; None: any will do."""

    deg: float | None = None
    mm: float | None = None

    @property
    def limit(self) -> Accuracy:
        """The target as an accuracy."""
        return Accuracy(
            np.inf if self.deg is None else self.deg,
            np.inf if self.mm is None else self.mm,
        )

    def shortfall(self, expected: Iterable[tuple[str, Accuracy | None]]) -> str | None:
        """By how much the worst of the named pairs misses the target; None when all of them meet it."""
        known = []
        for name, accuracy in expected:
            if accuracy is None:
                return f"nobody can say how well {name} is known: the target needs a covariance"
            known.append((name, accuracy))
        if not known:
            return "no pair of cameras has support yet"
        told = [_miss(known, "deg", self.deg, "°", 3), _miss(known, "mm", self.mm, " mm", 1)]
        return " and ".join(text for text in told if text) or None


def _miss(
    known: list[tuple[str, Accuracy]], quantity: str, limit: float | None, unit: str, digits: int
) -> str | None:
    name, worst = max(known, key=lambda item: float(getattr(item[1], quantity)))
    value = float(getattr(worst, quantity))
    if limit is None or value <= limit:
        return None
    return (
        f"{name} limits: {value:.{digits}f}{unit} expected, {limit:g}{unit} wanted, "
        f"{value - limit:.{digits}f}{unit} too much"
    )
