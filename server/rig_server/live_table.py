"""The live table in the terminal; where there is no terminal, a plain line every few seconds."""

import time

from rich import box
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from rig_server.live_panel import LivePanel
from rig_server.metrics import CameraMetrics, RigStatus
from rig_server.status_words import alarms, summary

_LINE_EVERY_S = 5.0

# From here on a figure is a trouble of its own and stands out.
_HIGH_LOSS = 0.001  # a complete set in a thousand is missing for it
_HIGH_CLOCK_ERROR_US = 500.0
_HIGH_TEMPERATURE_C = 80.0  # a Pi slows down
_CALM, _PLAIN, _TROUBLE = "dim", "", "bold not dim yellow"
_ALARM = "bold not dim red"


class LiveDisplay(LivePanel):
    """Shows a RigStatus at every `update`; a context manager that leaves the last table on the screen."""

    def __init__(self, console: Console, title: str) -> None:
        super().__init__(console, Live(console=console, auto_refresh=False))
        self._title = title
        self._next_line_s = 0.0

    def update(self, status: RigStatus) -> None:
        """Show the newest status."""
        if self._live is not None:
            self._live.update(status_table(status, self._title), refresh=True)
        elif (now_s := time.monotonic()) >= self._next_line_s:
            self._next_line_s = now_s + _LINE_EVERY_S
            self._console.print(status_line(status), soft_wrap=True)


def status_table(status: RigStatus, title: str) -> RenderableType:
    """One line a camera and a footer; fits 80 columns. What is in order is dim, what is not stands out."""
    hot = any(camera.temperature_c is not None for camera in status.cameras)
    table = Table(
        title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0)
    )
    table.add_column("camera", no_wrap=True, max_width=14)
    headings = ("fps", "lost %", "late", "damaged", "corrupt", "resent", "twice", "±µs", *["°C"] * hot)
    for heading in headings:
        table.add_column(heading, justify="right", no_wrap=True)
    for camera in status.cameras:
        table.add_row(*_cells(camera, hot), style=_PLAIN if camera.connected else _CALM)
    figures, troubles = summary(status)
    if not status.cameras:
        figures = ["waiting for cameras"]
    lines = [Text(line) for line in figures] + [Text(line, _TROUBLE) for line in troubles]
    return Group(table, *lines, *(Text(line, _ALARM) for line in alarms(status)))


def status_line(status: RigStatus) -> str:
    """The same in one line, for a log."""
    figures, troubles = summary(status)
    parts = [f"{status.connected}/{len(status.cameras)} cameras", *figures]
    if resent := sum(camera.resent for camera in status.cameras):
        parts.append(f"{resent} fragments resent")
    parts += [*troubles, *alarms(status)]
    if away := [camera.name for camera in status.cameras if not camera.connected]:
        parts.append(f"not connected: {', '.join(away)}")
    worst = max(status.cameras, key=lambda camera: camera.loss, default=None)
    if worst is not None and worst.loss:
        parts.append(f"most loss: {worst.name} {100 * worst.loss:.2f} %")
    return "; ".join(parts)


def _cells(camera: CameraMetrics, hot: bool) -> list[Text]:
    cells = [
        Text(camera.name),
        Text(f"{camera.fps:.1f}") if camera.connected else Text("away", _TROUBLE),
        _figure(f"{100 * camera.loss:.2f}", camera.loss, _HIGH_LOSS),
        *(_count(count) for count in (camera.late, camera.damaged, camera.corrupt)),
        *(_count(count) for count in (camera.resent, camera.duplicate)),
        _measured(camera.clock_error_us, _HIGH_CLOCK_ERROR_US),
    ]
    if hot:
        cells.append(_measured(camera.temperature_c, _HIGH_TEMPERATURE_C))
    return cells


def _count(count: int) -> Text:
    return Text(_short(count), _PLAIN if count else _CALM)


def _measured(value: float | None, high: float) -> Text:
    return Text("–", _CALM) if value is None else _figure(_short(round(value)), value, high, calm=_PLAIN)


def _figure(shown: str, value: float, high: float, calm: str = _CALM) -> Text:
    return Text(shown, _TROUBLE if value >= high else _PLAIN if value else calm)


def _short(count: int) -> str:
    """At most four characters: 9999, 123k, 12M."""
    if count < 10_000:
        return str(count)
    return f"{count // 1000}k" if count < 1_000_000 else f"{count // 1_000_000}M"
