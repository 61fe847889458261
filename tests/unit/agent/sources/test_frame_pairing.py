"""Which colour image belongs to which depth image."""

import numpy as np
import pytest

from rig_agent.sources.frame_pairing import FramePairer, Stream, StreamImage

FRAME = 2_000_000  # ticks at 30 Hz
IMAGE = np.zeros((1, 1), np.uint8)


def image(stream: Stream, ticks: int) -> StreamImage:
    return StreamImage(stream, ticks % 2**32, 0, IMAGE, damaged=False)


def pairs_of(*images: StreamImage) -> tuple[list[tuple[int, int]], int]:
    """(depth ticks, video ticks) of each pair, and the number of unpaired images."""
    pairer = FramePairer()
    pairs = [pair for pair in map(pairer.add, images) if pair]
    return [(pair.depth.ticks, pair.video.ticks) for pair in pairs], pairer.unpaired


@pytest.mark.parametrize("order", [("video", "depth"), ("depth", "video")])
def test_images_of_one_instant_pair_in_either_order(order: tuple[Stream, Stream]) -> None:
    pairs, unpaired = pairs_of(image(order[0], 1000), image(order[1], 1000))
    assert (pairs, unpaired) == ([(1000, 1000)], 0)


@pytest.mark.parametrize(("apart", "together"), [(FRAME // 2, True), (FRAME // 2 + 1, False)])
def test_half_a_frame_is_the_limit(apart: int, together: bool) -> None:
    assert bool(pairs_of(image("video", 0), image("depth", apart))[0]) is together
    assert bool(pairs_of(image("depth", 0), image("video", apart))[0]) is together


def test_a_missing_depth_image_leaves_its_colour_image_unpaired_and_no_other() -> None:
    pairs, unpaired = pairs_of(
        image("video", 0), image("video", FRAME), image("depth", FRAME), image("video", 2 * FRAME)
    )
    assert (pairs, unpaired) == ([(FRAME, FRAME)], 1)


def test_an_image_that_comes_too_late_does_not_take_the_next_partner() -> None:
    pairs, unpaired = pairs_of(image("video", 3 * FRAME), image("depth", FRAME), image("depth", 3 * FRAME))
    assert (pairs, unpaired) == ([(3 * FRAME, 3 * FRAME)], 1)


def test_pairs_form_across_the_wrap_of_the_counter() -> None:
    pairs, unpaired = pairs_of(image("video", 2**32 - 100), image("depth", 100))
    assert (pairs, unpaired) == ([(100, 2**32 - 100)], 0)


def test_while_depth_is_off_every_colour_image_stands_alone() -> None:
    pairer = FramePairer()
    pairer.add(image("video", 0))
    pairer.start_anew(with_depth=False)
    pairs = [pairer.add(image("video", number * FRAME)) for number in (1, 2)]
    assert [(pair.depth, pair.clocked.ticks) for pair in pairs if pair] == [(None, FRAME), (None, 2 * FRAME)]
    assert pairer.add(image("depth", 3 * FRAME)) is None, "left over from before the switch"
    assert pairer.unpaired == 0, "switching is no fault"


def test_images_from_before_a_switch_pair_with_none_after_it() -> None:
    pairer = FramePairer()
    pairer.add(image("video", 0))
    pairer.start_anew(with_depth=True)
    assert pairer.add(image("depth", 0)) is None
