"""A rig in virtual time that does what a StreamPlanner tells it, on a port of true capacity."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache

from rig_protocol.codecs import codec_by_name
from rig_protocol.events import Address
from rig_protocol.frames import EncodedFrame, Payload
from rig_protocol.messages import Hello
from rig_server.link_budget import Port, frame_cost
from rig_server.stream_planner import Note, Refusal, StreamChoice, StreamPlanner
from support.wire import make_hello

SECOND_NS = 1_000_000_000
TICK_NS = SECOND_NS // 4
AWAY: Address = ("192.0.2.1", 40001)

LOSSLESS = codec_by_name("bayer-lossless").id
UNCOMPRESSED = codec_by_name("bayer-uncompressed").id
JPEG = codec_by_name("bgr-jpeg").id
DEPTH = codec_by_name("disparity-lossless").id

KINECT = make_hello(color_codecs=(LOSSLESS, UNCOMPRESSED, JPEG), depth_codecs=(DEPTH,), fps=30.0)


@cache
def _payload(codec_id: int, size: int) -> Payload:
    return Payload(codec_id, bytes(size))


@dataclass
class PlannedRig:
    """`sizes`: true bytes of an image by codec. `history`: (time, choice of the first camera, true load)."""

    planner: StreamPlanner
    sizes: dict[int, int]
    port: Port = field(default_factory=lambda: Port(1000))
    carries: float = 1.0  # what the port really carries, as a share of what the planner thinks
    extra_loss: float = 0.0
    now_ns: int = 100 * SECOND_NS
    history: list[tuple[int, StreamChoice, float]] = field(default_factory=list)
    notes: list[Note] = field(default_factory=list)
    _owed: dict[int, float] = field(default_factory=dict)
    _lost: dict[int, int] = field(default_factory=dict)

    def join(
        self, cameras: int, hello: Hello = KINECT, address: Address = AWAY, first: int = 0
    ) -> list[StreamChoice | Refusal]:
        """Cameras join one after another."""
        ids = range(first, first + cameras)
        return [self.planner.camera_joined(i, replace(hello, camera_id=i), address, self.now_ns) for i in ids]

    def leave(self, *camera_ids: int) -> None:
        """Cameras leave."""
        for camera_id in camera_ids:
            self.planner.camera_left(camera_id, self.now_ns)

    def run(self, seconds: float, scene: Callable[[float], dict[int, int]] | None = None) -> None:
        """Frames flow; `scene` gives the sizes by the time since the start of this run."""
        begun_ns = self.now_ns
        while self.now_ns < begun_ns + seconds * SECOND_NS:
            self.now_ns += TICK_NS
            if scene is not None:
                self.sizes = scene((self.now_ns - begun_ns) / SECOND_NS)
            self._tick()

    @property
    def load(self) -> float:
        """True share of the port."""
        total = sum(
            frame_cost(self._image(one.color_codec) + self._image(one.depth_codec)).wire_bytes * one.fps
            for one in self.planner.choices.values()
        )
        return total / self.port.wire_bytes_s

    @property
    def now(self) -> StreamChoice:
        """What the first camera sends."""
        return next(iter(self.planner.choices.values()))

    def changes(self) -> list[tuple[float, int | None, float]]:
        """(seconds since the start, colour codec, fps) whenever they changed."""
        changed: list[tuple[float, int | None, float]] = []
        for time_ns, choice, _ in self.history:
            state = (choice.color_codec, choice.fps)
            if not changed or changed[-1][1:] != state:
                changed.append(((time_ns - self.history[0][0]) / SECOND_NS, *state))
        return changed

    def _tick(self) -> None:
        load, arriving = self.load, 1.0 - self.extra_loss
        if load > self.carries:
            arriving *= max(0.0, 1 - 2 * (1 - self.carries / load))  # a frame is lost with any datagram
        for camera_id, choice in self.planner.choices.items():
            self._owed[camera_id] = self._owed.get(camera_id, 0.0) + choice.fps * TICK_NS / SECOND_NS
            frames = int(self._owed[camera_id])
            self._owed[camera_id] -= frames
            came = round(frames * arriving)
            self._lost[camera_id] = self._lost.get(camera_id, 0) + frames - came
            frame = self.frame(camera_id, choice)
            for _ in range(came):
                self.planner.frame_received(frame)
        self.planner.update(self.now_ns, self._lost)
        self.notes += self.planner.take_notes()
        if self.planner.choices:
            self.history.append((self.now_ns, self.now, self.load))

    def frame(self, camera_id: int, choice: StreamChoice) -> EncodedFrame:
        """A frame as the choice wants it."""
        payloads = [
            None if one is None else _payload(one, self._image(one))
            for one in (choice.color_codec, choice.depth_codec)
        ]
        return EncodedFrame(camera_id, 0, 0, color=payloads[0], depth=payloads[1])

    def _image(self, codec_id: int | None) -> int:
        return 0 if codec_id is None else self.sizes[codec_id]
