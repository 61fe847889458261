"""Connections of strangers: a bounded number, of which the oldest gives way."""

import asyncio
from collections.abc import Callable

from aiohttp import web

_MAX_STRANGERS = 32
_MAX_CONNECTIONS = 256  # of those that brought the token


class Doorkeeper:
    """Makes the protocol of every connection; one is a stranger's until a request of it brought the token."""

    def __init__(self, server: Callable[[], asyncio.BaseProtocol]) -> None:
        self._server = server
        self._strangers: dict[asyncio.BaseProtocol, None] = {}  # oldest first
        self._known: dict[asyncio.BaseProtocol, None] = {}

    def __call__(self) -> asyncio.BaseProtocol:
        """The protocol of a new connection."""
        _make_room(self._strangers, _MAX_STRANGERS)
        protocol = self._server()
        self._strangers[protocol] = None
        return protocol

    def admit(self, request: web.Request) -> None:
        """The request brought the token: its connection is no stranger's any more."""
        protocol = request.protocol
        if self._strangers.pop(protocol, self) is None:
            _make_room(self._known, _MAX_CONNECTIONS)
            self._known[protocol] = None


def _make_room(connections: dict[asyncio.BaseProtocol, None], most: int) -> None:
    """Forget those that have ended; where that is not enough, hang up on the oldest."""
    if len(connections) < most:
        return
    for protocol in [one for one in connections if _transport(one) is None]:
        del connections[protocol]
    while len(connections) >= most:
        oldest = next(iter(connections))
        del connections[oldest]
        transport = _transport(oldest)
        if transport is not None:
            transport.abort()


def _transport(protocol: asyncio.BaseProtocol) -> asyncio.Transport | None:
    """None for a connection that has ended (or not quite begun)."""
    transport = getattr(protocol, "transport", None)
    return transport if isinstance(transport, asyncio.Transport) else None
