"""Connections of strangers: a bounded number, of which the oldest gives way."""

import asyncio
from collections.abc import Callable

from aiohttp import web

_MAX_STRANGERS = 32
_MAX_KNOWN = 256  # connections that brought the token
_SETTLED_S = 0.1  # a burst of connections is accepted before any of them has its transport


class Doorkeeper:
    """Makes the protocol of every connection; one is a stranger's until a request of it brought the token."""

    def __init__(self, server: Callable[[], asyncio.BaseProtocol]) -> None:
        self._server = server
        self._strangers, self._known = _Queue(_MAX_STRANGERS), _Queue(_MAX_KNOWN)

    def __call__(self) -> asyncio.BaseProtocol:
        """The protocol of a new connection."""
        protocol = self._server()
        self._strangers.add(protocol)
        return protocol

    def admit(self, request: web.Request) -> None:
        """The request brought the token: its connection is no stranger's any more."""
        if self._strangers.remove(request.protocol):
            self._known.add(request.protocol)


class _Queue:
    """Connections, oldest first, and whether each has begun: its transport comes a moment after it."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._begun: dict[asyncio.BaseProtocol, bool] = {}

    def add(self, protocol: asyncio.BaseProtocol) -> None:
        """One more; where there are too many, hang up on the oldest."""
        self._begun[protocol] = False
        if len(self._begun) > self._most:
            asyncio.get_running_loop().call_later(_SETTLED_S, self._shorten)

    def _shorten(self) -> None:
        for one, begun in list(self._begun.items()):
            transport = getattr(one, "transport", None)
            if transport is None and begun:  # it has ended
                del self._begun[one]
            elif isinstance(transport, asyncio.Transport):
                self._begun[one] = True
                if len(self._begun) > self._most:
                    del self._begun[one]
                    transport.abort()

    def remove(self, protocol: asyncio.BaseProtocol) -> bool:
        """Whether it was there."""
        return self._begun.pop(protocol, None) is not None
