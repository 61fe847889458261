"""The calibrating sink: which panoramic frames it chooses."""

import pytest

from rig_protocol.errors import RigError
from rig_protocol.frames import PanoramicFrame, RgbdFrame
from rig_server.sinks.calibrate import CalibrateSink


def panorama(index: int, missing: int = 0) -> PanoramicFrame:
    frames = {i: None if i < missing else RgbdFrame(i, index, 0) for i in range(4)}
    return PanoramicFrame(index, 0, frames, 0)


def indices(sink: CalibrateSink) -> list[int]:
    return [one.index for one in sink.chosen()[0]]


def test_the_first_complete_sets_are_used_and_then_no_more_are_wanted() -> None:
    sink = CalibrateSink(2, range(4))
    wanted = [sink.take(panorama(index, missing)) for index, missing in ((0, 1), (1, 0), (2, 2), (3, 0))]
    assert wanted == [True, True, True, False]
    assert indices(sink) == [1, 3]
    assert sink.chosen()[1] == ()


def test_a_damaged_frame_counts_as_missing() -> None:
    damaged = RgbdFrame(3, 0, 0, damaged=True)
    sink = CalibrateSink(1, range(4))
    assert sink.take(PanoramicFrame(0, 0, {**panorama(0).frames, 3: damaged}, 0))
    assert "cameras 3" in sink.chosen()[1][0]
    assert not sink.take(panorama(1))
    assert indices(sink) == [1]


def test_a_set_from_before_a_camera_joined_is_not_complete() -> None:
    sink = CalibrateSink(1, range(4))
    assert sink.take(PanoramicFrame(0, 0, {i: RgbdFrame(i, 0, 0) for i in range(3)}, 0))


def test_the_least_incomplete_sets_fill_up_in_order_and_a_warning_names_who_was_missing() -> None:
    sink = CalibrateSink(3, range(4))
    for index, missing in ((0, 3), (1, 1), (2, 0), (3, 2)):
        sink.take(panorama(index, missing))
    chosen, warnings = sink.chosen()
    assert [one.index for one in chosen] == [1, 2, 3]
    assert len(warnings) == 1
    assert "2 of 3 panoramic frames were partial" in warnings[0]
    assert "cameras 0, 1" in warnings[0]


def test_nothing_at_all_says_where_to_look() -> None:
    with pytest.raises(RigError, match="no frame has arrived"):
        CalibrateSink(1, range(4)).chosen()
