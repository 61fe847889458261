"""What `rig-server budget` prints is what the server would do."""

import io
from typing import Any

import pytest
from rich.console import Console

from rig_server.budget_report import BudgetReport, Row, make_report, render
from rig_server.config import LinkSettings


def report(cameras: int = 12, fps: float = 30.0, **link: Any) -> BudgetReport:
    return make_report(LinkSettings(**link), cameras, fps)


def row(made: BudgetReport, word: str) -> Row:
    (found,) = (one for one in made.rows if word in one.name)
    return found


def printed(made: BudgetReport) -> str:
    page = io.StringIO()
    Console(width=80, file=page).print(render(made))
    return page.getvalue()


def test_the_table_holds_the_ceilings_of_the_design() -> None:
    made = report()
    assert row(made, "paper").ceiling_fps == pytest.approx(6.35, abs=0.01)
    assert row(made, "raw").ceiling_fps == pytest.approx(10.6, abs=0.05)
    assert 38 <= row(made, "lossless Bayer").ceiling_fps <= 52
    assert row(made, "JPEG").ceiling_fps >= 70
    assert [one.fits for one in made.rows] == [False, False, True, True]


def test_what_is_chosen_is_what_the_planner_answers() -> None:
    assert [one.chosen for one in report().rows] == [False, False, True, False]
    half = report(speed_mbit=500)
    assert [one.chosen for one in half.rows] == [False, False, False, True]
    assert half.chosen_fps == 30.0
    tenth = report(speed_mbit=100)
    assert row(tenth, "JPEG").chosen
    assert tenth.chosen_fps == 6.0


def test_when_nothing_fits_nothing_is_chosen_and_the_reason_is_given() -> None:
    made = report(speed_mbit=5)
    assert made.chosen_fps is None
    assert not any(one.chosen for one in made.rows)
    assert "nothing that the agents offer" in made.reason
    assert "use fewer cameras" in " ".join(printed(made).split())


@pytest.mark.parametrize("speed_mbit", [5, 100, 1000, 10_000])
def test_the_table_fits_eighty_columns_uncut(speed_mbit: float) -> None:
    text = printed(report(speed_mbit=speed_mbit))
    assert "…" not in text
    assert max(map(len, text.splitlines())) <= 80
    for one in report().rows:
        assert one.name in text


def test_pacing_is_told_with_its_worst_case_against_the_switch() -> None:
    assert "fits its 128 KiB" in " ".join(printed(report()).split())
    assert "slots must hold" in " ".join(printed(report(switch_buffer_kib=8)).split())
