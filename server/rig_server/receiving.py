"""`rig-server` without `--calibrate`: receive, and show how the rig is."""

import contextlib
import time

from rich.console import Console

from rig_protocol.service_manager import ServiceManager
from rig_server.live_table import LiveDisplay
from rig_server.rig import Rig
from rig_server.unix_socket import send_to_unix_socket

_UPDATE_S = 0.5


def receive(rig: Rig, console: Console) -> None:
    """Show the live table until Ctrl-C or SIGTERM, the ordinary end, or that of what is replayed.

    systemd's watchdog is fed only while both go on: the receiver's turns, and the taking of sets here.
    """
    service_manager = ServiceManager(send_to_unix_socket)
    with (
        contextlib.suppress(KeyboardInterrupt),
        rig,
        LiveDisplay(console, f"rig-server, {rig.place}") as display,
        contextlib.ExitStack() as at_the_end,
    ):
        at_the_end.callback(service_manager.notify, "STOPPING=1")
        service_manager.notify("READY=1")
        turns, next_update_s = 0, time.monotonic()
        at_the_end.callback(_tell_end, rig, console)
        while not rig.ended:
            rig.next_panorama(_UPDATE_S)
            if time.monotonic() < next_update_s:
                continue
            status = rig.status()
            display.update(status)
            next_update_s = time.monotonic() + _UPDATE_S
            if status.turns != turns:
                turns = status.turns
                service_manager.feed_watchdog(time.monotonic_ns())


def _tell_end(rig: Rig, console: Console) -> None:
    """The totals of what was replayed to its end."""
    if rig.ended:
        status = rig.status()
        console.print(
            f"{rig.place} has ended: {status.complete} complete, {status.partial} partial sets",
            soft_wrap=True,
            markup=False,
        )
