"""An agent in a thread of the test: tiny frames over real loopback UDP, through the protocol's own link."""

import contextlib
import secrets
import socket
import threading
import time
from types import TracebackType
from typing import Self

import numpy as np

from rig_protocol.agent_link import AgentLink
from rig_protocol.camera import CameraModel
from rig_protocol.codecs import codec_by_name
from rig_protocol.events import Address, ControlRequested
from rig_protocol.frames import EncodedFrame, Payload
from rig_protocol.messages import ControlValue, Hello
from rig_protocol.rig_key import RigKey

FPS = 50.0
COLOR, DEPTH = codec_by_name("bayer-uncompressed"), codec_by_name("disparity-uncompressed")
BAYER = np.arange(24, dtype=np.uint8).reshape(4, 6)
RAW = np.arange(24, dtype=np.uint16).reshape(4, 6)
"""Of camera 0; camera i sends RAW + i."""


class SmallAgent:
    """Streams tiny frames at 50 Hz from a thread until the block ends; `silent` keeps frames back.

    It does every control but `sing`, and lists them in `done`; after `depth` off its frames have none.
    """

    def __init__(self, camera_id: int, server: Address, silent: bool = False) -> None:
        hello = Hello(
            name=f"pi-{camera_id}",
            camera_id=camera_id,
            serial=f"S{camera_id}",
            port_path=None,
            model=CameraModel(),
            color_codecs=(COLOR.id,),
            depth_codecs=(DEPTH.id,),
            fps=FPS,
            software="test",
            controls=True,
        )
        self.done: list[tuple[str, ControlValue]] = []
        self._depth_on = True
        self.deaf = False
        self.ignored = 0  # controls, while deaf
        self.camera_id, self.silent = camera_id, silent
        self._link = AgentLink(hello, RigKey.INSECURE, secrets.token_bytes)
        self._link.report_health({"temperature_c": 50.0 + camera_id})
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(server)
        self._socket.settimeout(0.002)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()
        self._socket.close()

    def _run(self) -> None:
        interval_ns = int(1e9 / FPS)
        phase_ns = self.camera_id * 3_000_000
        sequence = time.monotonic_ns() // interval_ns
        while not self._stop.is_set():
            now_ns = time.monotonic_ns()
            if (now_ns - phase_ns) // interval_ns > sequence:
                sequence = (now_ns - phase_ns) // interval_ns
                self._send_frame(sequence, sequence * interval_ns + phase_ns)
            self._serve()
        self._link.close(time.monotonic_ns())
        self._serve()

    def _send_frame(self, sequence: int, timestamp_ns: int) -> None:
        frame = EncodedFrame(
            camera_id=self.camera_id,
            sequence=sequence,
            timestamp_ns=timestamp_ns,
            color=Payload(COLOR.id, COLOR.encode(BAYER)),
            depth=Payload(DEPTH.id, DEPTH.encode(RAW + self.camera_id)) if self._depth_on else None,
        )
        batch = None if self.silent else self._link.send_frame(frame, time.monotonic_ns())
        for datagram in batch or ():
            self._socket.send(datagram)

    def _serve(self) -> None:
        with contextlib.suppress(TimeoutError, ConnectionRefusedError):
            self._link.receive_datagram(self._socket.recv(2048), time.monotonic_ns())
        self._link.handle_timeout(time.monotonic_ns())
        while (event := self._link.next_event()) is not None:
            if isinstance(event, ControlRequested):
                self._obey(event)
        for datagram in self._link.datagrams_to_send(time.monotonic_ns()):
            self._socket.send(datagram)

    def leave(self) -> None:
        """Stop streaming before the block ends."""
        self._stop.set()

    def _obey(self, request: ControlRequested) -> None:
        if self.deaf:
            self.ignored += 1
            return
        if request.name == "sing":
            self._link.answer_control(request, done=False, text="it has depth")
            return
        self.done.append((request.name, request.value))
        if request.name == "depth":
            self._depth_on = bool(request.value)
        self._link.answer_control(request, done=True, text=f"{request.name} is {request.value}")
