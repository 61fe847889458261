"""Rigs and rooms in trouble: solved, refused with the reason, or silently wrong.

python tests/benchmarks/calibration_robustness.py [--seeds 0-4] [--only knock]
"""

from calibration_study import parse_seeds, trials  # isort: skip  # sets threads before NumPy is imported

import argparse
import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from calibration_scenarios import SCENARIOS
from calibration_summary import Both, BoundedTrial, edge_errors, mean, not_worse_than_drawing, rms
from scipy import stats

from support.scene_bound import SceneBound

_TIMES_REFERENCE = 3.0
# A scene whose own Cramér-Rao bound is below this many times the reference's mean error can be solved.
_SOLVABLE_TIMES_REFERENCE = 2.0
# A pair's normalised error squared over six beyond this is not covered by its covariance: once in 10,000.
_COVERED = float(stats.chi2.ppf(1 - 1e-4, 6)) / 6
OUTCOMES: Mapping[str, str] = {
    "solved": "solved",
    "refused": "refused honestly",
    "refused_solvable": "refused what can be solved",
    "refused_badly": "refused, σ or edges wrong",
    "wrong": "silently wrong",
    "crashed": "crashed",
}


def outcome(one: BoundedTrial, reference: Both) -> str:
    """Which of OUTCOMES a trial is; `reference` is the mean edge error of the untroubled scene."""
    trial = one.trial
    if trial.crashed:
        return "crashed"
    whole = bool(trial.edges) and not trial.missing
    close = whole and _within((trial.deg, trial.mm), reference, _TIMES_REFERENCE)
    if not trial.failures:
        return "solved" if close else "wrong"
    if close or (one.bound is not None and _solvable(one.bound, reference)):
        return "refused_solvable"
    names_edges = all(re.search(r"\d+–\d+|camera \d+", failure) for failure in trial.failures)
    covered = all(nees <= _COVERED for nees in trial.edge_nees.values())
    return "refused" if names_edges and covered else "refused_badly"


def _solvable(bound: SceneBound, reference: Both) -> bool:
    return _within(rms(list(bound.neighbours.values())), reference, _SOLVABLE_TIMES_REFERENCE)


def _within(error: Both, reference: Both, times: float) -> bool:
    return error[0] <= times * reference[0] and error[1] <= times * reference[1]


def run(reference: Both, seeds: Sequence[int], scenarios: Sequence[str] = ()) -> list[dict[str, Any]]:
    """One record a scenario: shares of seeds by outcome, errors, and against the drawing."""
    return [
        _record(name, list(trials(name, seeds, 1, bounded="refused")), reference)
        for name in scenarios or [name for name in SCENARIOS if name != "reference"]
    ]


def _record(name: str, bounded: Sequence[BoundedTrial], reference: Both) -> dict[str, Any]:
    outcomes = [outcome(one, reference) for one in bounded]
    done = [one.trial for one in bounded]
    errors = edge_errors(done)
    deg, mm = mean(errors) if errors else (np.nan, np.nan)
    return {
        "case": SCENARIOS[name].title,
        "seeds": len(done),
        "deg": deg,
        "mm": mm,
        **{key: outcomes.count(key) / len(done) for key in OUTCOMES},
        "not_worse_than_drawing": not_worse_than_drawing(done),
        "each": [
            {
                "seed": trial.seed,
                "outcome": what,
                "deg": trial.deg,
                "mm": trial.mm,
                "failures": list(trial.failures),
            }
            for trial, what in zip(done, outcomes, strict=True)
        ],
    }


def main() -> None:
    """Print the records, after the reference scene's errors on the same seeds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=parse_seeds, default=[0, 1, 2, 3, 4])
    parser.add_argument("--only", choices=list(SCENARIOS), action="append", default=[])
    known = parser.parse_args()
    reference = mean(edge_errors([one.trial for one in trials("reference", known.seeds, 1)]))
    print(f"reference {reference[0]:.4f}° {reference[1]:.3f} mm")
    for record in run(reference, known.seeds, known.only):
        print(json.dumps(record, indent=1, ensure_ascii=False))


if __name__ == "__main__":
    main()
