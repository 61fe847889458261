"""Rules of the hello: what is offered follows from the source's images and the operator's wish."""

import pytest

from rig_agent.config import AgentSettings, Manner
from rig_agent.hello import make_hello
from rig_agent.sources.base import ColorImage, DepthImage, SourceDescription
from rig_protocol.camera import CameraModel
from rig_protocol.codecs import codec


def describe(
    color: ColorImage | None = "bayer", depth: DepthImage | None = "raw", camera_id: int | None = None
) -> SourceDescription:
    return SourceDescription("A1", "1-1.2", CameraModel(), 30.0, color, depth, camera_id)


def color_names(image: ColorImage, wanted: Manner) -> list[str]:
    hello = make_hello(AgentSettings(color=wanted), describe(color=image))
    return [codec(id_).name for id_ in hello.color_codecs]


@pytest.mark.parametrize(
    ("image", "wanted", "names"),
    [
        ("bayer", "lossless", ["bayer-lossless", "bayer-uncompressed", "bgr-jpeg"]),
        ("bayer", "raw", ["bayer-uncompressed", "bayer-lossless", "bgr-jpeg"]),
        ("bayer", "jpeg", ["bgr-jpeg", "bayer-lossless", "bayer-uncompressed"]),
        ("bgr", "jpeg", ["bgr-jpeg", "bgr-lossless", "bgr-uncompressed"]),
        ("grey", "jpeg", ["grey-jpeg", "grey-lossless", "grey-uncompressed"]),
        ("grey", "lossless", ["grey-lossless", "grey-uncompressed", "grey-jpeg"]),
    ],
)
def test_the_wanted_manner_comes_first_and_lossy_last_unless_wanted(
    image: ColorImage, wanted: Manner, names: list[str]
) -> None:
    assert color_names(image, wanted) == names


@pytest.mark.parametrize(("image", "name"), [("raw", "disparity-lossless"), ("depth_mm", "depth-lossless")])
def test_depth_is_offered_as_what_the_source_delivers(image: DepthImage, name: str) -> None:
    hello = make_hello(AgentSettings(), describe(depth=image))
    assert codec(hello.depth_codecs[0]).name == name


def test_a_stream_that_does_not_exist_is_not_offered() -> None:
    assert make_hello(AgentSettings(), describe(depth=None)).depth_codecs == ()
    assert make_hello(AgentSettings(), describe(color=None)).color_codecs == ()


def test_the_operators_slot_wins_over_the_recordings() -> None:
    assert make_hello(AgentSettings(), describe(camera_id=4)).camera_id == 4
    assert make_hello(AgentSettings(camera=2), describe(camera_id=4)).camera_id == 2
    assert make_hello(AgentSettings(), describe()).camera_id is None


def test_the_rate_is_the_slower_of_source_and_settings() -> None:
    assert make_hello(AgentSettings(), describe()).fps == 30.0
    assert make_hello(AgentSettings(fps=10), describe()).fps == 10.0
    assert make_hello(AgentSettings(fps=60), describe()).fps == 30.0
