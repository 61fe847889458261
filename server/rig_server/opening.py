"""Opens the rig that the command line asks for, with what serves it: metrics, console, operator, mDNS."""

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from rig_calib.outputs import NAME
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.errors import ConfigurationError, DataError
from rig_server.announcement import announced
from rig_server.capture_log import CaptureLog
from rig_server.config import RigSettings
from rig_server.metrics_endpoint import metrics_served
from rig_server.operator_requests import OperatorRequests
from rig_server.operator_socket import operator_served
from rig_server.replay import ReplayOptions
from rig_server.rig import Rig


@dataclass(frozen=True, slots=True)
class Origin:
    """Where the frames come from, as the options say; `speed` None: as fast as possible."""

    simulate: int | None = None
    seed: int | None = None
    record: Path | None = None
    replay: Path | None = None
    speed: float | None = 1.0
    loop: bool = False
    seek_s: float = 0.0

    @property
    def live(self) -> bool:
        """Whether they come from the agents of a real rig."""
        return self.simulate is None and self.replay is None

    def rig(self, settings: RigSettings) -> Rig:
        """The rig, not begun yet."""
        if self.replay is not None:
            options = ReplayOptions(self.speed, self.loop, self.seek_s)
            return Rig.replayed(self.replay, settings, options, self.record)
        if self.simulate is not None:
            return Rig.simulated(self.simulate, self.seed or 0, settings=settings, record=self.record)
        return Rig.live(settings, self.record)


@contextlib.contextmanager
def open_rig(
    settings: RigSettings, origin: Origin, terminal: Console, log: CaptureLog | None = None
) -> Iterator[Rig]:
    """The rig that the options ask for, not begun yet, and everything that serves it until the block ends.

    `log`: the calibration that the command line asks for, which a console looks on.
    """
    announces = settings.announce and origin.live
    with (
        contextlib.closing(origin.rig(settings)) as rig,
        metrics_served(settings.metrics_address, rig.status),
        operator_served(settings.control_socket, OperatorRequests(rig)),
        announced(settings.address) if announces else contextlib.nullcontext(),
        contextlib.ExitStack() as with_console,
    ):
        if settings.console.listen is not None:
            if origin.live and log is None:
                _take_up_calibration(rig)
            _serve_console(with_console, rig, terminal, log)
        yield rig


def _serve_console(stack: contextlib.ExitStack, rig: Rig, terminal: Console, log: CaptureLog | None) -> None:
    from rig_server.console.console import RigConsole  # it takes a second to import

    console = stack.enter_context(RigConsole(rig, log))
    terminal.print(f"console at {console.link}", soft_wrap=True, markup=False, highlight=False)


def _take_up_calibration(rig: Rig) -> None:
    """Go by the calibration that was accepted last time, unless there is another one."""
    file = rig.settings.console.folder / NAME
    if rig.calibration is None and file.is_file():
        try:
            rig.put_in_force(RigCalibration.load(file))
        except DataError as error:
            raise ConfigurationError(f"console.folder: {error}") from error
