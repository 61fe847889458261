"""`rig-server` without `--calibrate`: receive, and show how the rig is."""

import contextlib
import time

from rich.console import Console

from rig_server.live_table import LiveDisplay
from rig_server.rig import Rig

_UPDATE_S = 0.5


def receive(rig: Rig, console: Console) -> None:
    """Show the live table until Ctrl-C or SIGTERM, the ordinary end."""
    with (
        contextlib.suppress(KeyboardInterrupt),
        rig,
        LiveDisplay(console, f"rig-server, {rig.place}") as display,
    ):
        next_update_s = time.monotonic()
        while True:
            rig.next_panorama(_UPDATE_S)
            if time.monotonic() >= next_update_s:
                display.update(rig.status())
                next_update_s = time.monotonic() + _UPDATE_S
