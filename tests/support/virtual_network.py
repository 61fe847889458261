"""A network made of namespaces: hosts, a switch, and a PC behind one port of it with a small buffer.

What it models: the port towards the PC sends at its rate, counted as on the wire, keeps a buffer's worth of
frames and drops what exceeds it. Datagrams cross the switch one by one: the hosts' kernels cut what
UDP_SEGMENT gathers, as a network card would, and the PC's kernel may merge again what arrives together.
What it does not model: transmission takes time only where a rate is set, and all hosts share this machine's
processors, so that they never send at the same instant as twelve machines would.
"""

import json
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from types import TracebackType
from typing import IO, Self

from support.network_namespaces import Namespaces, remove_stale

PC_ADDRESS = "10.77.0.1"
PC, SWITCH = "pc", "switch"
MTU_PAYLOAD = 1472
"""Largest UDP payload of one Ethernet frame."""
WIRE_OVERHEAD = 66
"""Bytes on the wire beside that payload: UDP, IP and Ethernet headers, checksum, preamble and gap."""

_UNSEEN_OVERHEAD = 24  # of these the kernel counts 42; the rest: 4 checksum, 8 preamble, 12 gap
# What the shaper lets through at once after a pause: it makes up for a timer that is 260 µs late. Counted as
# part of the buffer, so that a port that is never idle has less buffer than it claims, and never more.
_BUCKET = 32 * 1024
_HOST_QUEUE = 4 << 20  # a host's own queue loses nothing: its socket buffers are smaller
# Without these every datagram crosses the cables as a frame of its own, and the shaper sees each.
_NO_OFFLOAD = "tso off gso off tx-udp-segmentation off gro off"
_RANDOM_LOSS = """table bridge loss {{
  chain forward {{
    type filter hook forward priority 0
    numgen random mod 100000 < {} counter drop
  }}
}}
"""
_FIRST_HOST = 10
_MAX_HOSTS = 64


def payload_ceiling(link_mbit: float) -> float:
    """Bytes of UDP payload that a link carries in a second: 119.6 MB at 1 Gbit/s."""
    return link_mbit * 1e6 / 8 * MTU_PAYLOAD / (MTU_PAYLOAD + WIRE_OVERHEAD)


@dataclass(frozen=True, slots=True)
class PortCounters:
    """What the switch's port towards the PC did so far. `wire_bytes` with all overhead."""

    datagrams: int
    wire_bytes: int
    dropped: int

    def since(self, before: "PortCounters") -> "PortCounters":
        """The difference."""
        return PortCounters(
            self.datagrams - before.datagrams,
            self.wire_bytes - before.wire_bytes,
            self.dropped - before.dropped,
        )


class VirtualNetwork:
    """`with VirtualNetwork() as network:` places `host00`, `host01`, ..., `switch` and `pc`.

    `buffer_kib` is the largest burst that the port takes without loss. `host_mbit` is the rate of the hosts'
    own links; unset: as fast as the machine.
    """

    def __init__(
        self, hosts: int = 12, link_mbit: int = 1000, buffer_kib: int = 128, host_mbit: int | None = None
    ) -> None:
        if not 0 < hosts <= _MAX_HOSTS or buffer_kib * 1024 <= _BUCKET:
            raise ValueError(f"{hosts} hosts (1 to {_MAX_HOSTS}), buffer {buffer_kib} KiB (more than 32)")
        self.hosts = tuple(host_name(i) for i in range(hosts))
        self.link_mbit, self.buffer_kib, self._host_mbit = link_mbit, buffer_kib, host_mbit
        self._namespaces = Namespaces()

    def __enter__(self) -> Self:
        """Build it."""
        remove_stale()
        try:
            self._build()
        except BaseException:
            self._namespaces.remove()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End all processes in it and remove it."""
        self._namespaces.remove()

    def prefix(self, place: str) -> list[str]:
        """Words before a command that run it at this place."""
        return self._namespaces.prefix(place)

    def run_in(
        self,
        place: str,
        argv: Sequence[str],
        env: Mapping[str, str] | None = None,
        stdout: int | IO[str] | None = None,
    ) -> subprocess.Popen[str]:
        """Start a process at this place; it ends with the network at the latest."""
        return self._namespaces.start(place, argv, env, stdout)

    def inside(self, place: str) -> AbstractContextManager[None]:
        """The calling thread is at this place: sockets that it opens meanwhile stay there."""
        return self._namespaces.inside(place)

    def port(self) -> PortCounters:
        """Counters of the switch's port towards the PC."""
        shown = self._namespaces.command(SWITCH, "tc -s -j qdisc show dev pc")
        root = next(qdisc for qdisc in json.loads(shown) if qdisc["kind"] == "tbf")
        return PortCounters(root["packets"], root["bytes"], root["drops"])

    def pull_cable(self, place: str) -> None:
        """Host or PC: its link goes down at both ends."""
        self._namespaces.command(SWITCH, f"ip link set {place} down")

    def plug_cable(self, place: str) -> None:
        """Its link is up again."""
        self._namespaces.command(SWITCH, f"ip link set {place} up")

    @contextmanager
    def loss(self, percent: float) -> Iterator[None]:
        """The switch loses this share of all datagrams at random, in both directions."""
        self._namespaces.command(SWITCH, "nft -f -", _RANDOM_LOSS.format(round(percent * 1000)))
        try:
            yield
        finally:
            self._namespaces.command(SWITCH, "nft delete table bridge loss")

    def lost_at_random(self) -> int:
        """Datagrams that `loss` has taken so far."""
        listed = json.loads(self._namespaces.command(SWITCH, "nft -j list table bridge loss"))
        words = [word for entry in listed["nftables"] for word in entry.get("rule", {}).get("expr", [])]
        return sum(int(word["counter"]["packets"]) for word in words if "counter" in word)

    def _build(self) -> None:
        spaces = self._namespaces
        spaces.add(SWITCH)
        spaces.command(SWITCH, "ip link add bridge type bridge mcast_snooping 0")
        spaces.command(SWITCH, "ip link set bridge addrgenmode none up")
        addresses = {host: f"10.77.0.{_FIRST_HOST + i}" for i, host in enumerate(self.hosts)}
        for place, address in {PC: PC_ADDRESS, **addresses}.items():
            spaces.add(place)
            self._connect(place, address)
        self._shape(SWITCH, PC, self.link_mbit, self.buffer_kib * 1024 - _BUCKET)
        # As a network card does, merge datagrams of one sender that arrive together.
        spaces.command(PC, "ethtool -K eth0 gro on")
        if self._host_mbit is not None:
            for host in self.hosts:
                self._shape(host, "eth0", self._host_mbit, _HOST_QUEUE)

    def _connect(self, place: str, address: str) -> None:
        """A cable from the place's eth0 to a port of the switch that is named after the place."""
        spaces = self._namespaces
        peer = f"peer name eth0 netns {spaces.full_name(place)}"
        spaces.command(SWITCH, f"ip link add {place} type veth {peer}")
        for where, device in ((SWITCH, place), (place, "eth0")):
            spaces.command(where, f"ethtool -K {device} {_NO_OFFLOAD}")
            # No chatter of IPv6 among the frames that are counted.
            spaces.command(where, f"ip link set {device} addrgenmode none")
        spaces.command(place, f"ip address add {address}/24 dev eth0")
        spaces.command(place, "ip link set eth0 up")
        spaces.command(SWITCH, f"ip link set {place} master bridge up")

    def _shape(self, place: str, device: str, mbit: int, queue_bytes: int) -> None:
        wire = f"stab overhead {_UNSEEN_OVERHEAD} linklayer ethernet"
        shaper = f"tbf rate {mbit}mbit burst {_BUCKET} limit {queue_bytes}"
        self._namespaces.command(place, f"tc qdisc add dev {device} root handle 1: {wire} {shaper}")


def host_name(index: int) -> str:
    """The place of host `index`."""
    return f"host{index:02d}"
