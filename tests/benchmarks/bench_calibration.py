"""Everything that the calibration must show: `calibration` in build/bench.json, and docs/accuracy.md.

make bench-calibration, or: python tests/benchmarks/bench_calibration.py --only robustness
BENCH_FULL=1 takes all seeds.
"""

import calibration_study  # isort: skip  # sets threads before NumPy is imported

import argparse
import importlib
import importlib.util
import math
import os
import traceback
from collections.abc import Callable, Mapping
from typing import Any

import pytest
from calibration_summary import edge_errors, mean, summary
from rich.progress import Progress, SpinnerColumn, TimeElapsedColumn

from support.benchmark_record import REPOSITORY, merge_results, results_of, write_section

PAGE = REPOSITORY / "docs" / "accuracy.md"
FULL = bool(os.environ.get("BENCH_FULL"))
ALL = range(20)
REFERENCE_SEEDS = ALL if FULL else range(6)
TROUBLED_SEEDS = ALL if FULL else range(5)
TABLE_SEEDS = range(5) if FULL else range(2)


def _reference(frames: int) -> dict[str, Any]:
    return summary(list(calibration_study.trials("reference", REFERENCE_SEEDS, frames, bounded="always")))


def _robustness() -> Any:
    known = (results_of("calibration") or {}).get("one_frame", {})
    if "deg" in known:
        reference = known["deg"], known["mm"]
    else:
        done = calibration_study.trials("reference", TROUBLED_SEEDS, 1)
        reference = mean(edge_errors([one.trial for one in done]))
    return _module("calibration_robustness").run(reference, TROUBLED_SEEDS)


def _module(name: str) -> Any:
    """A module beside this one, or a skip where it is absent."""
    if importlib.util.find_spec(name) is None:
        pytest.skip(f"{name}.py is absent")
    return importlib.import_module(name)


SECTIONS: Mapping[str, Callable[[], Any]] = {
    "one_frame": lambda: _reference(1),
    "ten_frames": lambda: _reference(10),
    "time": lambda: _module("calibration_time").run(),
    "robustness": _robustness,
    "table_1": lambda: _module("calibration_table").run(TABLE_SEEDS),
    "rooms": lambda: _module("calibration_rooms").run(),
    "drift": lambda: _module("calibration_drift").run(FULL),
    "pose_graph": lambda: _module("calibration_pose_graph").run(),
    "pattern": lambda: _module("calibration_pattern").run(),
}


def measure(section: str) -> Any:
    """Run one section; what it cannot do here is its result."""
    try:
        return SECTIONS[section]()
    except pytest.skip.Exception as reason:
        return {"skipped": str(reason)}
    except (Exception, SystemExit) as reason:  # the other sections are still worth having
        traceback.print_exc()
        return {"skipped": f"it failed: {reason!r}"}


def record(section: str, figures: Any) -> None:
    """Put one section under `calibration`; the others stay. Seconds and peers stand at its top."""
    known = results_of("calibration") or {}
    if section == "time" and "skipped" not in figures:
        known |= {"seconds": figures["seconds"], "peers": figures["peers"]}
    merge_results({"calibration": known | {section: _plain(figures)}})


def _plain(value: Any) -> Any:
    """The same for JSON, which has no word for what is not a number."""
    if isinstance(value, Mapping):
        return {key: _plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def main() -> None:
    """Measure section by section; each is recorded at once, and the page is written at the end."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--only", choices=list(SECTIONS), action="append", help="may be repeated")
    parser.add_argument("--page", action="store_true", help="measure nothing, write the page anew")
    known = parser.parse_args()
    chosen = [] if known.page else known.only or list(SECTIONS)
    with Progress(SpinnerColumn(), *Progress.get_default_columns(), TimeElapsedColumn()) as progress:
        task = progress.add_task("calibration", total=len(chosen))
        for section in chosen:
            progress.update(task, description=f"calibration: {section}")
            record(section, measure(section))
            progress.advance(task)

    from calibration_page import page  # plotting is needed by none of the sections

    text = page(results_of("calibration") or {})
    write_section("calibration", text, PAGE)
    print(text)


if __name__ == "__main__":
    main()
