"""Several trials together: errors, efficiency and consistency."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from calibration_trial import Consistency, Pair, Trial
from scipy import stats

from support.scene_bound import SceneBound

Both = tuple[float, float]
"""Degrees and millimetres."""


@dataclass(frozen=True, slots=True)
class BoundedTrial:
    """A trial, and what no estimator can do better in its scene, or with the points that it followed."""

    trial: Trial
    bound: SceneBound | None
    of_tracks: Mapping[Pair, Both] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Nees:
    """Mean normalised error squared over trials, and the 95 % interval in which it should lie."""

    mean: float
    low: float
    high: float

    @classmethod
    def of(cls, each: Iterable[Consistency | None]) -> "Nees | None":
        """Over trials, which are independent."""
        known = [one for one in each if one is not None]
        if not known:
            return None
        # Sums of scaled χ²: variances 2/dof add, and the mean's is their mean over n.
        dof = len(known) ** 2 / sum(1 / one.dof for one in known)
        low, high = stats.chi2.ppf((0.025, 0.975), dof) / dof
        return cls(float(np.mean([one.nees for one in known])), float(low), float(high))


@dataclass(frozen=True, slots=True)
class Efficiency:
    """Bound over observed root mean square error of the neighbours' poses, over trials and edges.

    1: no estimator from the same measurements is better.
    """

    rmse: Both
    bound: Both
    of_tracks: Both
    of_images: Both

    @classmethod
    def of(cls, done: Sequence[BoundedTrial]) -> "Efficiency | None":
        """Over trials that have all their edges and a bound."""
        known = [(one, one.bound) for one in done if one.bound is not None and one.of_tracks]
        if not known:
            return None
        return cls(
            rmse=rms(edge_errors([one.trial for one, _ in known])),
            bound=rms([bound.neighbours[pair] for one, bound in known for pair in one.trial.edges]),
            of_tracks=rms([one.of_tracks[pair] for one, _ in known for pair in one.trial.edges]),
            of_images=rms([bound.of_images[pair] for one, bound in known for pair in one.trial.edges]),
        )

    @property
    def deg(self) -> float:
        """Of rotations."""
        return self.bound[0] / self.rmse[0]

    @property
    def mm(self) -> float:
        """Of translations."""
        return self.bound[1] / self.rmse[1]


def rms(rows: Sequence[Both]) -> Both:
    """Root mean squares of both columns."""
    deg, mm = np.sqrt(np.mean(np.square(rows), axis=0))
    return float(deg), float(mm)


def mean(rows: Sequence[Both]) -> Both:
    """Means of both columns."""
    deg, mm = np.mean(rows, axis=0)
    return float(deg), float(mm)


def edge_errors(trials: Sequence[Trial]) -> list[Both]:
    """Errors of all neighbours of all trials."""
    return [(error.deg, error.mm) for trial in trials for error in trial.edges.values()]


def opposite_errors(trials: Sequence[Trial]) -> list[Both]:
    """Errors of all cameras against those half a ring away."""
    return [(error.deg, error.mm) for trial in trials for error in trial.opposite]


def summary(done: Sequence[BoundedTrial]) -> dict[str, Any]:
    """The figures of a study, for bench.json. `efficiency` is the lesser of rotation's and translation's."""
    trials = [one.trial for one in done if one.trial.edges]
    deg, mm = mean(edge_errors(trials))
    opposite_deg, opposite_mm = mean(opposite_errors(trials))
    out: dict[str, Any] = {
        "seeds": len(done),
        "deg": deg,
        "mm": mm,
        "opposite_deg": opposite_deg,
        "opposite_mm": opposite_mm,
        "opposite_ratio": max(opposite_deg / deg, opposite_mm / mm),
        "not_worse_than_drawing": not_worse_than_drawing([one.trial for one in done]),
        "seconds": float(np.median([trial.seconds["total"] for trial in trials])),
        "refused": sum(bool(one.trial.failures) for one in done),
        "each": [_of_one(one) for one in done],
    }
    out |= _consistency(trials) | _efficiency(done)
    return out


def _consistency(trials: Sequence[Trial]) -> dict[str, Any]:
    pairs = Nees.of(trial.pairs_nees for trial in trials)
    cameras = Nees.of(trial.cameras_nees for trial in trials)
    if pairs is None or cameras is None:
        return {}
    return {
        "nees": pairs.mean,
        "nees_low": pairs.low,
        "nees_high": pairs.high,
        "nees_cameras": cameras.mean,
        "nees_cameras_low": cameras.low,
        "nees_cameras_high": cameras.high,
    }


def _efficiency(done: Sequence[BoundedTrial]) -> dict[str, Any]:
    known = Efficiency.of(done)
    if known is None:
        return {}
    bounds = [one.bound for one in done if one.bound is not None]
    return {
        "efficiency": min(known.deg, known.mm),
        "efficiency_deg": known.deg,
        "efficiency_mm": known.mm,
        "rmse_deg": known.rmse[0],
        "rmse_mm": known.rmse[1],
        "bound_deg": known.bound[0],
        "bound_mm": known.bound[1],
        "bound_of_tracks_deg": known.of_tracks[0],
        "bound_of_tracks_mm": known.of_tracks[1],
        "bound_of_images_deg": known.of_images[0],
        "bound_of_images_mm": known.of_images[1],
        "keypoint_sigma_px": float(np.mean([bound.keypoint_sigma_px for bound in bounds])),
        "true_matches_an_edge": float(np.mean([n for bound in bounds for n in bound.matches.values()])),
    }


def _of_one(one: BoundedTrial) -> dict[str, Any]:
    trial = one.trial
    out: dict[str, Any] = {
        "seed": trial.seed,
        "deg": trial.deg,
        "mm": trial.mm,
        "absolute_mm": trial.absolute_mm,
        "nominal_mm": trial.nominal_mm,
        "nees": None if trial.pairs_nees is None else trial.pairs_nees.nees,
    }
    if one.bound is not None and trial.edges:
        out["bound_deg"], out["bound_mm"] = rms([one.bound.neighbours[pair] for pair in trial.edges])
        out["rmse_deg"], out["rmse_mm"] = rms(edge_errors([trial]))
    return out


def not_worse_than_drawing(trials: Sequence[Trial]) -> float:
    """Share of trials whose mean absolute error, rigs aligned, is at most that of the nominal drawing.

    Of the cameras that were placed; a trial that places none claims nothing.
    """
    placed = [trial for trial in trials if np.isfinite(trial.absolute_mm)]
    return float(np.mean([trial.absolute_mm <= trial.nominal_mm for trial in placed])) if placed else np.nan
