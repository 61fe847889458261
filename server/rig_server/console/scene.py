"""The live cloud and the cameras' frustums in 3-D, by viser, whose port serves our own proxy alone."""

import contextlib
import hmac
import logging
import math
import secrets
import threading
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import rich
import viser
import viser.transforms
import websockets.asyncio.server

from rig_calib.fusion.live import FusedFrame
from rig_calib.fusion.viewpoint import rig_viewpoint
from rig_calib.rig_calibration import RigCalibration
from rig_protocol.camera import CameraModel
from rig_protocol.poses import Pose

GUARD_HEADER = "X-Rig-Scene"
_FRUSTUM_M = 0.12
_POINT_M = 0.014
_CALM_RGB, _ALARM_RGB = (96, 140, 190), (214, 64, 52)
_MAX_MESSAGE_BYTES = 1 << 20  # of what a page sends

_port_log = logging.getLogger(f"{__name__}.port")
_port_log.setLevel(logging.ERROR)  # connections are no news


class Scene:
    """viser on a free loopback port that answers only who knows `secret`; any thread may draw."""

    def __init__(self, most_points: int) -> None:
        self.secret = secrets.token_urlsafe(24)
        self._most_points = most_points
        self._drawing = threading.Lock()  # guards what follows
        self._jitter = np.random.default_rng(0).random(most_points)
        self._cloud: viser.PointCloudHandle | None = None
        self._frustums: dict[int, viser.CameraFrustumHandle] = {}
        rich.get_console().quiet = True  # viser tells there that it has stopped
        with _guarded(self.secret):
            self._server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        self._server.gui.configure_theme(show_logo=False, show_share_button=False)

    @property
    def address(self) -> str:
        """Where the proxy finds it: HOST:PORT."""
        return f"127.0.0.1:{self._server.get_port()}"

    def close(self) -> None:
        """End; harmless when already ended."""
        self._server.stop()

    def place(self, calibration: RigCalibration | None, models: Mapping[int, CameraModel]) -> None:
        """Draw the cameras of a calibration instead of what was there."""
        with self._drawing, self._server.atomic():
            self._clear()
            if calibration is None or not calibration.poses:
                return
            view = rig_viewpoint(calibration.poses, calibration.rig_frame).T_rig_view
            self._look_from(view)
            for camera_id, T_rig_camera in calibration.poses.items():
                model = models.get(camera_id, CameraModel()).color
                self._frustums[camera_id] = self._server.scene.add_camera_frustum(
                    f"/cameras/{camera_id:02d}",
                    fov=2 * math.atan2(model.height / 2, model.fy),
                    aspect=model.width / model.height,
                    scale=_FRUSTUM_M,
                    color=_CALM_RGB,
                    wxyz=viser.transforms.SO3.from_matrix(T_rig_camera[:3, :3]).wxyz,
                    position=T_rig_camera[:3, 3],
                    cast_shadow=False,
                    receive_shadow=False,
                )

    def alarm(self, camera_ids: frozenset[int]) -> None:
        """Have these cameras stand out."""
        with self._drawing:
            for camera_id, frustum in self._frustums.items():
                color = _ALARM_RGB if camera_id in camera_ids else _CALM_RGB
                if tuple(np.asarray(frustum.color).tolist()) != color:
                    frustum.color = color

    def show(self, fused: FusedFrame) -> None:
        """Draw a cloud, thinned evenly to the most points that a page is sent; copies what it needs."""
        points, colors = self._thinned(fused)
        with self._drawing, self._server.atomic():
            if self._cloud is None:
                self._cloud = self._server.scene.add_point_cloud(
                    "/cloud", points, colors, point_size=_POINT_M, point_shape="rounded", point_shading="flat"
                )
            else:
                self._cloud.points, self._cloud.colors = points, colors

    def _thinned(self, fused: FusedFrame) -> tuple[Any, Any]:
        count = len(fused.points_m)
        if count <= self._most_points:
            return fused.points_m.copy(), fused.colors.copy()
        # One of every stretch, at a place that stays: the cloud does not flicker and has no stripes.
        stretch = count / self._most_points
        rows = ((np.arange(self._most_points) + self._jitter) * stretch).astype(np.int64)
        return fused.points_m[rows], fused.colors[rows]

    def _clear(self) -> None:
        for frustum in self._frustums.values():
            frustum.remove()
        self._frustums.clear()
        if self._cloud is not None:
            self._cloud.remove()
            self._cloud = None

    def _look_from(self, T_rig_view: Pose) -> None:
        """From behind and above, down on the rig."""
        up, centre = T_rig_view[:3, 2], T_rig_view[:3, 3]
        eye = T_rig_view @ np.array([-2.3, -1.9, 2.6, 1.0])
        self._server.scene.set_up_direction(up)
        camera = self._server.initial_camera
        camera.up, camera.look_at, camera.position = up, centre, eye[:3]


@contextlib.contextmanager
def _guarded(secret: str) -> Iterator[None]:
    """Have a server that viser makes meanwhile refuse every request without the secret.

    viser has no hook for it; the library that it serves with has. Whoever else is logged in to this machine
    can reach the port.
    """
    serve = websockets.asyncio.server.serve
    expected = secret.encode()

    def guarded_serve(handler: Any, host: str, port: int, *, process_request: Any, **options: Any) -> Any:
        def answer(connection: websockets.asyncio.server.ServerConnection, request: Any) -> Any:
            told = request.headers.get_all(GUARD_HEADER)
            if len(told) != 1 or not hmac.compare_digest(told[0].encode("utf-8", "replace"), expected):
                return connection.respond(403, "this port serves the console alone\n")
            return process_request(connection, request)

        options |= {"max_size": _MAX_MESSAGE_BYTES, "logger": _port_log}
        return serve(handler, host, port, process_request=answer, **options)

    websockets.asyncio.server.serve = guarded_serve  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        websockets.asyncio.server.serve = serve  # type: ignore[misc]
