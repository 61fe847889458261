"""Datagrams that belong to no camera, sent at a pace at which no kernel's buffer overflows."""

import socket
import time
from collections.abc import Sequence

from rig_protocol.events import Address
from rig_server import Rig

_AT_ONCE = 20
_PATIENCE_S = 20.0


def send_garbage(rig: Rig, server: Address, datagrams: Sequence[bytes]) -> None:
    """Send them as a stranger, a few at a time; AssertionError unless the server counts every one."""
    counted = _counted(rig)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for start in range(0, len(datagrams), _AT_ONCE):
            some = datagrams[start : start + _AT_ONCE]
            for datagram in some:
                stranger.sendto(datagram, server)
            counted += len(some)
            _wait_for_count(rig, counted)


def _wait_for_count(rig: Rig, count: int) -> None:
    until_s = time.monotonic() + _PATIENCE_S
    while _counted(rig) < count:
        assert time.monotonic() < until_s, f"{_counted(rig)} of {count} datagrams were counted"
        time.sleep(0.001)


def _counted(rig: Rig) -> int:
    return sum(rig.status().rejected.values())
