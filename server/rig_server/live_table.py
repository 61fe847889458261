"""The live table in the terminal; where there is no terminal, a plain line every few seconds."""

import time
from types import TracebackType
from typing import Self

from rich import box
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from rig_server.metrics import CameraMetrics, RigStatus

_LINE_EVERY_S = 5.0


class LiveDisplay:
    """Shows a RigStatus at every `update`; a context manager that leaves the last table on the screen."""

    def __init__(self, console: Console, title: str) -> None:
        self._console = console
        self._title = title
        self._live = Live(console=console, auto_refresh=False) if console.is_terminal else None
        self._next_line_s = 0.0

    def __enter__(self) -> Self:
        """Take over the bottom of the terminal."""
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Give the terminal back."""
        if self._live is not None:
            self._live.stop()

    def update(self, status: RigStatus) -> None:
        """Show the newest status."""
        if self._live is not None:
            self._live.update(status_table(status, self._title), refresh=True)
        elif (now_s := time.monotonic()) >= self._next_line_s:
            self._next_line_s = now_s + _LINE_EVERY_S
            self._console.print(status_line(status), soft_wrap=True)


def status_table(status: RigStatus, title: str) -> RenderableType:
    """One line a camera and a footer; fits 80 columns."""
    hot = any(camera.temperature_c is not None for camera in status.cameras)
    table = Table(
        title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0)
    )
    table.add_column("camera", no_wrap=True, max_width=14)
    for heading in ("fps", "lost %", "late", "damaged", "corrupt", "twice", "clock ±µs", *["°C"] * hot):
        table.add_column(heading, justify="right", no_wrap=True)
    for camera in status.cameras:
        table.add_row(*_cells(camera, hot), style="" if camera.connected else "dim")
    footer = _footer(status) if status.cameras else ["waiting for cameras"]
    return Group(table, *map(Text, footer))


def status_line(status: RigStatus) -> str:
    """The same in one line, for a log."""
    away = [camera.name for camera in status.cameras if not camera.connected]
    parts = [f"{status.connected}/{len(status.cameras)} cameras", *_footer(status)]
    if away:
        parts.append(f"not connected: {', '.join(away)}")
    worst = max(status.cameras, key=lambda camera: camera.loss, default=None)
    if worst is not None and worst.loss:
        parts.append(f"most loss: {worst.name} {100 * worst.loss:.2f} %")
    return "; ".join(parts)


def _cells(camera: CameraMetrics, hot: bool) -> list[str]:
    cells = [
        camera.name,
        f"{camera.fps:.1f}" if camera.connected else "away",
        f"{100 * camera.loss:.2f}",
        str(camera.late),
        str(camera.damaged),
        str(camera.corrupt),
        str(camera.duplicate),
        "–" if camera.clock_error_us is None else f"{camera.clock_error_us:.0f}",
    ]
    if hot:
        cells.append("–" if camera.temperature_c is None else f"{camera.temperature_c:.0f}")
    return cells


def _footer(status: RigStatus) -> list[str]:
    names = {camera.camera_id: camera.name for camera in status.cameras}
    spread = "" if status.spread_ms is None else f", spread {status.spread_ms:.1f} ms"
    sets = f"{status.sets_per_s:.1f} sets/s{spread}, {status.complete} complete, {status.partial} partial"
    missing = ", ".join(names.get(camera_id, str(camera_id)) for camera_id in status.often_missing)
    dropped = ", ".join(f"{name} {count}" for name, count in status.dropped.items() if count)
    lines = [sets]
    if missing:
        lines.append(f"often missing: {missing}")
    if dropped:
        lines.append(f"dropped: {dropped}")
    return lines
