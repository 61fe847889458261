"""Servers that announce themselves by mDNS: where an agent without a server's address looks for one."""

import contextlib
import ipaddress
import logging
import threading
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from rig_agent.config import AgentSettings
from rig_protocol.datagram import SERVICE_TYPE
from rig_protocol.events import Address

if TYPE_CHECKING:
    from zeroconf import ServiceStateChange, Zeroconf

_log = logging.getLogger(__name__)

_MAX_SERVERS = 16  # anybody may announce one
_MAX_ADDRESSES = 8  # of one server
_RESOLVE_MS = 3000
_LOOK_AGAIN_S = 0.1
# Interfaces that came up since we began are not listened on: begin anew while nobody is heard.
_BEGIN_ANEW_S = 20.0


class ServerFinder:
    """Listens from the first `next_address` to `close`; threads of its own."""

    def __init__(self, interfaces: Sequence[str] | None = None) -> None:
        """`interfaces`: addresses of this machine's; unset: all."""
        self._interfaces = interfaces
        self._zeroconf: Zeroconf | None = None
        self._began_s = 0.0
        self._lock = threading.Lock()  # guards what follows
        self._servers: dict[str, list[Address]] = {}
        self._turn = 0

    def next_address(self) -> Address | None:
        """Each call the next of the addresses that are announced now, those of our own networks first.

        The caller cannot know before it tries which of several servers is its own, and which of a server's
        addresses it can reach.
        """
        with self._lock:
            deaf = not self._servers and time.monotonic() - self._began_s > _BEGIN_ANEW_S
        if deaf:
            self.close()
        self._listen()
        with self._lock:
            known = sorted(
                {address for addresses in self._servers.values() for address in addresses},
                key=lambda address: (not _is_near(address[0]), address),
            )
            if not known:
                return None
            self._turn += 1
            return known[(self._turn - 1) % len(known)]

    def close(self) -> None:
        """Listen no more; harmless when it never began."""
        if self._zeroconf is not None:
            self._zeroconf.close()
            self._zeroconf = None

    def _listen(self) -> None:
        if self._zeroconf is not None:
            return
        from zeroconf import InterfaceChoice, ServiceBrowser, Zeroconf

        interfaces = InterfaceChoice.All if self._interfaces is None else list(self._interfaces)
        try:
            self._zeroconf = Zeroconf(interfaces)
        except (OSError, RuntimeError) as error:  # no network yet: the next call tries again
            _log.debug("mDNS is not available: %s", error)
            return
        self._began_s = time.monotonic()
        ServiceBrowser(self._zeroconf, SERVICE_TYPE, handlers=[self._changed])

    def _changed(
        self, zeroconf: "Zeroconf", service_type: str, name: str, state_change: "ServiceStateChange"
    ) -> None:
        """On the browser's thread."""
        info: Any = None
        if state_change.name != "Removed":
            info = zeroconf.get_service_info(service_type, name, _RESOLVE_MS)
        with self._lock:
            self._servers.pop(name, None)
            if info is not None and info.port and len(self._servers) < _MAX_SERVERS:
                found = info.parsed_addresses()[:_MAX_ADDRESSES]
                self._servers[name] = [(address, info.port) for address in found]


def located(settings: AgentSettings, patience_s: float) -> AgentSettings:
    """The same with the address of a server that announces itself, where the settings leave it to that.

    Unchanged where none is heard in time.
    """
    if settings.address is not None:
        return settings
    with contextlib.closing(ServerFinder()) as finder:
        until_s = time.monotonic() + patience_s
        while (found := finder.next_address()) is None and time.monotonic() < until_s:
            time.sleep(_LOOK_AGAIN_S)
    return settings if found is None else settings.model_copy(update={"server": "{}:{}".format(*found)})


def _is_near(host: str) -> bool:
    """True for an address of a network that this machine is in."""
    import ifaddr

    address = ipaddress.ip_address(host)
    for adapter in ifaddr.get_adapters():
        for ip in adapter.ips:
            own = ip.ip if isinstance(ip.ip, str) else ip.ip[0]
            if address in ipaddress.ip_network(f"{own}/{ip.network_prefix}", strict=False):
                return True
    return False
