"""Words to systemd (sd_notify(3)): ready, alive, stopping. Silent when systemd did not start us."""

import os
import socket

from rig_protocol.agent_session import is_due


def notify(state: str) -> None:
    """Send one state, for example READY=1; a service manager that is gone is no reason to fail."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    if address.startswith("@"):
        address = "\0" + address[1:]  # Linux's abstract namespace
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
            manager.sendto(state.encode(), address)
    except OSError:
        return


class Watchdog:
    """Tells systemd that we are alive, twice in its limit, when it asks for that (WatchdogSec=)."""

    def __init__(self) -> None:
        """Read the limit that systemd set for this process."""
        limit_us = os.environ.get("WATCHDOG_USEC", "")
        ours = os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self._interval_ns = int(limit_us) * 500 if limit_us.isdecimal() and ours else None
        self._due_ns = 0

    def feed(self, now_ns: int) -> None:
        """Call often; it speaks when due."""
        if self._interval_ns is not None and is_due(self._due_ns, now_ns, self._interval_ns):
            self._due_ns = now_ns + self._interval_ns
            notify("WATCHDOG=1")
