"""The console of one rig: shows in a browser what is taken, and has done what a person wants."""

import threading
import time
from collections.abc import Mapping
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np

from rig_calib.fusion.live import FusedFrame
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.errors import ConfigurationError, RigError
from rig_protocol.frames import ImageU8, PanoramicFrame
from rig_server.calibration_session import CalibrationSession
from rig_server.capture_log import CaptureLog
from rig_server.console.access import console_token
from rig_server.console.camera_pictures import Mode, distance_picture, jpeg
from rig_server.console.picture_guide import PictureGuide
from rig_server.console.scene import Scene
from rig_server.console.scene_proxy import SceneProxy
from rig_server.console.state import Moment, health_history, latest_health, page_state
from rig_server.console.tiles import tile_round
from rig_server.console.viewer import picture_message
from rig_server.console.web_server import WebServer
from rig_server.durations import RecentDurations
from rig_server.health_history import HealthHistory
from rig_server.histogram import Histogram, HistogramSnapshot
from rig_server.latest_only import LatestOnly
from rig_server.operator_actions import RigActions
from rig_server.receiver import rig_time_ns
from rig_server.rig import Rig
from rig_server.sinks.fuse import FuseSink

_TILE_NICENESS = 2  # receiving and decoding come first
_GUIDE_AGE_S = 2.0  # what is known of the cameras may mean reading files
_STRIP_PX = 1600
_LATENCY = "received_to_painted"
_LATENCY_MS = (
    5,
    10,
    15,
    20,
    30,
    40,
    50,
    60,
    75,
    100,
    125,
    150,
    175,
    200,
    250,
    300,
    400,
    500,
    1000,
    2000,
    5000,
)
_NOTHING = b""


class RigConsole:
    """Runs from `with` to the end of the block; the rig hands it every set.

    It sees a calibration that waits for its decision as if it were in force: that is its preview.
    """

    def __init__(self, rig: Rig, looked_on: CaptureLog | None = None) -> None:
        """Binds its port. `looked_on`: a calibration that others make, which a person can look on only.

        RigError when the port is in use, ConfigurationError when address or token make no sense.
        """
        self._orders = looked_on is None
        settings = rig.settings.console
        self._rig = rig
        self._session = CalibrationSession(rig, settings.folder)
        if looked_on is not None:
            self._session.look_on(looked_on)
        self._actions = RigActions(rig, self._session)
        self._place = rig.place  # the rig may end before its console
        self._history = HealthHistory()
        self._latency, self._recent_latency = (
            Histogram([ms * 1_000_000 for ms in _LATENCY_MS]),
            RecentDurations(),
        )
        self._last_s: dict[int, float] = {}
        self._guide: tuple[PictureGuide, RigCalibration | None, float] | None = None
        self._placed: object = _NOTHING
        self._stating = threading.Lock()  # pages and the clock ask for the state; guards what it remembers
        token = console_token(settings.token_file)
        self._scene = Scene(settings.cloud_points)
        address = settings.address
        assert address is not None  # noqa: S101  # only then there is a console
        try:
            self._server = WebServer(
                address, token, self, SceneProxy(self._scene.address, self._scene.secret)
            )
        except BaseException:
            self._scene.close()
            raise
        told = token if settings.token_file is None else f"(what {settings.token_file} holds)"
        self.link = f"{self._server.url}?token={told}"
        self._tiles = LatestOnly[tuple[PanoramicFrame, int]](
            "tiles", self._make_tiles, 1 / settings.tile_hz, _TILE_NICENESS
        )
        self._fuse = FuseSink(
            self._calibration,
            lambda: rig.description,
            self._show,
            1 / settings.fused_hz,
            match_colors=settings.match_colors,
        )

    def __enter__(self) -> Self:
        """Begin."""
        self._rig.on_set(self.offer)
        self._tiles.start()
        self._fuse.start()
        self._server.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """End."""
        self._server.__exit__(kind, error, trace)
        self._fuse.stop()
        self._tiles.stop()
        self._actions.close()
        self._session.close()
        self._scene.close()

    def offer(self, panorama: PanoramicFrame) -> None:
        """Show this set, if anybody looks and there is time; never waits."""
        now_s = time.monotonic()
        for camera_id, frame in panorama.frames.items():
            if frame is not None:
                self._last_s[camera_id] = now_s
        self._session.offer(panorama)
        if self._server.watched:
            self._tiles.offer((panorama, rig_time_ns()))
            self._fuse.offer(panorama)

    def latency(self) -> HistogramSnapshot:
        """From a frame's last datagram to its painted tile, the page's word back included; since start."""
        return self._latency.snapshot()

    def state(self) -> dict[str, Any]:
        """What every page is told."""
        with self._stating:
            status, now_s = self._rig.status(), time.monotonic()
            self._history.sample(status, now_s)
            self._place_cameras()
            if status.drift is not None:
                self._scene.alarm(frozenset(camera.camera for camera in status.drift.status.moved))
            recent = self._recent_latency.update({_LATENCY: self._latency.snapshot()}, rig_time_ns())
            moment = Moment(
                place=self._place,
                ended=self._rig.ended,
                status=status,
                hellos=self._rig.hellos,
                calibration=self._rig.calibration,
                session=self._session.view,
                fusion=self._fuse.report(),
                latency=recent[_LATENCY],
                orders=self._orders,
                tiles_trouble=self._tiles.failure,
                health=latest_health(self._history, tuple(one.camera_id for one in status.cameras)),
                away_s={camera_id: now_s - last_s for camera_id, last_s in dict(self._last_s).items()},
            )
        return page_state(moment)

    def history(self) -> dict[str, Any]:
        """The last minutes of everybody's health."""
        ids = tuple(camera.camera_id for camera in self._rig.status().cameras)
        return health_history(self._history, ids, time.monotonic())

    def act(self, action: str, wanted: Mapping[str, Any]) -> str:
        """Do what a person wants; a sentence about it."""
        if not self._orders:
            raise RigError("the command line has this rig calibrated: one can only look on")
        match action:
            case "identify":
                return self._actions.identify(_camera(wanted))
            case "expose":
                return self._actions.expose(_camera(wanted), wanted.get("auto") is True)
            case "start-recording":
                return self._actions.start_recording()
            case "stop-recording":
                return self._actions.stop_recording()
            case "start-calibration":
                return self._actions.start_calibration(_camera_name(wanted), wanted.get("coached") is True)
            case "cancel-calibration":
                return self._actions.cancel_calibration()
            case "accept-calibration":
                return self._actions.accept_calibration()
            case "reject-calibration":
                return self._actions.reject_calibration()
        raise ConfigurationError(f"this console cannot do {action!r}: load the page again")

    def painted(self, received_ns: tuple[int, ...]) -> None:
        """A page has painted tiles whose last datagrams had come then."""
        now_ns = rig_time_ns()
        for then_ns in received_ns:
            self._latency.observe(now_ns - then_ns)

    def _calibration(self) -> RigCalibration | None:
        return self._session.candidate or self._rig.calibration

    def _make_tiles(self, offered: tuple[PanoramicFrame, int]) -> None:
        panorama, offered_ns = offered
        looks = self._server.looks
        if looks:
            self._server.publish_tiles(tile_round(panorama, offered_ns, self._newest_guide(), looks))

    def _newest_guide(self) -> PictureGuide:
        calibration, now_s = self._calibration(), time.monotonic()
        if self._guide is not None:
            guide, of, made_s = self._guide
            if of is calibration and now_s - made_s < _GUIDE_AGE_S:
                return guide
        guide = PictureGuide.of(self._rig.description, calibration)
        self._guide = guide, calibration, now_s
        return guide

    def _show(self, fused: FusedFrame) -> None:
        modes = self._server.modes
        if not modes:
            return
        self._scene.show(fused)
        if modes != {Mode.DEPTH}:
            self._publish_strip(fused.panorama, (Mode.COLOR, Mode.OVERLAP))
        if Mode.DEPTH in modes:
            self._publish_strip(distance_picture(fused.panorama_depth_m), (Mode.DEPTH,))

    def _publish_strip(self, image: ImageU8, modes: tuple[Mode, ...]) -> None:
        message = picture_message({"kind": "panorama"}, [jpeg(_strip(image))])
        self._server.publish("panorama", message, modes)

    def _place_cameras(self) -> None:
        """Draw the cameras where the calibration has them, when it is another one."""
        calibration = self._calibration()
        if calibration is not self._placed:
            self._placed = calibration
            models = {camera.id: camera.model for camera in self._rig.description.cameras}
            self._scene.place(calibration, models)


def _strip(image: ImageU8) -> ImageU8:
    """A panorama in the size of a page."""
    height, width = image.shape[:2]
    if width <= _STRIP_PX:
        return image
    size = _STRIP_PX, max(round(height * _STRIP_PX / width), 1)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _camera(wanted: Mapping[str, Any]) -> int | str | None:
    camera = wanted.get("camera")
    if camera is None or isinstance(camera, str) or type(camera) is int:
        return camera
    raise ConfigurationError("a camera is a name or a number")


def _camera_name(wanted: Mapping[str, Any]) -> str | None:
    camera = _camera(wanted)
    return None if camera is None else str(camera)
