"""The live rig's status, read from all its parts at one moment."""

import threading
from collections.abc import Mapping
from dataclasses import asdict

from rig_protocol.messages import Hello
from rig_protocol.server_link import ServerLink
from rig_protocol.server_session import CameraStatus
from rig_server.assembler import Assembler
from rig_server.config import RigSettings
from rig_server.decoder import FrameDecoder
from rig_server.description import camera_names
from rig_server.durations import Durations, RecentDurations
from rig_server.metrics import TEMPERATURE, CameraMetrics, RateMeter, RigStatus, summarise_sets
from rig_server.receiver import Receiver, rig_time_ns
from rig_server.stream_control import StreamControl


class StatusReader:
    """Reads counters that other threads write; they are never kept waiting for longer than a copy takes."""

    def __init__(
        self,
        settings: RigSettings,
        link: ServerLink,
        receiver: Receiver,
        decoder: FrameDecoder,
        assembler: Assembler,
        durations: Durations,
        streams: StreamControl,
    ) -> None:
        self._settings = settings
        self._link, self._receiver, self._streams = link, receiver, streams
        self._decoder, self._assembler, self._durations = decoder, assembler, durations
        self._one_reader = threading.Lock()  # the terminal and the metrics endpoint ask; guards what follows
        self._rates, self._recent = RateMeter(), RecentDurations()

    def read(self, hellos: Mapping[int, Hello]) -> RigStatus:
        """The rig at this moment; `hellos`: of every camera so far."""
        with self._one_reader:
            return self._read(hellos, rig_time_ns())

    def _read(self, hellos: Mapping[int, Hello], now_ns: int) -> RigStatus:
        assembler, durations = self._assembler, self._durations.snapshot()
        sets_per_s, spread_ms, often_missing = summarise_sets(
            assembler.recent, now_ns, assembler.recent_incomplete
        )
        return RigStatus(
            authenticated=self._link.authenticated,
            turns=self._receiver.turns,
            cameras=self._cameras(hellos, now_ns),
            complete=assembler.complete,
            partial=assembler.partial,
            sets_per_s=sets_per_s,
            spread_ms=spread_ms,
            often_missing=often_missing,
            dropped=self._dropped(),
            repeated=assembler.repeated,
            rejected=dict(self._link.rejected),  # one step: the receiver's thread adds causes
            queues=self._queues(),
            unread_bytes=self._receiver.waiting_bytes,
            durations=durations,
            recent=self._recent.update(durations, now_ns),
            link=self._streams.summary,
        )

    def _cameras(self, hellos: Mapping[int, Hello], now_ns: int) -> tuple[CameraMetrics, ...]:
        known = dict(self._link.cameras)
        rates = self._rates.update({i: camera.counters.frames for i, camera in known.items()}, now_ns)
        undecodable, not_decoded = self._decoder.undecodable_by_camera, self._decoder.dropped_by_camera
        cameras = []
        for camera_id, name in sorted(camera_names(self._settings, hellos).items()):
            if camera_id not in known:
                cameras.append(CameraMetrics(camera_id, name, connected=False))
                continue
            dropped = {
                "late": self._assembler.late(camera_id),
                "undecodable": undecodable[camera_id],
                "not_decoded_in_time": not_decoded[camera_id],
            }
            cameras.append(_camera(name, known[camera_id], rates[camera_id], dropped))
        return tuple(cameras)

    def _dropped(self) -> dict[str, int]:
        return {
            "incomplete sets": self._assembler.incomplete,
            "sets not taken": self._assembler.overrun,
            "frames left out of sets": self._assembler.skipped,
            "frames of implausible time": self._assembler.implausible,
            "frames not decoded in time": self._decoder.dropped,
            "datagrams by the kernel": self._receiver.kernel_drops,
            "answers that the network refused": self._receiver.unsent,
        }

    def _queues(self) -> dict[str, int]:
        return {
            "decoder": self._decoder.waiting,
            "synchroniser": self._assembler.waiting,
            "sets": self._assembler.ready,
        }


def _camera(name: str, camera: CameraStatus, fps: float, dropped: Mapping[str, int]) -> CameraMetrics:
    counters, clock = camera.counters, camera.clock
    return CameraMetrics(
        camera.camera_id,
        name,
        camera.connected,
        fps=fps,
        frames=counters.frames,
        lost=counters.lost,
        late=dropped["late"],
        damaged=counters.damaged,
        duplicate=counters.duplicate,
        corrupt=counters.corrupt + dropped["undecodable"],
        resent=counters.resent,
        clock_error_us=None if clock is None else clock.uncertainty_ns / 1e3,
        temperature_c=camera.health.get(TEMPERATURE),
        counters=asdict(counters),
        dropped=dropped,
        gauges=dict(camera.health),
        clock=clock,
    )
