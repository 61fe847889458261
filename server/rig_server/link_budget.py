"""What an Ethernet port carries, and what frames cost on it. Arithmetic only, no state.

Loads are told in bytes of UDP payload, as programs count them; whether they fit is decided in bytes on the
wire, which also count what goes around every datagram.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from rig_protocol.datagram import FRAGMENT_HEADER_SIZE, MAX_DATAGRAM_SIZE
from rig_protocol.frame_unit import FRAME_HEADER_SIZE
from rig_protocol.security import TAG_SIZE

# IEEE 802.3: preamble with start of frame, header, frame check sequence, gap between frames.
_ETHERNET_BYTES = 8 + 14 + 4 + 12
_IP_UDP_BYTES = 20 + 8

AGENT_SPREAD = 0.8  # default of `pacing.spread` in agent.toml
_FULL = 0.98  # peak rate to plan for, as a share of the port: rounding up to whole bursts takes the rest
_SPREAD_GRID = 20  # the spread comes in steps of 0.05, so that it does not change with every frame

# A wake-up costs a Pi about 0.1 ms in Python, and its timer is late by as much: 400 to 1000 a second.
_MIN_STEP_NS, _MAX_STEP_NS = 1_000_000, 2_500_000
_STEP_GRID_NS = 10_000
_MAX_BURST = 8  # 12 kB: the smallest switches buffer that much of each of twelve senders


@dataclass(frozen=True, slots=True)
class Port:
    """One direction of a full-duplex Ethernet port."""

    speed_mbit: float
    mtu: int = 1500

    @property
    def datagram_size(self) -> int:
        """Largest UDP payload that is not fragmented by IP."""
        return min(self.mtu - _IP_UDP_BYTES, MAX_DATAGRAM_SIZE)

    @property
    def wire_bytes_s(self) -> float:
        """Bytes a second on the wire, everything counted."""
        return self.speed_mbit * 125_000

    @property
    def udp_bytes_s(self) -> float:
        """Bytes a second of UDP payload in the largest datagrams: 119.6e6 for 1000BASE-T, MTU 1500."""
        return self.wire_bytes_s * self.datagram_size / wire_size(self.datagram_size)


@dataclass(frozen=True, slots=True)
class FrameCost:
    """One frame as datagrams: UDP payload with our headers, and bytes on the wire."""

    datagrams: int
    udp_bytes: int
    wire_bytes: int


@dataclass(frozen=True, slots=True)
class Pacing:
    """When agents send: bursts every `step_ns`, a frame spread over `spread` of its interval.

    `burst`: datagrams that the busiest agent sends at once. `backlog_bytes`: what the switch must hold
    should the bursts of all agents meet in spite of their slots.
    """

    step_ns: int
    spread: float
    burst: int
    backlog_bytes: int


def wire_size(udp_bytes: int) -> int:
    """Bytes on the wire of one datagram; ours never need Ethernet's padding to 46 bytes."""
    return udp_bytes + _IP_UDP_BYTES + _ETHERNET_BYTES


def frame_cost(payload_bytes: float, mtu: int = 1500) -> FrameCost:
    """What a frame with so many bytes of encoded images costs (protocol/SPEC.md, section 3)."""
    unit = math.ceil(payload_bytes) + FRAME_HEADER_SIZE + TAG_SIZE
    datagrams = -(-unit // (Port(0, mtu).datagram_size - FRAGMENT_HEADER_SIZE))
    udp_bytes = unit + datagrams * FRAGMENT_HEADER_SIZE
    return FrameCost(datagrams, udp_bytes, udp_bytes + datagrams * (_IP_UDP_BYTES + _ETHERNET_BYTES))


def ceiling_fps(payload_bytes: float, cameras: int, port: Port) -> float:
    """Frames a second of each camera at which the port is full."""
    return port.wire_bytes_s / (cameras * frame_cost(payload_bytes, port.mtu).wire_bytes)


def spread_for(share: float) -> float:
    """Share of the frame interval to send a frame over when all frames together take `share` of the port.

    Free-running cameras come to expose together, and stay so for minutes. Then all frames are sent at once,
    at a rate of share / spread of the port's, which must not exceed it.
    """
    needed = math.ceil(share / _FULL * _SPREAD_GRID - 1e-9) / _SPREAD_GRID
    return min(max(needed, AGENT_SPREAD), 1.0)


def plan_pacing(
    datagrams_s: Sequence[float], slots: int, spread: float, port: Port, agent: Port, buffer_bytes: int
) -> Pacing:
    """Steps so long that few wake-ups do, and so short that all bursts together fit the switch's buffer.

    `datagrams_s`: mean datagrams a second of each camera; `slots`: agents that share the step. Where the
    buffer is too small for steps of a millisecond, `backlog_bytes` says so and the slots must hold.
    """
    busiest = max(datagrams_s, default=0.0) / spread / 1e9  # datagrams a nanosecond while it sends
    if busiest == 0:
        return Pacing(_MAX_STEP_NS, spread, 0, 0)
    one = backlog_bytes(1, slots, port, agent)
    burst = _MAX_BURST if one == 0 else max(1, min(_MAX_BURST, int(buffer_bytes // one)))
    step_ns = int(min(max(burst / busiest, _MIN_STEP_NS), _MAX_STEP_NS))
    step_ns -= step_ns % _STEP_GRID_NS
    burst = math.ceil(busiest * step_ns)
    return Pacing(step_ns, spread, burst, backlog_bytes(burst, slots, port, agent))


def backlog_bytes(burst: int, senders: int, port: Port, agent: Port) -> int:
    """What a switch holds at most when `senders` bursts meet: all that came, less what left meanwhile."""
    left_meanwhile = port.speed_mbit / agent.speed_mbit  # in bursts, while one burst arrives
    return math.ceil(max(0.0, senders - left_meanwhile) * burst * wire_size(port.datagram_size))
