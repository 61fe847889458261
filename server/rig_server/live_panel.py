"""The bottom of the terminal, while something is shown there."""

from types import TracebackType
from typing import Self

from rich.console import Console
from rich.live import Live


class LivePanel:
    """A context manager that leaves the last of what it showed on the screen.

    `live` is None where the console is no terminal: then plain lines take its place.
    """

    def __init__(self, console: Console, live: Live) -> None:
        self._console = console
        self._live = live if console.is_terminal else None

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
