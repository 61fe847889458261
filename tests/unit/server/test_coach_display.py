"""The coach on a terminal and in a log."""

import io

import pytest
from rich.console import Console

from rig_calib.accuracy import Accuracy
from rig_calib.calibration import CalibrationResult
from rig_calib.coaching import PairSupport, Support
from rig_calib.rig_calibration import RigCalibration
from rig_server.calibration_task import Estimate
from rig_server.coach_display import CoachDisplay, coach_table

GOOD = PairSupport(0, 1, "cam00–cam01", 376, True, Accuracy(0.095, 3.4), Support.GOOD)
BARE = PairSupport(1, 2, "cam01–cam02", 6, False, Accuracy(0.36, 12.0), Support.NOTHING, "hang a pattern")


def estimate(sets: int = 2, missed: str | None = None) -> Estimate:
    result = CalibrationResult(RigCalibration("joint", "ring", (), (), None, {}, sets), (), {}, None)
    return Estimate(sets, result, [], (GOOD, BARE), missed)


def drawn(missed: str | None = None) -> str:
    console = Console(file=io.StringIO(), width=80)
    console.print(coach_table(estimate(missed=missed)))
    return console.file.getvalue()  # type: ignore[attr-defined,no-any-return]


def test_the_table_shows_every_overlap_and_what_to_do_within_80_columns() -> None:
    text = drawn(missed="cam01–cam02 limits")
    assert "on 2 sets: 1 of 2 overlaps good" in " ".join(text.split())
    assert "0.095" in text
    assert "nothing" in text
    assert "overlap cam01–cam02: 6 matches, ±0.36° ±12 mm: hang a pattern" in text
    assert "target: cam01–cam02 limits" in text
    assert max(map(len, text.splitlines())) <= 80


def test_a_bar_grows_with_the_matches() -> None:
    good, bare = (line for line in drawn().splitlines() if line.strip().startswith("cam0"))
    assert good.count("█") > 5 * max(bare.count("█"), 1)


@pytest.mark.parametrize(("last", "told"), [(False, 1), (True, 3)])
def test_a_log_gets_the_last_estimate_and_few_others(last: bool, told: int) -> None:
    console = Console(file=io.StringIO(), width=60)
    with CoachDisplay(console) as display:
        for sets in (1, 2, 4):  # at once: within the pause between lines
            display.show(estimate(sets), last)
    text: str = console.file.getvalue()  # type: ignore[attr-defined]
    assert text.count("1 of 2 overlaps good") == told
    assert text.count("overlap cam01–cam02: 6 matches, ±0.36° ±12 mm: hang a pattern\n") == told


def test_a_terminal_shows_what_any_part_tells() -> None:
    console = Console(file=io.StringIO(), width=80, force_terminal=True)
    with CoachDisplay(console) as display:
        display.connected(3, 12)
        display.collected(2, 5)
        display.begun(1, last=False)
        display.tell("matching", 0.4)
        display.show(estimate(), last=True)
    text: str = console.file.getvalue()  # type: ignore[attr-defined]
    for told in ("3/12 cameras", "2/5 complete sets", "on 1 set: matching", "hang a pattern"):
        assert told in text
