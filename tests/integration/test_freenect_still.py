"""`rig-agent still`: single images for the calibration of a lens, under the unmodified libfreenect."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from rig_agent.cli import app
from rig_agent.sources.base import SourceLost
from rig_agent.sources.freenect import FreenectSettings, FreenectSource
from rig_agent.sources.freenect_still import take_still
from support.virtual_usb.virtual_bus import VirtualBus, VirtualKinect, infrared_frames, kinect_frames

SETTINGS = FreenectSettings()
HIGH_BAYER = np.random.default_rng(1).integers(0, 256, (2, 1024, 1280), np.uint8)


@pytest.fixture
def kinect(usb_bus: VirtualBus) -> VirtualKinect:
    kinect = usb_bus.add_kinect("A00364A11111111A", plugged=False)
    infrared_frames().write(kinect)
    (kinect.folder / "bayer_high.bin").write_bytes(HIGH_BAYER.tobytes())
    kinect.plug()
    return kinect


def is_one_of(image: np.ndarray, candidates: np.ndarray) -> bool:
    return any(np.array_equal(image, candidate) for candidate in candidates)


def demosaiced(bayer: np.ndarray) -> np.ndarray:
    return np.stack([cv2.cvtColor(image, cv2.COLOR_BayerGRBG2BGR) for image in bayer])


@pytest.mark.parametrize("high", [False, True])
def test_a_colour_still_is_one_whole_image_of_the_sensor(kinect: VirtualKinect, high: bool) -> None:
    still = take_still(SETTINGS, "color", high, settle_s=0)
    assert is_one_of(still, demosaiced(HIGH_BAYER if high else kinect_frames().bayer))
    assert kinect.open_handles() == 0


@pytest.mark.parametrize("high", [False, True])
def test_an_infrared_still_has_all_rows_of_the_sensor(kinect: VirtualKinect, high: bool) -> None:
    still = take_still(SETTINGS, "ir", high, settle_s=0)
    assert is_one_of(still, infrared_frames().high if high else infrared_frames().grey)
    assert kinect.open_handles() == 0


def test_a_still_that_lost_a_packet_is_not_taken(kinect: VirtualKinect) -> None:
    kinect.write("lose_video_packet", "100 2")  # of every second image
    for _ in range(2):
        assert is_one_of(take_still(SETTINGS, "color", settle_s=0), demosaiced(kinect_frames().bayer))


def test_a_kinect_that_streams_elsewhere_is_said_to_be_in_use(kinect: VirtualKinect) -> None:
    with FreenectSource(FreenectSettings(serial=kinect.serial)), pytest.raises(SourceLost, match="in use"):
        take_still(SETTINGS, "color")


def test_the_command_writes_a_png_and_says_its_size(kinect: VirtualKinect, tmp_path: Path) -> None:
    out = tmp_path / "board.png"
    result = CliRunner().invoke(app, ["still", str(out), "--infrared", "--serial", kinect.serial])
    assert result.exit_code == 0, result.output
    assert "640×488 pixels" in result.output
    assert is_one_of(cv2.imread(str(out), cv2.IMREAD_GRAYSCALE), infrared_frames().grey)


def test_a_name_that_is_no_png_is_refused_before_the_kinect_is_touched(
    kinect: VirtualKinect, tmp_path: Path
) -> None:
    result = CliRunner().invoke(app, ["still", str(tmp_path / "board.jpg")])
    assert result.exit_code != 0
    assert kinect.log() == []
