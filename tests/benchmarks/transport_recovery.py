"""What loss costs: incomplete sets and added latency under loss, bursts, reordering and duplication.

The rig of twelve runs in virtual time (support/virtual_rig.py): real links, pacers and synchroniser, faults
on both directions of every path, an agent that gets to its mail 0.3 ms late on average. Nothing of this
machine is in the figures, and the same seeds give them again.

Run: python tests/benchmarks/transport_recovery.py
"""

import json
import os
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rig_protocol.testing import Faults
from support.virtual_rig import VirtualRig, latencies_ms

WARM_UP_SETS = 30
SHORT_S, LONG_S = 12.0, 42.0  # 0.1 % of sets shows in more than a thousand only
SEEDS = range(5 if os.environ.get("BENCH_FULL") else 1)


@dataclass(frozen=True, slots=True)
class Case:
    """A kind of fault, by the name that bench.json knows, and for how long to look."""

    name: str
    faults: Faults
    seconds: float = SHORT_S


CASES = (
    Case("loss 0 %", Faults()),
    Case("loss 0.1 %", Faults(drop=0.001)),
    Case("loss 1 %", Faults(drop=0.01), LONG_S),
    Case("loss 2 %", Faults(drop=0.02)),
    Case("loss 5 %", Faults(drop=0.05), LONG_S),
    Case("burst 5 ms", Faults(outage_ns=5_000_000)),
    Case("burst 20 ms", Faults(outage_ns=20_000_000)),
    Case("reorder 5 %", Faults(reorder=0.05)),
    Case("duplicate 1 %", Faults(duplicate=0.01)),
)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one run showed."""

    name: str
    latencies_ms: tuple[float, ...]
    incomplete: int
    counted: dict[str, int]


def observe(case: Case, seed: int) -> Outcome:
    """Run one case."""
    rig = VirtualRig(case.faults, seed).run(case.seconds)
    sets = rig.sets[WARM_UP_SETS:]
    incomplete = sum(one.missing > 0 for one in sets)
    return Outcome(case.name, tuple(latencies_ms(sets)), incomplete, rig.counted)


def summarise(outcomes: list[Outcome], undisturbed_p99_ms: float) -> dict[str, Any]:
    """One entry of the section `recovery`."""
    latencies = np.concatenate([outcome.latencies_ms for outcome in outcomes])
    counted = {
        name: sum(outcome.counted.get(name, 0) for outcome in outcomes)
        for name in ("fragments", "requested", "resent", "duplicate")
    }
    return {
        "fault": outcomes[0].name,
        "incomplete": sum(outcome.incomplete for outcome in outcomes) / latencies.size,
        "added_p99_ms": float(np.percentile(latencies, 99)) - undisturbed_p99_ms,
        "sets": int(latencies.size),
        "resent_share": counted["resent"] / counted["fragments"],
        "requested_share": counted["requested"] / counted["fragments"],
    }


def run(advance: Callable[[], None] = lambda: None) -> list[dict[str, Any]]:
    """The section `recovery` of bench.json; `advance` is called after each of its runs."""
    jobs = [(case, seed) for case in CASES for seed in SEEDS]
    outcomes: dict[str, list[Outcome]] = {case.name: [] for case in CASES}
    with ProcessPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        for outcome in pool.map(observe, *zip(*jobs, strict=True)):
            outcomes[outcome.name].append(outcome)
            advance()
    undisturbed = np.concatenate([one.latencies_ms for one in outcomes[CASES[0].name]])
    p99_ms = float(np.percentile(undisturbed, 99))
    return [summarise(outcomes[case.name], p99_ms) for case in CASES]


if __name__ == "__main__":
    print(json.dumps(run(), indent=1))
