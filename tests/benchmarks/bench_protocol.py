"""Cost of the wire protocol a frame: sealing and cutting, and the server's link from datagrams to event.

Run: python tests/benchmarks/bench_protocol.py
"""

import random
import statistics
import time
from collections.abc import Callable
from dataclasses import replace

from rig_protocol.agent_link import AgentLink
from rig_protocol.camera import CameraModel
from rig_protocol.datagram import DatagramBatch
from rig_protocol.events import Address, FrameReceived
from rig_protocol.frames import EncodedFrame, Payload
from rig_protocol.messages import Hello
from rig_protocol.rig_key import RigKey
from rig_protocol.roster import Roster
from rig_protocol.security import Cipher
from rig_protocol.server_link import ServerLink

FRAME_BYTES = 240_000  # a lossless pair of the shared real frames
FRAMES = 300
AGENT: Address = ("192.0.2.1", 40001)
HELLO = Hello("cam", 0, "S0", None, CameraModel(), (1,), (2,), 30.0, "bench")


def connected(cipher: Cipher) -> tuple[AgentLink, ServerLink]:
    """Two links with a session and a known clock."""
    server = ServerLink(Roster(open=True), RigKey.INSECURE, random.Random(1).randbytes, (1,), (2,))
    agent = AgentLink(replace(HELLO, ciphers=(cipher,)), RigKey.INSECURE, random.Random(2).randbytes)
    for _ in range(4):
        for datagram in agent.datagrams_to_send(0):
            server.receive_datagram(datagram, AGENT, 0)
        server.handle_timeout(0)
        for datagram, _address in server.datagrams_to_send(0):
            agent.receive_datagram(datagram, 0)
    while server.next_event() is not None:
        pass
    return agent, server


def median_us(work: Callable[[DatagramBatch], None], batches: list[DatagramBatch]) -> float:
    """Median time of `work` over the batches, in microseconds."""
    times = []
    for batch in batches:
        start_ns = time.perf_counter_ns()
        work(batch)
        times.append(time.perf_counter_ns() - start_ns)
    return statistics.median(times) / 1e3


def receive_cost_us(cipher: Cipher, datagrams_at_once: int) -> tuple[float, int]:
    """Microseconds a frame at the server, and datagrams a frame."""
    agent, server = connected(cipher)
    batches = [batch for k in range(FRAMES) if (batch := agent.send_frame(make_frame(k), 0)) is not None]

    def receive(batch: DatagramBatch) -> None:
        for start in range(0, len(batch), datagrams_at_once):
            part = batch.part(start, start + datagrams_at_once)
            server.receive_batch(DatagramBatch(part, batch.segment_size), AGENT, 0)  # as a socket gives them
        assert isinstance(server.next_event(), FrameReceived)

    return median_us(receive, batches), len(batches[0])


def make_frame(sequence: int) -> EncodedFrame:
    """A frame whose payloads do not compress and cost nothing to make."""
    return EncodedFrame(
        0, sequence, 0, color=Payload(1, CONTENT[:180_000]), depth=Payload(2, CONTENT[180_000:])
    )


CONTENT = random.Random(1).randbytes(FRAME_BYTES)


def send_cost_us(cipher: Cipher) -> float:
    """Microseconds a frame at the agent."""
    agent, _ = connected(cipher)
    times = []
    for k in range(FRAMES):
        start_ns = time.perf_counter_ns()
        agent.send_frame(make_frame(k), 0)
        times.append(time.perf_counter_ns() - start_ns)
    return statistics.median(times) / 1e3


def main() -> None:
    """Print the table."""
    print(f"frame of {FRAME_BYTES} B, median of {FRAMES}")
    for cipher in Cipher:
        print(f"{cipher.name}\nagent, seal and cut:           {send_cost_us(cipher):7.0f} us a frame")
        for at_once in (44, 16, 4, 1):
            cost_us, count = receive_cost_us(cipher, at_once)
            print(
                f"server, {at_once:2d} datagrams at once:  {cost_us:7.0f} us a frame, "
                f"{cost_us / count:5.2f} us a datagram, {360 * cost_us / 1e4:5.1f} % of a core at 360 fps"
            )


if __name__ == "__main__":
    main()
