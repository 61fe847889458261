"""Simulated rigs, seed after seed, calibrated and judged by the truth.

python tests/benchmarks/calibration_study.py --seeds 0-5 --frames 1 [--scenario knock] [--jobs 2]
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # a worker a core; before NumPy is imported
os.environ.setdefault("NUMBA_NUM_THREADS", "1")

import argparse
import multiprocessing
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import Literal, TypeVar

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from calibration_scenarios import SCENARIOS
from calibration_summary import BoundedTrial, Efficiency, summary
from calibration_trial import crash, judge

from rig_calib.calibration import calibrate
from rig_calib.settings import CalibrationSettings
from support.rendered_rig import rendered_rig
from support.scene_bound import scene_bound, track_bound

Bounded = Literal["always", "refused", "never"]
Item = TypeVar("Item")
Result = TypeVar("Result")


def trials(
    scenario: str,
    seeds: Sequence[int],
    frames: int,
    jobs: int = 2,
    settings: CalibrationSettings | None = None,
    *,
    bounded: Bounded = "never",
) -> Iterator[BoundedTrial]:
    """Trials in the order of the seeds, each as soon as it and those before it are done.

    `bounded`: which of them get their scene's bound, which takes ten seconds once.
    """
    yield from in_processes(partial(_trial, scenario, frames, settings, bounded), seeds, jobs)


def in_processes(work: Callable[[Item], Result], items: Sequence[Item], jobs: int = 2) -> Iterator[Result]:
    """Results in the order of the items, from single-threaded processes."""
    if jobs == 1:
        yield from map(work, items)
        return
    with ProcessPoolExecutor(jobs, multiprocessing.get_context("spawn"), _single_threaded) as pool:
        yield from pool.map(work, items)


def _single_threaded() -> None:
    cv2.setNumThreads(1)


def _trial(
    scenario: str, frames: int, settings: CalibrationSettings | None, bounded: Bounded, seed: int
) -> BoundedTrial:
    chosen = SCENARIOS[scenario]
    rig = rendered_rig(chosen.settings(seed), frames)
    try:
        with chosen.disturbed(seed):
            result = calibrate(rig.views, rig.ring, settings or CalibrationSettings())
    except Exception as error:
        return BoundedTrial(crash(seed, error), None)
    trial = judge(seed, result, rig.views, rig.truth)
    if bounded == "always" and result.rig is not None:
        return BoundedTrial(trial, scene_bound(rig), track_bound(rig, result.rig.scene))
    refused = bounded == "refused" and bool(trial.failures)
    return BoundedTrial(trial, scene_bound(rig) if refused else None)


def _line(one: BoundedTrial) -> str:
    trial = one.trial
    known = Efficiency.of([one])
    efficiency = " " * 9 if known is None else f"{known.deg:4.2f} {known.mm:4.2f}"
    nees = "     " if trial.pairs_nees is None else f"{trial.pairs_nees.nees:5.2f}"
    cameras = "     " if trial.cameras_nees is None else f"{trial.cameras_nees.nees:5.2f}"
    worst = max((error.mm for error in trial.edges.values()), default=np.nan)
    return (
        f"{trial.seed:4d} {trial.deg:7.4f} {trial.mm:7.3f} {worst:9.2f} "
        f"{trial.absolute_mm:7.2f} {trial.nominal_mm:9.2f} {nees} {cameras}  {efficiency} {trial.matches:8d} "
        f"{trial.seconds['total']:8.3f}  {'; '.join(trial.failures)[:90]}"
    )


def report(done: Sequence[BoundedTrial]) -> str:
    """Means over the trials."""
    figures = summary(done)
    lines = [
        f"mean edge  {figures['deg']:.4f}° {figures['mm']:.3f} mm",
        f"opposite   {figures['opposite_deg']:.4f}° {figures['opposite_mm']:.3f} mm",
    ]
    if "efficiency" in figures:
        lines += [
            f"RMSE edge  {figures['rmse_deg']:.4f}° {figures['rmse_mm']:.3f} mm",
            f"bound      {figures['bound_deg']:.4f}° {figures['bound_mm']:.3f} mm",
            f"of tracks  {figures['bound_of_tracks_deg']:.4f}° {figures['bound_of_tracks_mm']:.3f} mm",
            f"of images  {figures['bound_of_images_deg']:.4f}° {figures['bound_of_images_mm']:.3f} mm",
            f"efficiency {figures['efficiency_deg']:.3f} {figures['efficiency_mm']:.3f}",
        ]
    for name, key in (("pairs", "nees"), ("cameras", "nees_cameras")):
        if key in figures:
            low, high = figures[f"{key}_low"], figures[f"{key}_high"]
            lines.append(f"NEES/dof   {figures[key]:.3f} {name} (95 %: {low:.3f} to {high:.3f})")
    whole = [one.trial for one in done if not one.trial.crashed]
    seconds = {stage: np.mean([trial.seconds[stage] for trial in whole]) for stage in whole[0].seconds}
    lines.append("seconds " + ", ".join(f"{stage} {value:.3f}" for stage, value in seconds.items()))
    lines.append(f"not worse than the drawing: {100 * figures['not_worse_than_drawing']:.0f} %")
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
    parser.add_argument(
        "--set", metavar="NAME=VALUE", action="append", default=[], help="a setting of the calibration"
    )
    known = parser.parse_args()
    settings = CalibrationSettings.model_validate(dict(one.split("=", 1) for one in known.set))
    bounded: Bounded = "never" if known.no_bound or known.scenario != "reference" else "always"
    print(
        "seed     deg      mm  worst mm  abs mm  drawn mm  NEES  cams  efficiency  inliers  seconds  failures"
    )
    done = []
    for one in trials(known.scenario, known.seeds, known.frames, known.jobs, settings, bounded=bounded):
        done.append(one)
        print(_line(one), flush=True)
    print(report(done))


if __name__ == "__main__":
    main()
