"""The coach in the terminal: every overlap, how well it is known so far, and what to do; else plain lines."""

import time

from rich import box
from rich.bar import Bar
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from rig_calib.accuracy import Accuracy
from rig_calib.coaching import Support
from rig_server.calibration_task import Estimate
from rig_server.coach import coach_lines, counted, headline
from rig_server.live_panel import LivePanel

_LINES_EVERY_S = 5.0
_PLENTY = 100  # matches: more hardly make an overlap better
_BAR_WIDTH = 14
_STYLES = {Support.GOOD: "green", Support.WEAK: "yellow", Support.NOTHING: "bold red"}
_UNKNOWN = "–"


class CoachDisplay(LivePanel):
    """Shows a capture and what it is good for so far; a context manager that leaves the last on the screen.

    Any thread may tell it something; on a terminal it draws itself a few times a second.
    """

    def __init__(self, console: Console) -> None:
        self._bars: dict[str, tuple[str, float]] = {}
        self._estimate: Estimate | None = None
        self._begun = 0
        self._next_lines_s = 0.0
        super().__init__(console, Live(console=console, get_renderable=self._render))  # which renders at once

    def connected(self, cameras: int, expected: int | None) -> None:
        """So many cameras are here."""
        told = f"{cameras}/{expected} cameras" if expected else f"{cameras} cameras"
        self._bars["connected"] = (told, cameras / (expected or cameras or 1))

    def collected(self, sets: int, wanted: int) -> None:
        """So many complete sets have come."""
        self._bars["collected"] = (f"{sets}/{wanted} complete sets", sets / wanted)

    def begun(self, sets: int, last: bool) -> None:  # noqa: ARG002  # as every coach has it
        """A calibration on so many sets begins."""
        self._begun = sets

    def tell(self, stage: str, share: float) -> None:
        """How far it is."""
        self._bars["calibrating"] = (f"on {counted(self._begun, 'set')}: {stage}", share)

    def show(self, estimate: Estimate, last: bool) -> None:
        """What it has found; where there is no terminal, the last one and otherwise not too many."""
        self._estimate = estimate
        now_s = time.monotonic()
        if self._live is None and (last or now_s >= self._next_lines_s):
            self._next_lines_s = now_s + _LINES_EVERY_S
            for line in coach_lines(estimate):
                self._console.print(line, soft_wrap=True, markup=False, highlight=False)

    def _render(self) -> RenderableType:
        bars = Table.grid(padding=(0, 1))
        for told, share in list(self._bars.values()):
            bars.add_row(told, ProgressBar(total=1.0, completed=share, width=40))
        return Group(bars) if self._estimate is None else Group(coach_table(self._estimate), bars)


def coach_table(estimate: Estimate) -> RenderableType:
    """One line an overlap, then what to do; fits 80 columns."""
    table = Table(
        title=headline(estimate.sets, estimate.pairs),
        title_justify="left",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    table.add_column("overlap", no_wrap=True, max_width=24)
    table.add_column("matches", width=_BAR_WIDTH)
    for heading in ("", "± °", "± mm"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("support", no_wrap=True)
    for pair in estimate.pairs:
        style = _STYLES[pair.support]
        bar = Bar(_PLENTY, 0, min(pair.matches, _PLENTY), width=_BAR_WIDTH, color=style.split()[-1])
        table.add_row(pair.name, bar, str(pair.matches), *_figures(pair.expected), Text(pair.support, style))
    advice = (Text(str(pair), _STYLES[pair.support]) for pair in estimate.pairs if pair.advice)
    missed = [Text(f"target: {estimate.missed}", "yellow")] if estimate.missed else []
    return Group(table, *advice, *missed)


def _figures(expected: Accuracy | None) -> tuple[str, str]:
    return (_UNKNOWN, _UNKNOWN) if expected is None else (f"{expected.deg:.3f}", f"{expected.mm:.1f}")
