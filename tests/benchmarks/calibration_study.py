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
) -> Iterator[Trial]:
    """Trials in the order of the seeds, each as soon as it and those before it are done."""
    work = partial(_trial, scenario, frames, settings)
    if jobs == 1:
        yield from map(work, seeds)
        return
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"), _single_threaded) as pool:
        yield from pool.map(work, seeds)


def _single_threaded() -> None:
    cv2.setNumThreads(1)


def _trial(scenario: str, frames: int, settings: CalibrationSettings | None, seed: int) -> Trial:
    chosen = SCENARIOS[scenario]
    rig = rendered_rig(chosen.settings(seed), frames)
    with chosen.disturbed(seed):
        return run_trial(seed, rig.views, rig.ring, rig.truth, settings)


def rms(values: Iterable[float]) -> float:
    """Root of the mean of the squares."""
    return float(np.sqrt(np.mean(np.square(list(values)))))


def _line(trial: Trial) -> str:
    nees = "     " if trial.pairs_nees is None else f"{trial.pairs_nees.nees:5.2f}"
    cameras = "     " if trial.cameras_nees is None else f"{trial.cameras_nees.nees:5.2f}"
    worst = max(trial.edges.values(), key=lambda error: error.mm, default=None)
    return (
        f"{trial.seed:4d} {trial.deg:7.4f} {trial.mm:7.3f}  {0.0 if worst is None else worst.mm:7.2f} "
        f"{trial.absolute_mm:8.2f} {trial.nominal_mm:8.2f}  {nees} {cameras} {trial.matches:6d} "
        f"{trial.seconds['total']:6.2f}  {'; '.join(trial.failures)[:90]}"
    )


def report(done: Sequence[Trial]) -> str:
    """Means over the trials."""
    solved = [trial for trial in done if trial.edges]
    errors = [error for trial in solved for error in trial.edges.values()]
    opposite = [error for trial in solved for error in trial.opposite]
    lines = [
        f"mean edge {np.mean([e.deg for e in errors]):.4f}° {np.mean([e.mm for e in errors]):.3f} mm",
        f"RMSE edge {rms(e.deg for e in errors):.4f}° {rms(e.mm for e in errors):.3f} mm",
        f"opposite {np.mean([e.deg for e in opposite]):.4f}° {np.mean([e.mm for e in opposite]):.3f} mm",
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
    known = parser.parse_args()
    print("seed     deg      mm  worst mm  abs mm  drawn mm  NEES  cams  inliers  seconds  failures")
    done = []
    for trial in trials(known.scenario, known.seeds, known.frames, known.jobs):
        done.append(trial)
        print(_line(trial), flush=True)
    print(report(done))


if __name__ == "__main__":
    main()
