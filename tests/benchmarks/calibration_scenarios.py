"""What can be wrong with a rig or a room, one noun each: the reference scene and its troubled sisters."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any
from unittest.mock import patch

import numpy as np

from rig_agent.simulator.settings import SimulatorSettings
from rig_calib import calibration

WRONG_SHARE = 0.4


@dataclass(frozen=True, slots=True)
class Scenario:
    """Settings of the simulator beside the seed's, and what is done to the calibration meanwhile."""

    title: str
    changes: Callable[[int], Mapping[str, Any]] = field(default=lambda _seed: {})
    disturbed: Callable[[int], AbstractContextManager[None]] = field(default=lambda _seed: nullcontext())

    def settings(self, seed: int) -> SimulatorSettings:
        """The simulator's settings of one seed."""
        return SimulatorSettings(seed=seed, **self.changes(seed))


@contextmanager
def _wrong_matches(seed: int) -> Iterator[None]:
    """Of every pair's matches a share is replaced by random pairings, before anything looks at them."""
    match = calibration._match
    rng = np.random.default_rng([seed, 404])

    def spoilt(*arguments: Any) -> Any:
        rows = match(*arguments).copy()
        wrong = np.flatnonzero(rng.random(len(rows)) < WRONG_SHARE)
        if len(wrong) > 1:
            rows[wrong, 1] = np.roll(rows[rng.permutation(wrong), 1], 1)
        return rows

    with patch.object(calibration, "_match", spoilt):
        yield


SCENARIOS: Mapping[str, Scenario] = {
    "reference": Scenario("reference scene"),
    "screened": Scenario("one overlap blocked", lambda seed: {"screened_overlap": (5 * seed + 1) % 12}),
    "knock": Scenario(
        "one camera bumped by 4° and 3 cm", lambda seed: {"knock": {"camera": (5 * seed + 3) % 12}}
    ),
    "natural": Scenario("no patterns", lambda _: {"patterns": False}),
    "wrong": Scenario("40 % wrong matches", disturbed=_wrong_matches),
    "depthless": Scenario("a camera with no depth", lambda seed: {"depthless_camera": (7 * seed + 2) % 12}),
    "exposure": Scenario("exposure ±30 %", lambda _: {"exposure_spread": 0.3}),
}
