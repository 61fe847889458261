"""Table I of the paper on the simulated ring: the threshold on descriptor distances from 1.5 to 10.

python tests/benchmarks/calibration_table.py [--seeds 0-1]
"""

from calibration_study import in_processes, parse_seeds  # isort: skip  # sets threads before NumPy is imported

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from calibration_scenarios import SCENARIOS

from rig_calib.calibration import calibrate
from rig_calib.evaluation import PoseError, evaluate
from rig_calib.settings import CalibrationSettings
from rig_protocol.poses import inverse
from support.rendered_rig import RenderedRig, rendered_rig

MULTIPLES = (1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0)

# As printed: correspondences, degrees and centimetres before and after the loop is closed.
PAPER = {
    "correspondences": (14, 56, 218, 373, 477, 568, 615, 631, 642, 651),
    "initial_deg": (2.07, 1.48, 1.40, 1.48, 1.51, 1.53, 1.51, 1.52, 1.52, 1.52),
    "optimised_deg": (1.96, 0.89, 0.76, 0.62, 0.61, 0.56, 0.56, 0.56, 0.56, 0.56),
    "initial_cm": (9.25, 2.73, 1.86, 2.07, 2.07, 1.81, 1.80, 1.81, 1.80, 1.81),
    "optimised_cm": (4.94, 2.78, 1.88, 1.84, 1.77, 1.83, 1.83, 1.81, 1.82, 1.80),
}


@dataclass(frozen=True, slots=True)
class _Column:
    """One seed at one threshold; errors are means over the neighbours that have a pose."""

    correspondences: float
    initial: PoseError | None
    optimised: PoseError | None
    edges: int


def run(seeds: Sequence[int]) -> dict[str, Any]:
    """Means over seeds, as lists by MULTIPLES, and `joint` on the same frames."""
    each = list(in_processes(_sweep, seeds))
    joint = [sweep[-1] for sweep in each]
    columns = [[sweep[k] for sweep in each] for k in range(len(MULTIPLES))]
    return {
        "multiples": list(MULTIPLES),
        "seeds": len(seeds),
        **{key: [means[key] for means in map(_means, columns)] for key in _means(joint)},
        "joint": _means(joint),
        "paper": {key: list(values) for key, values in PAPER.items()},
    }


def _sweep(seed: int) -> list[_Column]:
    """Every threshold with `paper`, and `joint` last."""
    rig = rendered_rig(SCENARIOS["reference"].settings(seed), 1)
    settings = [CalibrationSettings(method="paper", match_distance_multiple=one) for one in MULTIPLES]
    return [_column(rig, one) for one in (*settings, CalibrationSettings())]


def _column(rig: RenderedRig, settings: CalibrationSettings) -> _Column:
    calibration = calibrate(rig.views, rig.ring, settings).calibration
    edges = [edge for edge in calibration.edges if edge.used]
    initial = [
        PoseError.between(edge.T_i_j, inverse(rig.truth[edge.i]) @ rig.truth[edge.j]) for edge in edges
    ]
    optimised: list[PoseError] = []
    if calibration.poses:
        found = evaluate(calibration, rig.truth)
        optimised = [found.pairs[pair] for pair in found.neighbours if pair in found.pairs]
    matches = [edge.matches for edge in calibration.edges]
    return _Column(float(np.mean(matches)), _mean(initial), _mean(optimised), len(edges))


def _mean(errors: Sequence[PoseError]) -> PoseError | None:
    if not errors:
        return None
    return PoseError(
        float(np.mean([error.deg for error in errors])), float(np.mean([error.mm for error in errors]))
    )


def _means(columns: Sequence[_Column]) -> dict[str, float]:
    out = {
        "correspondences": float(np.mean([one.correspondences for one in columns])),
        "edges": float(np.mean([one.edges for one in columns])),
    }
    for name in ("initial", "optimised"):
        errors = [error for error in (getattr(one, name) for one in columns) if error is not None]
        error = _mean(errors)
        out[f"{name}_deg"] = np.nan if error is None else error.deg
        out[f"{name}_cm"] = np.nan if error is None else error.mm / 10
    return out


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seeds", type=parse_seeds, default=[0, 1])
    print(json.dumps(run(parser.parse_args().seeds), indent=1))


if __name__ == "__main__":
    main()
