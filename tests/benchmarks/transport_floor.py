"""Section `floor`: processor time of our receive path over that of a bare loop that only receives.

python tests/benchmarks/transport_floor.py

The same traffic, from a process of its own, at the rig's rate. The bare loop waits and reads as the
receiver does, and looks at nothing; between them lie parsing, checking and reassembly of every datagram.
"""

import json
import select
import socket
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from rig_protocol.events import Address, CameraJoined, ServerEvent
from rig_protocol.server_link import ServerLink
from rig_server.receiver import rig_time_ns
from rig_server.udp_socket import ask_for_receive_buffer, bound_udp_socket, switch_on
from support.preencoded_sender import Play, encoded_file, sender_process
from support.receive_only import RECEIVE_BUFFER_BYTES, open_link, receive_only

CAMERAS, SECONDS, REPEATS = 12, 3.0, 5
_SETTLE_S = 0.5
_UDP_GRO = 104
_KEEP_ALIVE_S = 0.1
_CONTROL_BYTES = 300

CpuSeconds = Callable[[], float]


class BareLoop:
    """A thread that reads everything and keeps nothing.

    The agents' sessions need an answering server: until all have joined every datagram goes to a link;
    then it gets only what is too short for a fragment: clock replies and heartbeats, some 70 a second.
    """

    def __init__(self, use_gro: bool) -> None:
        self._socket = bound_udp_socket(("127.0.0.1", 0))
        ask_for_receive_buffer(self._socket, RECEIVE_BUFFER_BYTES)
        self._merged = use_gro and switch_on(self._socket, socket.IPPROTO_UDP, _UDP_GRO)
        self._link, self._joined = open_link(), 0
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="bare")
        self.bytes = 0
        self.address: Address = self._socket.getsockname()
        self._thread.start()

    @property
    def joined(self) -> int:
        """Cameras with a session."""
        return self._joined

    def cpu_s(self) -> float:
        """Processor time of the thread."""
        assert self._thread.ident is not None
        return time.clock_gettime(time.pthread_getcpuclockid(self._thread.ident))

    def stop(self) -> None:
        """End."""
        self._stopping.set()
        self._thread.join()
        self._socket.close()

    def _run(self) -> None:
        poller = select.poll()
        poller.register(self._socket, select.POLLIN)
        while not self._stopping.is_set() and self._joined < CAMERAS:
            poller.poll(10)
            self._introduce()
        buffer, ancillary_size = bytearray(65_536), socket.CMSG_SPACE(4)
        speak_s = 0.0
        while not self._stopping.is_set():
            poller.poll(10)
            try:
                while True:
                    if self._merged:
                        size, _, _, address = self._socket.recvmsg_into([buffer], ancillary_size)
                    else:
                        size, address = self._socket.recvfrom_into(buffer)
                    self.bytes += size
                    if size <= _CONTROL_BYTES:
                        self._link.receive_datagram(buffer[:size], address, rig_time_ns())
            except BlockingIOError:
                pass
            if (now_s := time.monotonic()) >= speak_s:
                speak_s = now_s + _KEEP_ALIVE_S
                self._speak()

    def _introduce(self) -> None:
        try:
            while True:
                data, address = self._socket.recvfrom(65_536)
                self._link.receive_datagram(data, address, rig_time_ns())
        except BlockingIOError:
            pass
        while (event := self._link.next_event()) is not None:
            self._joined += isinstance(event, CameraJoined)
        self._speak()

    def _speak(self) -> None:
        self._link.handle_timeout(rig_time_ns())
        for data, address in self._link.datagrams_to_send(rig_time_ns()):
            self._socket.sendto(data, address)


class WholePath:
    """The server's receiver and link, up to the event that a frame is whole."""

    def __init__(self, use_gro: bool) -> None:
        self._link: ServerLink = open_link()
        self.joined = 0
        self._receiver = receive_only(self._link, ("127.0.0.1", 0), self._on_event, use_gro)
        self._receiver.start()
        self.address = self._receiver.address

    @property
    def bytes(self) -> int:
        """Bytes of datagrams that belonged to a session."""
        return sum(camera.counters.bytes for camera in self._link.cameras.values())

    def cpu_s(self) -> float:
        """Processor time of the receiver's thread."""
        thread = next(thread for thread in threading.enumerate() if thread.name == "receiver")
        assert thread.ident is not None
        return time.clock_gettime(time.pthread_getcpuclockid(thread.ident))

    def stop(self) -> None:
        """End."""
        self._receiver.stop()

    def _on_event(self, event: ServerEvent) -> None:
        self.joined += isinstance(event, CameraJoined)


def run() -> dict[str, Any]:
    """The section `floor` of bench.json."""
    results: dict[str, Any] = {}
    with encoded_file() as (file, _):
        for way, use_gro in (("gro", True), ("plain", False)):
            pairs = [
                (cpu_s_per_gb(WholePath(use_gro), file), cpu_s_per_gb(BareLoop(use_gro), file))
                for _ in range(REPEATS)
            ]
            results[f"ratio_{way}"] = median(ours / bare for ours, bare in pairs)
            results[f"cpu_s_per_gb_{way}"] = median(ours for ours, _ in pairs)
            results[f"bare_cpu_s_per_gb_{way}"] = median(bare for _, bare in pairs)
    return results


def cpu_s_per_gb(receiver: WholePath | BareLoop, file: Path) -> float:
    """Of one receiver, over a few seconds of the stream; it is stopped then."""
    host, port = receiver.address
    play = Play(f"{host}:{port}", range(CAMERAS), seconds=SECONDS + 2 * _SETTLE_S)
    try:
        with sender_process(play, file):
            while receiver.joined < CAMERAS:
                time.sleep(0.01)
            time.sleep(_SETTLE_S)
            before_s, before_bytes = receiver.cpu_s(), receiver.bytes
            time.sleep(SECONDS)
            return (receiver.cpu_s() - before_s) / (receiver.bytes - before_bytes) * 1e9
    finally:
        receiver.stop()


def main() -> None:
    """Print the section."""
    print(json.dumps(run(), indent=1))


if __name__ == "__main__":
    main()
