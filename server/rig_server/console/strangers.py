"""Connections of strangers: a bounded number, of which the oldest gives way."""

import asyncio
from collections.abc import Sequence

from aiohttp import web

_MAX_STRANGERS = 32
_MAX_KNOWN = 256  # connections that brought the token
_SETTLED_S = 0.1  # a burst of connections is accepted before any of them has its transport


class Doorkeeper:
    """Makes the protocol of every connection; one is a stranger's until a request of it brought the token."""

    def __init__(self, server: web.Server) -> None:
        self._server = server
        self._known: set[object] = set()
        self._looks_soon = False

    def __call__(self) -> asyncio.BaseProtocol:
        """The protocol of a new connection."""
        if not self._looks_soon:
            self._looks_soon = True
            asyncio.get_running_loop().call_later(_SETTLED_S, self._look)
        return self._server()

    def admit(self, request: web.Request) -> None:
        """The request brought the token: its connection is no stranger's any more."""
        self._known.add(request.protocol)

    def _look(self) -> None:
        """Hang up on the oldest where there are too many; the server lists them by age."""
        self._looks_soon = False
        open_now = self._server.connections
        self._known.intersection_update(open_now)
        _hang_up([one for one in open_now if one not in self._known], _MAX_STRANGERS)
        _hang_up([one for one in open_now if one in self._known], _MAX_KNOWN)


def _hang_up(connections: Sequence[web.RequestHandler], most: int) -> None:
    for one in connections[: max(len(connections) - most, 0)]:
        if isinstance(one.transport, asyncio.Transport):
            one.transport.abort()
