"""Another transport, or ours, as two processes: one plays encoded frames, one counts those that came whole.

python tests/support/peer_program.py receive --peer zeromq --address 127.0.0.1:5000
python tests/support/peer_program.py send --peer zeromq --address 127.0.0.1:5000 --frames FILE --seconds 3

The receiver prints `ready`, and when nothing has come for a second one line of JSON. Ours is sent with
`preencoded_sender.py`.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from support.preencoded_frames import PreencodedFrames

_GOLDEN = 0.618034  # phases of cameras as in preencoded_sender
_IDLE_S = 1.0
_PATIENCE_S = 30.0
_QUEUE_FRAMES = 4  # of one camera at its sender: what an agent holds between encoder and network
_LCM_QUEUE = 100  # messages between LCM's receiving thread and the program; its default is 30
_LCM = "udpm://239.255.76.67:7667?ttl=1&recv_buf_size=8388608"


class FrameCount:
    """Frames and bytes that came, and the processor time of this process meanwhile."""

    def __init__(self) -> None:
        self.frames = self.bytes = 0
        self.first_s = self.last_s = self._begin_cpu_s = 0.0

    def add(self, size: int) -> None:
        """A whole frame is here."""
        self.last_s = time.monotonic()
        if not self.frames:
            self.first_s, self._begin_cpu_s = self.last_s, time.process_time()
        self.frames += 1
        self.bytes += size

    @property
    def over(self) -> bool:
        """Whether the stream has ended."""
        return self.frames > 0 and time.monotonic() - self.last_s > _IDLE_S

    def result(self) -> dict[str, float]:
        """To be printed."""
        return {
            "frames": self.frames,
            "bytes": self.bytes,
            "seconds": self.last_s - self.first_s,
            "cpu_s": time.process_time() - self._begin_cpu_s,
        }


class Publisher(Protocol):
    """Sends one camera's frame; False when it had to be given up."""

    def __call__(self, camera: int, frame: bytes) -> bool:
        """Never waits."""
        ...


def receive_lcm(_: str, count: FrameCount) -> Callable[[], None]:
    """Every camera's channel."""
    import lcm

    network = lcm.LCM(_LCM)
    network.subscribe("CAMERA.*", lambda _, data: count.add(len(data))).set_queue_capacity(_LCM_QUEUE)
    return lambda: network.handle_timeout(100)


def receive_zeromq(address: str, count: FrameCount) -> Callable[[], None]:
    """One pulling socket for all cameras."""
    import zmq

    puller = zmq.Context.instance().socket(zmq.PULL)
    puller.bind(f"tcp://{address}")

    def turn() -> None:
        if puller.poll(100):
            count.add(len(puller.recv(copy=False)))

    return turn


def receive_ours(address: str, count: FrameCount) -> Callable[[], None]:
    """The receive path of the server."""
    from rig_protocol.events import FrameReceived, ServerEvent
    from support.receive_only import open_link, receive_only

    def on_event(event: ServerEvent) -> None:
        if isinstance(event, FrameReceived):
            payloads = (event.frame.color, event.frame.depth)
            count.add(sum(len(payload.data) for payload in payloads if payload is not None))

    host, port = address.rsplit(":", 1)
    receive_only(open_link(), (host, int(port)), on_event).start()
    return lambda: time.sleep(0.1)


def publish_lcm(_: str, cameras: int) -> Publisher:  # noqa: ARG001  # channels need no opening
    """A channel a camera."""
    import lcm

    network = lcm.LCM(_LCM)

    def publish(camera: int, frame: bytes) -> bool:
        network.publish(f"CAMERA{camera}", frame)
        return True

    return publish


def publish_zeromq(address: str, cameras: int) -> Publisher:
    """A TCP connection a camera."""
    import zmq

    pushers = [zmq.Context.instance().socket(zmq.PUSH) for _ in range(cameras)]
    for pusher in pushers:
        pusher.setsockopt(zmq.SNDHWM, _QUEUE_FRAMES)
        pusher.connect(f"tcp://{address}")
    time.sleep(0.5)  # until the connections stand: ZeroMQ tells nobody

    def publish(camera: int, frame: bytes) -> bool:
        try:
            pushers[camera].send(frame, zmq.NOBLOCK, copy=False)
        except zmq.Again:
            return False
        return True

    return publish


RECEIVERS = {"lcm": receive_lcm, "zeromq": receive_zeromq, "ours": receive_ours}
PUBLISHERS = {"lcm": publish_lcm, "zeromq": publish_zeromq}


def receive(peer: str, address: str) -> dict[str, float]:
    """Count until the stream is over."""
    count = FrameCount()
    turn = RECEIVERS[peer](address, count)
    print("ready", flush=True)
    until_s = time.monotonic() + _PATIENCE_S
    while not count.over and (count.frames or time.monotonic() < until_s):
        turn()
    return count.result()


def send(
    publish: Publisher, frames: Sequence[bytes], cameras: int, fps: float, seconds: float
) -> dict[str, float]:
    """Play every camera at the rate, each at a phase of its own."""
    exposures = sorted(
        ((k + camera * _GOLDEN % 1) / fps, k, camera)
        for camera in range(cameras)
        for k in range(round(seconds * fps))
    )
    begin_s, begin_cpu_s, given_up = time.monotonic(), time.process_time(), 0
    for due_s, k, camera in exposures:
        time.sleep(max(0.0, begin_s + due_s - time.monotonic()))
        given_up += not publish(camera, frames[(camera + k) % len(frames)])
    cpu_s = time.process_time() - begin_cpu_s
    return {
        "submitted": len(exposures),
        "given_up": given_up,
        "cpu_s": cpu_s,
        "seconds": time.monotonic() - begin_s,
    }


def main() -> None:
    """Send or receive, and print the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("role", choices=["send", "receive"])
    parser.add_argument("--peer", choices=list(RECEIVERS), required=True)
    parser.add_argument("--address", required=True)
    parser.add_argument("--frames", type=Path)
    parser.add_argument("--cameras", type=int, default=12)
    parser.add_argument("--fps", type=float, default=30.0)
    parser.add_argument("--seconds", type=float, default=3.0)
    known = parser.parse_args()
    result: dict[str, Any]
    if known.role == "receive":
        result = receive(known.peer, known.address)
    else:
        encoded = PreencodedFrames.load(known.frames)
        frames = [color + depth for color, depth in encoded.pairs]
        publish = PUBLISHERS[known.peer](known.address, known.cameras)
        result = send(publish, frames, known.cameras, known.fps, known.seconds)
        time.sleep(0.5)  # ZeroMQ's own thread may still be sending
    print(json.dumps(result), flush=True)


if __name__ == "__main__":
    main()
