"""What the three programs share: one place that maps errors to exit codes and says them to the operator."""

import logging
import os
import signal
import sys
from collections.abc import Callable
from types import FrameType

import typer
from rich.console import Console
from rich.logging import RichHandler

from rig_protocol.errors import RigError
from rig_protocol.troubleshooting import reference

EXIT_DONE, EXIT_FAILED, EXIT_USAGE = 0, 1, 2
SignalHandler = Callable[[int, FrameType | None], None]


def leave_as_by_ctrl_c(_signal: int, _frame: FrameType | None) -> None:
    """Handler of a signal that interrupts the work: exit status 130."""
    raise KeyboardInterrupt


def leave_done(_signal: int, _frame: FrameType | None) -> None:
    """Handler of a signal that is the ordinary end of a service: exit status 0."""
    raise SystemExit(EXIT_DONE)


def run_program(app: typer.Typer, on_sigterm: SignalHandler = leave_as_by_ctrl_c) -> None:
    """Run a typer app: 0 done, 1 the work failed, 2 wrong usage."""
    signal.signal(signal.SIGTERM, on_sigterm)
    console = Console(stderr=True, highlight=False)
    try:
        app()
    except RigError as error:
        console.print("error:", style="bold red", end=" ")
        console.print(str(error), markup=False, soft_wrap=True)
        console.print(reference(error.topic), style="dim", soft_wrap=True)
        sys.exit(error.exit_status)
    except BrokenPipeError:
        # The reader of our output went away (`rig-server | head`); keep the interpreter from complaining.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(EXIT_FAILED)


def set_up_logging(level: str = "INFO", console: Console | None = None) -> None:
    """Log to stderr: with colours on a terminal, plain lines for journald otherwise.

    A program that draws on a terminal of its own gives that `console`: lines then appear above what is drawn.
    """
    handler: logging.Handler
    if sys.stderr.isatty():
        shared = console if console is not None and console.is_terminal else Console(stderr=True)
        handler = RichHandler(console=shared, show_path=False, rich_tracebacks=True)
        handler.setFormatter(_ReferringFormatter("%(message)s"))
    else:
        handler = logging.StreamHandler()
        handler.setFormatter(_ReferringFormatter("%(levelname)s %(name)s: %(message)s"))
    logging.basicConfig(level=level.upper(), handlers=[handler], force=True)


class _ReferringFormatter(logging.Formatter):
    """Ends a line that has a topic with where to read on."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        told = super().formatMessage(record)
        topic = getattr(record, "topic", None)
        return told if topic is None else f"{told} ({reference(topic)})"
