"""How long twelve cameras take, images in memory, on two cores; and GTSAM on the same matches.

python tests/benchmarks/calibration_time.py [--runs 5] [--seed 0]
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

CORES = 2
_RUNS = 5


def run(runs: int = _RUNS) -> dict[str, Any]:
    """The figures, from a process of its own: this one may hold its libraries to one thread."""
    environment = {key: value for key, value in os.environ.items() if not key.endswith("_NUM_THREADS")}
    command = [sys.executable, __file__, "--runs", str(runs)]
    done = subprocess.run(command, env=environment, check=True, capture_output=True, text=True)
    figures: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return figures


def measure(runs: int, seed: int) -> dict[str, Any]:
    """Median seconds, in total and by stage, of `runs` calibrations after one that warms up."""
    import numpy as np

    from rig_agent.simulator.settings import SimulatorSettings
    from rig_calib.calibration import calibrate
    from rig_calib.settings import CalibrationSettings
    from support.rendered_rig import rendered_rig

    rig = rendered_rig(SimulatorSettings(seed=seed), 1)
    settings = CalibrationSettings()
    started_s = time.perf_counter()
    result = calibrate(rig.views, rig.ring, settings)
    first_s = time.perf_counter() - started_s
    totals, stages = [], []
    for _ in range(runs):
        started_s = time.perf_counter()
        result = calibrate(rig.views, rig.ring, settings)
        totals.append(time.perf_counter() - started_s)
        stages.append(result.calibration.seconds)
    by_stage = {name: float(np.median([one[name] for one in stages])) for name in stages[0]}
    return {
        "seconds": float(np.median(totals)),
        "first_s": first_s,
        "stages": by_stage,
        "cores": len(os.sched_getaffinity(0)),
        "peers": _peers(rig, result, by_stage["optimisation"]),
    }


def _peers(rig: Any, result: Any, optimisation_s: float) -> list[dict[str, Any]]:
    """Ours and GTSAM's adjustment of the same tracks."""
    from rig_calib.evaluation import evaluate

    def record(name: str, seconds: float, poses: Any, **more: float) -> dict[str, Any]:
        found = evaluate(poses, rig.truth)
        error = found.over(found.neighbours)
        if error is None:
            raise ValueError("no neighbours were placed")
        return {"name": name, "seconds": seconds, "deg": error.mean.deg, "mm": error.mean.mm, **more}

    ours = record("joint: depth bias and intrinsics estimated", optimisation_s, result.calibration.poses)
    try:
        from support.gtsam_peer import solve_with_gtsam
    except ImportError as reason:
        return [ours, {"name": "GTSAM", "skipped": str(reason)}]
    views = {view.camera_id: view for view in rig.views}
    plain = solve_with_gtsam(views, result.rig, rig.ring)
    given = solve_with_gtsam(views, result.rig, rig.ring, result.rig.corrections)
    return [
        ours,
        record("GTSAM: poses and points", plain.seconds, plain.poses, build_s=plain.build_seconds),
        record("GTSAM, depth corrected by joint", given.seconds, given.poses, build_s=given.build_seconds),
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the figures as one line of JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--runs", type=int, default=_RUNS)
    parser.add_argument("--seed", type=int, default=0)
    known = parser.parse_args(arguments)
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:CORES])
    print(json.dumps(measure(known.runs, known.seed)))


if __name__ == "__main__":
    main()
