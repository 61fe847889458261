"""Rates, sets and the live table that shows them."""

import io
import re
from dataclasses import replace
from typing import Any

import pytest
from rich.console import Console

from rig_protocol.synchroniser import IncompleteSet
from rig_server.assembler import SetRecord
from rig_server.live_table import LiveDisplay, status_line, status_table
from rig_server.metrics import CameraMetrics, RateMeter, RigStatus, summarise_sets
from rig_server.sample_window import SampleWindow
from support.full_status import full_status

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
            resent=12_345_678,
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


def test_however_often_somebody_asks_a_window_holds_few_samples_and_the_rate_is_the_same() -> None:
    meter = RateMeter()
    for ms in range(10_000):
        rates = meter.update({0: 30 * ms // 1000}, ms * S // 1000)
    assert abs(rates[0] - 30.0) < 0.4
    window = SampleWindow[int](3 * S, S // 10)
    assert max(len(window.add(ms, ms * S // 1000)) for ms in range(10_000)) <= 33


def test_a_window_keeps_the_last_sample_before_it() -> None:
    window = SampleWindow[str](3 * S, 0)
    for second, sample in enumerate("abcdefgh"):
        samples = window.add(sample, second * S)
    assert samples == [(4 * S, "e"), (5 * S, "f"), (6 * S, "g"), (7 * S, "h")]


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


def healthy_status() -> RigStatus:
    cameras = [
        CameraMetrics(i, f"cam{i:02d}", True, 30.0, 9000, clock_error_us=60.0, temperature_c=55.0)
        for i in range(12)
    ]
    full = full_status()
    queues = {"decoder": 0, "synchroniser": 7, "sets": 0}
    return replace(RigStatus(tuple(cameras), 900, 0, 30.0, 26.1), recent=full.recent, queues=queues)


def test_a_healthy_rig_looks_calm() -> None:
    lines = rendered(healthy_status())
    assert lines[-2:] == [
        "30.0 sets/s, spread 26.1 ms ± 75 µs, 900 complete, 0 partial",
        "p50/p99 ms: arrival 25/30, decoding 4.0/5.0, delivery 8.8/10.0",
    ]
    console = Console(file=io.StringIO(), width=80, force_terminal=True, color_system="standard")
    console.print(status_table(healthy_status(), "rig-server"))
    assert "\x1b[1;33m" not in console.file.getvalue()  # type: ignore[attr-defined]


def test_every_trouble_has_a_line_and_stands_out() -> None:
    console = Console(file=io.StringIO(), width=80, force_terminal=True, color_system="standard")
    console.print(status_table(replace(full_status(), unread_bytes=3 << 20), "rig-server"))
    shown = console.file.getvalue()  # type: ignore[attr-defined]
    for line in (
        "often missing: cam01",
        "waiting: decoder 3, sets 1, receive buffer MiB 3",
        "dropped: incomplete sets 21, sets not taken 22, frames left out of sets 23,",
        "rejected datagrams: unknown session 32, bad magic 31",
    ):
        assert f"\x1b[1;33m{line}" in shown


@pytest.mark.parametrize(
    ("sick", "shown"),
    [
        ({"frames": 999, "lost": 1}, "0.10"),
        ({"clock_error_us": 500.0}, "500"),
        ({"temperature_c": 80.0}, "80"),
        ({"connected": False}, "away"),
    ],
)
def test_a_sick_camera_stands_out(sick: dict[str, Any], shown: str) -> None:
    camera = replace(healthy_status().cameras[0], **sick)
    console = Console(file=io.StringIO(), width=80, force_terminal=True, color_system="standard")
    console.print(status_table(RigStatus((camera,)), "rig-server"))
    assert re.search(rf"\x1b\[1;33m *{shown}", console.file.getvalue())  # type: ignore[attr-defined]


def test_many_causes_of_rejection_are_told_by_the_largest() -> None:
    status = RigStatus((), rejected={"a": 1, "b": 5, "c_d": 4, "e": 3, "f": 2, "g": 0})
    assert "rejected datagrams: b 5, c d 4, e 3, f 2, 1 more" in status_line(status)


def test_the_line_for_logs_tells_the_same_as_the_table() -> None:
    line = status_line(full_status())
    for part in (
        "spread 25.1 ms ± 75 µs",
        "p50/p99 ms: arrival 25/30, decoding 4.0/5.0, delivery 8.8/10.0",
        "60% of the link",
        f"{sum(camera.resent for camera in full_status().cameras)} fragments resent",
        "waiting: decoder 3, sets 1",
        "dropped: incomplete sets 21",
        "rejected datagrams: unknown session 32, bad magic 31",
        "not connected: cam01",
    ):
        assert part in line
    assert "\n" not in line


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


def test_a_moved_camera_stands_out_in_the_table_and_in_the_line() -> None:
    alarm = "cam01 has moved by 0.52° ± 0.01° and 6.2 ± 0.3 mm"
    console = Console(width=200, record=True, color_system="standard", file=io.StringIO())
    console.print(status_table(full_status(), "rig-server"))
    styled = console.export_text(styles=True, clear=False)
    (line,) = (line for line in styled.splitlines() if alarm in line)
    assert "\x1b[1;31m" in line  # bold and red
    assert alarm in status_line(full_status())
    assert "has moved" not in status_line(replace(full_status(), drift=None))
