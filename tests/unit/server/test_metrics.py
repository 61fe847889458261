"""Rates, sets and the live table that shows them."""

import io

from rich.console import Console

from rig_server.assembler import SetRecord
from rig_server.live_table import LiveDisplay, status_line, status_table
from rig_server.metrics import CameraMetrics, RateMeter, RigStatus, summarise_sets
from rig_server.synchroniser import IncompleteSet

S = 1_000_000_000


def busy_status(temperature_c: float | None = 61.0) -> RigStatus:
    cameras = [
        CameraMetrics(
            i,
            f"long-name-{i:02d}",
            connected=i != 5,
            fps=29.97,
            frames=107_000,
            lost=107,
            late=12_345,
            damaged=1_234,
            duplicate=12_345,
            corrupt=1_234,
            clock_error_us=1_234.5,
            temperature_c=temperature_c,
        )
        for i in range(12)
    ]
    return RigStatus(
        tuple(cameras), 12_345, 67, 29.97, 26.1, often_missing=(5,), dropped={"sets not taken": 0, "x": 3}
    )


def rendered(status: RigStatus) -> list[str]:
    console = Console(file=io.StringIO(), width=80, force_terminal=False)
    console.print(status_table(status, "rig-server"))
    return console.file.getvalue().splitlines()  # type: ignore[attr-defined]


def test_a_rate_is_frames_over_the_last_seconds() -> None:
    meter = RateMeter()
    assert meter.update({0: 100}, 0) == {0: 0.0}
    assert meter.update({0: 130, 1: 7}, 1 * S) == {0: 30.0, 1: 0.0}
    for second in range(2, 10):
        rates = meter.update({0: 100 + 30 * second, 1: 7 + 15 * (second - 1)}, second * S)
    assert rates == {0: 30.0, 1: 15.0}


def test_loss_is_the_share_of_frames_that_did_not_arrive_whole() -> None:
    assert CameraMetrics(0, "a", True, frames=99, lost=1).loss == 0.01
    assert CameraMetrics(0, "a", True).loss == 0.0


def test_sets_are_summarised_over_the_last_three_seconds() -> None:
    old = [SetRecord(0, 99_000_000, (7,))] * 30
    new = [SetRecord(10 * S + k * S // 10, 26_000_000, (3,) if k % 5 == 0 else ()) for k in range(21)]
    rate, spread_ms, missing = summarise_sets([*old, *new], 12 * S)
    assert rate == 10.0
    assert spread_ms == 26.0
    assert missing == (3,)
    assert summarise_sets(old, 12 * S) == (0.0, None, ())


def test_cameras_that_incomplete_sets_lacked_are_named_though_no_set_went_out() -> None:
    incomplete = [IncompleteSet(0, (7,)), *(IncompleteSet(11 * S, (3, 5)) for _ in range(9))]
    incomplete += [IncompleteSet(11 * S, (3, 4))] * 3
    assert summarise_sets([], 12 * S, incomplete) == (0.0, None, (3, 5, 4))


def test_the_table_fits_80_columns_with_every_figure_at_full_length() -> None:
    lines = rendered(busy_status())
    text = "\n".join(lines)
    assert all(len(line) <= 80 for line in lines)
    assert "…" not in text
    assert "away" in text
    assert "often missing: long-name-05" in text
    assert "dropped: x 3" in text


def test_temperature_has_a_column_only_when_somebody_reports_it() -> None:
    assert any("°C" in line for line in rendered(busy_status()))
    assert not any("°C" in line for line in rendered(busy_status(temperature_c=None)))


def test_without_cameras_the_table_says_that_it_waits() -> None:
    assert any("waiting for cameras" in line for line in rendered(RigStatus(())))


def test_one_line_tells_who_is_away_and_who_loses_most() -> None:
    line = status_line(busy_status())
    assert line.startswith("11/12 cameras; 30.0 sets/s, spread 26.1 ms, 12345 complete, 67 partial")
    assert "not connected: long-name-05" in line
    assert "most loss: long-name-00 0.10 %" in line


def test_where_there_is_no_terminal_lines_come_every_few_seconds_not_at_every_update() -> None:
    console = Console(file=io.StringIO(), force_terminal=False, width=80)
    with LiveDisplay(console, "rig-server") as display:
        for _ in range(5):
            display.update(busy_status())
    assert len(console.file.getvalue().splitlines()) == 1  # type: ignore[attr-defined]


def test_on_a_terminal_the_table_is_drawn_and_stays() -> None:
    console = Console(file=io.StringIO(), force_terminal=True, width=80)
    with LiveDisplay(console, "rig-server") as display:
        display.update(busy_status())
    assert "long-name-11" in console.file.getvalue()  # type: ignore[attr-defined]
