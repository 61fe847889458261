"""The scene: its port serves our proxy alone, and the cloud that it is sent is bounded."""

import asyncio
import contextlib
from collections.abc import AsyncIterator, Iterator

import aiohttp
import numpy as np
import pytest
import viser
from aiohttp import web

from rig_calib.fusion.live import FusedFrame
from rig_protocol.camera import CameraModel
from rig_server.console.scene import GUARD_HEADER, Scene
from rig_server.console.scene_proxy import SceneProxy
from support.box_room import calibration_of, ring_poses

POINTS = 1000
PROTOCOL = f"viser-v{viser.__version__}"
CALIBRATION = calibration_of(ring_poses(2))
MODELS = dict.fromkeys(CALIBRATION.poses, CameraModel())


@pytest.fixture
def scene() -> Iterator[Scene]:
    made = Scene(POINTS)
    yield made
    made.close()


@contextlib.asynccontextmanager
async def proxied(scene: Scene) -> AsyncIterator[aiohttp.ClientSession]:
    """A page's view of the scene, without the console's door."""
    proxy = SceneProxy(scene.address, scene.secret)
    app = web.Application()
    app.router.add_get("/scene", proxy.handle)
    app.router.add_get("/scene/{path:.*}", proxy.handle)
    runner = web.AppRunner(app)
    await runner.setup()
    await proxy.open()
    try:
        await web.TCPSite(runner, "127.0.0.1", 0).start()
        host, port = runner.addresses[0][:2]
        async with aiohttp.ClientSession(f"http://{host}:{port}") as session:
            yield session
    finally:
        await runner.cleanup()
        await proxy.close()


def cloud(count: int) -> FusedFrame:
    points = np.linspace(0, 1, 3 * count, dtype=np.float32).reshape(-1, 3)
    nothing = np.zeros((4, 4), np.float32)
    return FusedFrame(
        index=0,
        timestamp_ns=0,
        points_m=points,
        colors=np.full((count, 3), 99, np.uint8),
        camera_ids=(0,),
        starts=np.array([0, count]),
        panorama=np.zeros((4, 4, 3), np.uint8),
        panorama_depth_m=nothing,
        skipped=(),
    )


def test_another_user_of_this_machine_gets_nothing_from_its_port(scene: Scene) -> None:
    async def ask() -> None:
        async with aiohttp.ClientSession(f"http://{scene.address}") as session:
            for headers in ({}, {GUARD_HEADER: ""}, {GUARD_HEADER: "guess"}, {GUARD_HEADER: "\xe9"}):
                async with session.get("/", headers=headers) as answer:
                    assert answer.status == 403
                with pytest.raises(aiohttp.WSServerHandshakeError) as refused:
                    await session.ws_connect("/", protocols=[PROTOCOL], headers=headers)
                assert refused.value.status == 403
            async with session.get("/", headers={GUARD_HEADER: scene.secret}) as answer:
                assert answer.status == 200

    asyncio.run(ask())


def test_the_proxy_passes_page_and_socket_on(scene: Scene) -> None:
    scene.place(CALIBRATION, MODELS)
    scene.show(cloud(5000))

    async def ask() -> int:
        async with proxied(scene) as session:
            async with session.get("/scene/") as answer:
                assert ":has(canvas)" in await answer.text()
                assert "Content-Encoding" in answer.headers
            async with session.get("/scene/%2e%2e/_viser.py") as answer:
                assert answer.status == 404
            async with session.ws_connect("/scene", protocols=[PROTOCOL], max_msg_size=0) as page:
                assert page.protocol == PROTOCOL
                size = 0
                while size < POINTS * 9:  # until the cloud has come: half floats and colours
                    size = len(await page.receive_bytes(timeout=20))
            return size

    assert asyncio.run(ask()) < 3 * POINTS * 9


def test_the_cloud_is_thinned_evenly_and_stays_where_it_is(scene: Scene) -> None:
    whole = cloud(5000)
    points, colors = scene._thinned(whole)
    again, _ = scene._thinned(whole)
    assert points.shape == colors.shape == (POINTS, 3)
    assert np.array_equal(points, again)
    steps = np.diff(points[:, 0])
    assert steps.min() > 0
    assert steps.max() < 3 * steps.mean()


def test_what_is_shown_is_copied_for_the_fusion_writes_its_arrays_anew(scene: Scene) -> None:
    whole = cloud(500)
    scene.show(whole)
    whole.points_m[:] = -1
    assert scene._cloud is not None
    assert scene._cloud.points.min() >= 0


def test_another_calibration_takes_the_place_of_the_one_before(scene: Scene) -> None:
    scene.place(CALIBRATION, MODELS)
    scene.show(cloud(10))
    scene.alarm(frozenset([1]))
    scene.place(calibration_of(ring_poses(3)), MODELS)
    assert len(scene._frustums) == 3
    assert scene._cloud is None
    scene.place(None, {})
    assert scene._frustums == {}


def test_a_closed_scene_is_drawn_no_more(scene: Scene) -> None:
    scene.close()
    scene.close()
