"""What a camera sends on each level."""

import pytest

from rig_protocol.codecs import codec, codec_by_name
from rig_protocol.message_bytes import MIN_FPS
from rig_server.stream_ladder import TOP, Level, Manner, ladder, streams_at
from support.wire import make_hello

JPEG_30, LOSSLESS_30 = Level(Manner.JPEG, 1), Level(Manner.LOSSLESS, 1)


def ids(*names: str) -> tuple[int, ...]:
    return tuple(codec_by_name(name).id for name in names)


LOSSLESS_FIRST = ids("bayer-lossless", "bayer-uncompressed", "bgr-jpeg")
RAW_FIRST = ids("bayer-uncompressed", "bayer-lossless", "bgr-jpeg")
JPEG_FIRST = ids("bgr-jpeg", "bayer-lossless", "bayer-uncompressed")
DEPTH = ids("disparity-lossless", "disparity-uncompressed")


@pytest.mark.parametrize(
    ("offered", "names"),
    [
        (LOSSLESS_FIRST, ["bayer-lossless", "bayer-lossless", "bgr-jpeg"]),
        (RAW_FIRST, ["bayer-uncompressed", "bayer-lossless", "bgr-jpeg"]),
        (JPEG_FIRST, ["bgr-jpeg", "bgr-jpeg", "bgr-jpeg"]),
        (LOSSLESS_FIRST[:1], ["bayer-lossless"] * 3),
        (ids("bgr-uncompressed"), ["bgr-uncompressed"] * 3),
    ],
)
def test_each_manner_is_the_smallest_that_an_agent_offers_for_it(
    offered: tuple[int, ...], names: list[str]
) -> None:
    hello = make_hello(color_codecs=offered, depth_codecs=DEPTH)
    chosen = [streams_at(hello, Level(manner, 1), 30.0).color_codec for manner in Manner]
    assert [codec(one).name for one in chosen if one is not None] == names


@pytest.mark.parametrize("level", ladder(allow_jpeg=True))
def test_depth_is_lossless_on_every_level(level: Level) -> None:
    hello = make_hello(color_codecs=LOSSLESS_FIRST, depth_codecs=DEPTH[::-1])
    depth_codec = streams_at(hello, level, 30.0).depth_codec
    assert depth_codec is not None
    assert codec(depth_codec).lossless


def test_the_order_of_steps_is_lossless_then_jpeg_then_fewer_frames() -> None:
    levels = ladder(allow_jpeg=True)
    assert list(levels) == sorted(levels)
    assert levels[:4] == (TOP, LOSSLESS_30, JPEG_30, Level(Manner.JPEG, 2))
    rates = [30.0 / level.divisor for level in levels[2:]]
    assert rates[:4] == [30.0, 15.0, 10.0, 7.5]


def test_without_jpeg_fewer_frames_come_next() -> None:
    assert ladder(allow_jpeg=False)[2] == Level(Manner.LOSSLESS, 2)


def test_a_slower_camera_keeps_its_rate_until_the_fast_ones_are_as_slow() -> None:
    hello = make_hello(fps=10.0)
    rates = [streams_at(hello, Level(Manner.JPEG, divisor), 30.0).fps for divisor in (1, 2, 3, 4, 6)]
    assert rates == [10.0, 10.0, 10.0, 5.0, 5.0]


def test_no_rate_is_slower_than_the_protocol_can_say() -> None:
    assert streams_at(make_hello(fps=0.5), Level(Manner.JPEG, 30), 0.5).fps == MIN_FPS


def test_a_stream_that_does_not_exist_is_never_chosen_nor_a_codec_of_a_later_release() -> None:
    hello = make_hello(color_codecs=(250,), depth_codecs=())
    assert streams_at(hello, TOP, 30.0).codecs == ()
