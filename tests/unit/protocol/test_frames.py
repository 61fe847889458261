"""What a panoramic frame says of its frames."""

import pytest

from rig_protocol.frames import PanoramicFrame, RgbdFrame


def test_a_set_tells_mean_time_spread_and_the_largest_uncertainty() -> None:
    frames = {
        0: RgbdFrame(0, 0, 1_000, uncertainty_ns=30),
        1: None,
        2: RgbdFrame(2, 0, 1_500, uncertainty_ns=70),
        3: RgbdFrame(3, 0, 1_101, uncertainty_ns=10),
    }
    panorama = PanoramicFrame.of(5, frames)
    assert panorama == PanoramicFrame(5, 1_200, frames, 500, 70)
    assert panorama.missing == (1,)
    assert not panorama.complete


def test_a_set_holds_at_least_one_frame() -> None:
    with pytest.raises(ValueError, match="set 5 holds no frame"):
        PanoramicFrame.of(5, {0: None})
