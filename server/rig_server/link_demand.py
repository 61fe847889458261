"""What the cameras of a rig ask of the link on every level, by what is known of their images."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from rig_protocol.codecs import codec
from rig_protocol.frames import EncodedFrame
from rig_protocol.messages import Hello
from rig_server.config import LinkSettings
from rig_server.link_budget import Pacing, Port, frame_cost, plan_pacing, spread_for
from rig_server.stream_ladder import Level, Streams, streams_at
from rig_server.stream_sizes import MeasuredSizes, planned_bytes


@dataclass(frozen=True, slots=True)
class Demand:
    """The rig on one level. Loads in bytes a second; `agent_wire_bytes_s`: of the busiest camera.

    `cameras` are those that load the port, with those that are still expected.
    """

    streams: Mapping[int, Streams]
    cameras: int
    fps: float
    udp_bytes_s: float
    wire_bytes_s: float
    agent_wire_bytes_s: float
    datagrams_s: tuple[float, ...]


@dataclass(slots=True)
class _Camera:
    hello: Hello
    on_this_machine: bool
    sizes: MeasuredSizes
    received: int = 0

    @property
    def loads_the_port(self) -> bool:
        streams = self.hello.color_codecs or self.hello.depth_codecs
        return bool(streams) and not self.on_this_machine


@dataclass(slots=True)
class LinkDemand:
    """The cameras that are here, and room for those that are expected."""

    settings: LinkSettings
    expected: int = 0
    _cameras: dict[int, _Camera] = field(default_factory=dict)
    _sizes: dict[int, MeasuredSizes] = field(default_factory=dict)  # also of cameras that left; one a slot

    @property
    def port(self) -> Port:
        """Of the server."""
        return Port(self.settings.speed_mbit, self.settings.mtu)

    @property
    def agent_port(self) -> Port:
        """Of each agent."""
        return Port(self.settings.agent_speed_mbit, self.settings.mtu)

    @property
    def slots(self) -> int:
        """Cameras that share a step."""
        return max(self.expected, len(self._cameras))

    @property
    def camera_ids(self) -> list[int]:
        """Of the cameras that are here, ascending."""
        return sorted(self._cameras)

    @property
    def remote_ids(self) -> list[int]:
        """Of those that load the port: not on this machine, and not those that only record on theirs."""
        return [i for i in self.camera_ids if self._cameras[i].loads_the_port]

    @property
    def received(self) -> dict[int, int]:
        """Frames of each camera that loads the port, since it joined."""
        return {camera_id: self._cameras[camera_id].received for camera_id in self.remote_ids}

    def join(self, camera_id: int, hello: Hello, on_this_machine: bool) -> None:
        """A camera has come, or come again."""
        sizes = self._sizes.setdefault(camera_id, MeasuredSizes())
        self._cameras[camera_id] = _Camera(hello, on_this_machine, sizes)

    def leave(self, camera_id: int) -> None:
        """A camera has gone; harmless when it already had."""
        self._cameras.pop(camera_id, None)

    def frame_received(self, frame: EncodedFrame, now_ns: int) -> None:
        """Count a frame; one of a camera that is not here has no effect."""
        camera = self._cameras.get(frame.camera_id)
        if camera is not None:
            camera.received += 1
            camera.sizes.add(frame, now_ns)

    def at(self, level: Level, now_ns: int) -> Demand:
        """The demand on one level; a camera that is still expected asks for the mean of the others."""
        top_fps = max((camera.hello.fps for camera in self._cameras.values()), default=0.0)
        streams = {i: streams_at(camera.hello, level, top_fps) for i, camera in self._cameras.items()}
        remote = self.remote_ids
        costs = [frame_cost(self._frame_bytes(i, streams[i], now_ns), self.settings.mtu) for i in remote]
        rates = [streams[i].fps for i in remote]
        absent = max(self.expected - len(self._cameras), 0) if remote else 0
        # Of cameras on this machine, as many of the absent ones are on it, too.
        factor = 1 + absent / max(1, len(self._cameras))
        wire = [cost.wire_bytes * fps for cost, fps in zip(costs, rates, strict=True)]
        return Demand(
            streams,
            cameras=round(len(remote) * factor),
            fps=max((one.fps for one in streams.values()), default=0.0),
            udp_bytes_s=factor * sum(cost.udp_bytes * fps for cost, fps in zip(costs, rates, strict=True)),
            wire_bytes_s=factor * sum(wire),
            agent_wire_bytes_s=max(wire, default=0.0),
            datagrams_s=tuple(cost.datagrams * fps for cost, fps in zip(costs, rates, strict=True)),
        )

    def fits(self, demand: Demand, share: float = 1.0) -> bool:
        """True when the ports carry it; `share` of what may be used of them."""
        usable = self.settings.usable * share
        return (
            demand.wire_bytes_s <= usable * self.port.wire_bytes_s
            and demand.agent_wire_bytes_s <= usable * self.agent_port.wire_bytes_s
        )

    def pacing(self, demand: Demand) -> Pacing:
        """Steps and bursts for a demand."""
        spread = spread_for(demand.wire_bytes_s / self.port.wire_bytes_s)
        buffer_bytes = self.settings.switch_buffer_kib * 1024
        return plan_pacing(demand.datagrams_s, self.slots, spread, self.port, self.agent_port, buffer_bytes)

    def _frame_bytes(self, camera_id: int, streams: Streams, now_ns: int) -> float:
        return sum(self._image_bytes(camera_id, one, now_ns) for one in streams.codecs)

    def _image_bytes(self, camera_id: int, codec_id: int, now_ns: int) -> float:
        camera = self._cameras[camera_id]
        measured = camera.sizes.mean(codec_id, now_ns)
        if measured is not None:
            return measured
        model = camera.hello.model
        depth = model.depth if codec(codec_id).image in ("raw", "depth_mm") else None
        grid = depth or model.color  # registered depth lies on the colour camera's grid
        return planned_bytes(codec_id, grid.width * grid.height, self.settings.size_margin)
