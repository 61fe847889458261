"""Rules of health: rates are of the time since the last line, gauges follow the machine."""

from pathlib import Path

import pytest

from rig_agent import health
from rig_agent.health import HealthLog, Totals, gauges

SECOND_NS = 1_000_000_000


def test_a_line_is_due_every_interval() -> None:
    log = HealthLog(10.0, 5)
    assert log.due_ns == 5 + 10 * SECOND_NS
    log.line(Totals(), True, log.due_ns + 7)
    assert log.due_ns == 5 + 20 * SECOND_NS + 7


def test_rates_are_since_the_last_line_and_counts_since_the_start() -> None:
    log = HealthLog(10.0, 0)
    log.line(Totals(captured=300, sent=300), True, 10 * SECOND_NS)
    line = log.line(Totals(captured=500, sent=450, dropped=50), False, 20 * SECOND_NS)
    assert line.startswith("not connected: captured 20.0 fps, sent 15.0 fps; in total 450 sent, 50 dropped")


def test_what_the_driver_counted_is_told_in_the_log_and_to_the_server() -> None:
    totals = Totals(source={"unpaired": 2, "overrun": 1})
    assert (
        HealthLog(10.0, 0)
        .line(totals, True, 1)
        .endswith(", 2 unpaired by the source, 1 overrun by the source")
    )
    assert gauges(totals).items() >= {"source_unpaired": 2, "source_overrun": 1}.items()


@pytest.mark.parametrize(("text", "found"), [("48312\n", 48.312), ("hot", None), (None, None)])
def test_the_temperature_is_told_where_the_machine_knows_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str | None, found: float | None
) -> None:
    file = tmp_path / "temp"
    if text is not None:
        file.write_text(text)
    monkeypatch.setattr(health, "_PROCESSOR_TEMPERATURE", file)
    assert gauges(Totals(dropped=3)).get("temperature_c") == found
    assert gauges(Totals(dropped=3))["dropped"] == 3
