"""Simulated rigs, seed after seed, calibrated and judged by the truth.

python tests/benchmarks/calibration_study.py --seeds 0-5 --frames 1 [--scenario knock] [--jobs 2]
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # a worker a core; before NumPy is imported
os.environ.setdefault("NUMBA_NUM_THREADS", "1")

import argparse
import multiprocessing
import sys
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from scipy import stats

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from calibration_scenarios import SCENARIOS
from calibration_trial import Consistency, Trial, run_trial

from rig_calib.settings import CalibrationSettings
from support.rendered_rig import rendered_rig
from support.scene_bound import SceneBound, scene_bound


@dataclass(frozen=True, slots=True)
class BoundedTrial:
    """A trial, and what no estimator can do better in its scene."""

    trial: Trial
    bound: SceneBound | None


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
        # a sum of scaled χ²: variances 2/dof add, the mean's is their mean over n
        dof = len(known) ** 2 / sum(1 / one.dof for one in known)
        low, high = stats.chi2.ppf((0.025, 0.975), dof) / dof
        return cls(float(np.mean([one.nees for one in known])), float(low), float(high))


def trials(
    scenario: str,
    seeds: Sequence[int],
    frames: int,
    jobs: int = 2,
    settings: CalibrationSettings | None = None,
    *,
    bounded: bool = False,
) -> Iterator[BoundedTrial]:
    """Trials in the order of the seeds, each as soon as it and those before it are done."""
    work = partial(_trial, scenario, frames, settings, bounded)
    if jobs == 1:
        yield from map(work, seeds)
        return
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"), _single_threaded) as pool:
        yield from pool.map(work, seeds)


def _single_threaded() -> None:
    cv2.setNumThreads(1)


def _trial(
    scenario: str, frames: int, settings: CalibrationSettings | None, bounded: bool, seed: int
) -> BoundedTrial:
    chosen = SCENARIOS[scenario]
    rig = rendered_rig(chosen.settings(seed), frames)
    with chosen.disturbed(seed):
        trial = run_trial(seed, rig.views, rig.ring, rig.truth, settings)
    return BoundedTrial(trial, scene_bound(rig) if bounded else None)


@dataclass(frozen=True, slots=True)
class Efficiency:
    """Bound over observed root mean square error of the neighbours' poses, over trials and edges.

    1: no estimator from the same measurements is better. `rmse` and `bound` are (degrees, millimetres).
    """

    rmse: tuple[float, float]
    bound: tuple[float, float]
    of_images: tuple[float, float]

    @classmethod
    def of(cls, done: Sequence[BoundedTrial]) -> "Efficiency | None":
        """Over trials that have all their edges and a bound."""
        known = [(one.trial, one.bound) for one in done if one.bound is not None and one.trial.edges]
        if not known:
            return None
        errors = [(error.deg, error.mm) for trial, _ in known for error in trial.edges.values()]
        least = [bound.neighbours[pair] for trial, bound in known for pair in trial.edges]
        of_images = [bound.of_images[pair] for trial, bound in known for pair in trial.edges]
        return cls(rms_of_each(errors), rms_of_each(least), rms_of_each(of_images))

    @property
    def deg(self) -> float:
        """Of rotations."""
        return self.bound[0] / self.rmse[0]

    @property
    def mm(self) -> float:
        """Of translations."""
        return self.bound[1] / self.rmse[1]


def rms_of_each(rows: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Root mean squares of both columns."""
    return rms(row[0] for row in rows), rms(row[1] for row in rows)


def rms(values: Iterable[float]) -> float:
    """Root of the mean of the squares."""
    return float(np.sqrt(np.mean(np.square(list(values)))))


def _line(one: BoundedTrial) -> str:
    trial = one.trial
    efficiency = Efficiency.of([one])
    shown = "          " if efficiency is None else f"{efficiency.deg:4.2f} {efficiency.mm:4.2f} "
    nees = "     " if trial.pairs_nees is None else f"{trial.pairs_nees.nees:5.2f}"
    cameras = "     " if trial.cameras_nees is None else f"{trial.cameras_nees.nees:5.2f}"
    worst = max(trial.edges.values(), key=lambda error: error.mm, default=None)
    return (
        f"{trial.seed:4d} {trial.deg:7.4f} {trial.mm:7.3f}  {0.0 if worst is None else worst.mm:7.2f} "
        f"{trial.absolute_mm:8.2f} {trial.nominal_mm:8.2f}  {nees} {cameras} {shown} {trial.matches:6d} "
        f"{trial.seconds['total']:6.2f}  {'; '.join(trial.failures)[:90]}"
    )


def report(bounded: Sequence[BoundedTrial]) -> str:
    """Means over the trials."""
    done = [one.trial for one in bounded]
    solved = [trial for trial in done if trial.edges]
    errors = [error for trial in solved for error in trial.edges.values()]
    opposite = [error for trial in solved for error in trial.opposite]
    lines = [
        f"mean edge {np.mean([e.deg for e in errors]):.4f}° {np.mean([e.mm for e in errors]):.3f} mm",
        f"RMSE edge {rms(e.deg for e in errors):.4f}° {rms(e.mm for e in errors):.3f} mm",
        f"opposite {np.mean([e.deg for e in opposite]):.4f}° {np.mean([e.mm for e in opposite]):.3f} mm",
    ]
    known = Efficiency.of(bounded)
    if known is not None:
        lines += [
            f"bound     {known.bound[0]:.4f}° {known.bound[1]:.3f} mm",
            f"efficiency {known.deg:.3f} {known.mm:.3f}",
            f"of images {known.of_images[0]:.4f}° {known.of_images[1]:.3f} mm",
        ]
    for name, each in (
        ("pairs", [trial.pairs_nees for trial in solved]),
        ("cameras", [trial.cameras_nees for trial in solved]),
    ):
        nees = Nees.of(each)
        if nees is not None:
            lines.append(f"NEES/dof {name} {nees.mean:.3f} (95 %: {nees.low:.3f} to {nees.high:.3f})")
    seconds = {key: np.mean([trial.seconds[key] for trial in done]) for key in done[0].seconds}
    lines.append("seconds " + ", ".join(f"{key} {value:.3f}" for key, value in seconds.items()))
    better = sum(trial.absolute_mm <= trial.nominal_mm for trial in done)
    lines.append(f"not worse than the drawing: {better} of {len(done)}")
    return "\n".join(lines)


def parse_seeds(text: str) -> list[int]:
    """`0-5,8` as numbers."""
    seeds: list[int] = []
    for part in text.split(","):
        first, _, last = part.partition("-")
        seeds += range(int(first), int(last or first) + 1)
    return seeds


def main() -> None:
    """Print a line a seed and the means."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=parse_seeds, default=[0, 1, 2, 3, 4, 5])
    parser.add_argument("--frames", type=int, default=1)
    parser.add_argument("--scenario", choices=list(SCENARIOS), default="reference")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--no-bound", action="store_true", help="leave the Cramér-Rao bound out")
    known = parser.parse_args()
    bounded = not known.no_bound and known.scenario == "reference"
    print(
        "seed     deg      mm  worst mm  abs mm  drawn mm  NEES  cams   efficiency  inliers seconds  failures"
    )
    done = []
    for one in trials(known.scenario, known.seeds, known.frames, known.jobs, bounded=bounded):
        done.append(one)
        print(_line(one), flush=True)
    print(report(done))


if __name__ == "__main__":
    main()
