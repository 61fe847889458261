"""One image of a Kinect's colour or infrared camera, up to 1280×1024, for the calibration of its lens."""

import time
from typing import Literal

import cv2
import numpy as np

from rig_agent.sources.base import SourceLost
from rig_agent.sources.freenect import FreenectSettings, find_kinect
from rig_agent.sources.freenect_device import Switches
from rig_agent.sources.freenect_formats import COLOR, HIGH_COLOR
from rig_agent.sources.freenect_thread import FreenectThread
from rig_agent.sources.libfreenect import load_libfreenect
from rig_protocol.frames import ImageU8

StillImage = Literal["color", "ir"]
SETTLE_S = 1.0
"""In which exposure and white balance find their values after the camera has started."""
_LIMIT_S = 10.0
_STOP_LIMIT_S = 2.0


def take_still(
    settings: FreenectSettings, image: StillImage, high: bool = False, settle_s: float = SETTLE_S
) -> ImageU8:
    """A whole image: (480,640,3) BGR or (488,640) infrared, (1024,1280) of either with `high`.

    Depth is off meanwhile. SourceLost when the Kinect is absent, in use or delivers no whole image,
    ConfigurationError as the source.
    """
    name: Literal["bayer", "ir"] = "ir" if image == "ir" else "bayer"
    library = load_libfreenect(settings.library)
    camera, _ = find_kinect(settings)
    thread = FreenectThread(
        library, camera.index, Switches((HIGH_COLOR if high else COLOR)[name], None, True, True)
    )
    try:
        thread.wait_until_open(max(settings.timeout_s, _LIMIT_S))
        taken = _whole_image(thread, settle_s)
    finally:
        thread.stop(_STOP_LIMIT_S)
    return taken if name == "ir" else np.asarray(cv2.cvtColor(taken, cv2.COLOR_BayerGRBG2BGR), np.uint8)


def _whole_image(thread: FreenectThread, settle_s: float) -> ImageU8:
    began_s = time.monotonic()
    while (waited_s := time.monotonic() - began_s) < settle_s + _LIMIT_S:
        pair = thread.next_pair(1.0)
        if pair is not None and not pair.damaged and waited_s >= settle_s:
            return np.asarray(pair.video.image, np.uint8)
    raise SourceLost(f"the Kinect has sent no whole image within {_LIMIT_S:g} s")
