"""Words to systemd (sd_notify(3)): ready, alive, stopping. Silent when systemd did not start us.

For the shells of agent and server, like programs.py: each hands in how it sends a datagram.
"""

import os
from collections.abc import Callable

from rig_protocol.agent_session import is_due

SendDatagram = Callable[[bytes, str], None]
"""Sends one datagram to a Unix socket's address; OSError when it cannot."""


class ServiceManager:
    """The one who started this program, as its environment says; a manager that is gone is no failure."""

    def __init__(self, send: SendDatagram) -> None:
        """Read the manager's address, and how long it bears our silence (WatchdogSec=)."""
        self._send = send
        address = os.environ.get("NOTIFY_SOCKET", "")
        # Linux's abstract namespace
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        limit_us = os.environ.get("WATCHDOG_USEC", "")
        ours = os.environ.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self._interval_ns = int(limit_us) * 500 if limit_us.isdecimal() and ours else None
        self._due_ns = 0

    def notify(self, state: str) -> None:
        """Send one state, for example READY=1."""
        if not self._address:
            return
        try:
            self._send(state.encode(), self._address)
        except OSError:
            return

    def feed_watchdog(self, now_ns: int) -> None:
        """Call often while all is well; it speaks when due, twice in the manager's limit."""
        if self._interval_ns is not None and is_due(self._due_ns, now_ns, self._interval_ns):
            self._due_ns = now_ns + self._interval_ns
            self.notify("WATCHDOG=1")
