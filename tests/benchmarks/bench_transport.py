"""Everything that the transport must show: build/bench.json, and Transport in docs/performance.md.

make bench-transport, or: python tests/benchmarks/bench_transport.py --only rig
"""

import argparse
import importlib.util
import json
import sys
import traceback
from pathlib import Path
from typing import Any

from rich.progress import Progress, SpinnerColumn, TimeElapsedColumn

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from support.benchmark_record import RESULTS, merge_results, write_section

# Section of bench.json → the module beside this one whose `run` measures it.
SECTIONS = {
    "rig": "transport_rig",
    "floor": "transport_floor",
    "peers": "transport_peers",
    "recovery": "transport_recovery",
    "switch": "transport_switch",
    "chaos": "transport_chaos",
    "clock": "bench_clock",
}


def available(section: str) -> bool:
    """Whether the module of a section is here."""
    return importlib.util.find_spec(SECTIONS[section]) is not None


def measure(section: str) -> Any:
    """Run one section; what it cannot do here is its result."""
    import pytest

    try:
        return importlib.import_module(SECTIONS[section]).run()
    except pytest.skip.Exception as reason:
        return {"skipped": str(reason)}
    except (Exception, SystemExit) as reason:  # the other sections are still worth having
        traceback.print_exc()
        return {"skipped": f"it failed: {reason!r}"}


def main() -> None:
    """Measure section by section; each is recorded at once, and the page is written at the end."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--only", choices=list(SECTIONS), action="append", help="may be repeated")
    parser.add_argument("--page", action="store_true", help="measure nothing, write the page anew")
    known = parser.parse_args()
    chosen = [] if known.page else [one for one in known.only or SECTIONS if available(one)]
    with Progress(SpinnerColumn(), *Progress.get_default_columns(), TimeElapsedColumn()) as progress:
        task = progress.add_task("transport", total=len(chosen))
        for section in chosen:
            progress.update(task, description=f"transport: {section}")
            merge_results({section: measure(section)})
            progress.advance(task)

    from transport_page import page  # plotting is needed by none of the sections

    text = page(json.loads(RESULTS.read_text()))
    write_section("transport", text)
    print(text)


if __name__ == "__main__":
    main()
