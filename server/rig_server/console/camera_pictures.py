"""What one camera sees, as a picture for people: colour, depth in colours, overlaps tinted."""

from enum import StrEnum
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from rig_protocol.camera import RawDepthModel
from rig_protocol.frames import NO_DISPARITY, ImageU8, ImageU16, RgbdFrame

_NEAR_M, _FAR_M = 0.5, 5.0
_NOTHING_BGR = (26, 22, 20)
_TINT = 0.38
_MM_STEP = 4  # of the table for millimetres
_TABLE_SIZE = 2048
_JPEG_QUALITY = 78


class Mode(StrEnum):
    """What tiles show."""

    COLOR = "color"
    DEPTH = "depth"
    OVERLAP = "overlap"


class Tint:
    """Colours over the parts of an image that other cameras see, too."""

    def __init__(self, colors: ImageU8, mask: ImageU8) -> None:
        """`colors` (H,W,3) BGR, `mask` (H,W), 255 where it tints; both of any size."""
        self._colors, self._mask = colors, mask

    def over(self, image: ImageU8) -> ImageU8:
        """The image with the tint over it."""
        size = image.shape[1], image.shape[0]
        if self._mask.shape != image.shape[:2]:
            self._colors = _resized(self._colors, size)
            self._mask = _resized(self._mask, size)
        blended = cv2.addWeighted(image, 1 - _TINT, self._colors, _TINT, 0.0)
        return np.asarray(cv2.copyTo(blended, self._mask, image.copy()), np.uint8)


def color_picture(frame: RgbdFrame, full: bool) -> ImageU8 | None:
    """(H,W,3) BGR, whole or half the size; None where the frame holds no colour.

    Half the size is one cell of the Bayer mosaic a pixel: no demosaicing.
    """
    if frame.bayer is not None:
        if full:
            return np.asarray(cv2.cvtColor(frame.bayer, cv2.COLOR_BayerGRBG2BGR), np.uint8)
        return _binned(frame.bayer)
    if frame.color is None:
        return None
    image = frame.color if frame.color.ndim == 3 else cv2.cvtColor(frame.color, cv2.COLOR_GRAY2BGR)
    if not full:
        image = cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2), interpolation=cv2.INTER_AREA)
    return np.asarray(image, np.uint8)


def depth_picture(frame: RgbdFrame, raw_model: RawDepthModel, full: bool) -> ImageU8 | None:
    """(H,W,3) BGR, near red, far blue, dark where nothing was measured; None where there is no depth."""
    step = 1 if full else 2
    if frame.raw is not None:
        disparity = np.minimum(frame.raw[::step, ::step], NO_DISPARITY)
        return _painted(_raw_levels(raw_model)[disparity])
    if frame.depth_mm is None:
        return None
    depth: ImageU16 = frame.depth_mm[::step, ::step] // np.uint16(_MM_STEP)
    return _painted(_MM_LEVELS[np.minimum(depth, _TABLE_SIZE - 1)])


def distance_picture(distance_m: npt.NDArray[np.float32]) -> ImageU8:
    """The same of distances (H,W) in metres, NaN where nothing was measured."""
    steps = np.nan_to_num(distance_m * (1000.0 / _MM_STEP), nan=0.0, posinf=0.0).astype(np.int32)
    return _painted(_MM_LEVELS[np.clip(steps, 0, _TABLE_SIZE - 1)])


def jpeg(image: ImageU8) -> bytes:
    """The image as a JPEG file."""
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    if not done:
        raise ValueError(f"OpenCV does not encode an image of shape {image.shape}")
    return data.tobytes()


def _binned(bayer: ImageU8) -> ImageU8:
    """One pixel a 2×2 cell of a GRBG mosaic."""
    green = cv2.addWeighted(
        np.ascontiguousarray(bayer[0::2, 0::2]), 0.5, np.ascontiguousarray(bayer[1::2, 1::2]), 0.5, 0.0
    )
    blue, red = np.ascontiguousarray(bayer[1::2, 0::2]), np.ascontiguousarray(bayer[0::2, 1::2])
    return np.asarray(cv2.merge([blue, green, red]), np.uint8)


def _resized(image: ImageU8, size: tuple[int, int]) -> ImageU8:
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_NEAREST), np.uint8)


def _painted(levels: ImageU8) -> ImageU8:
    """Colours (H,W,3) of levels (H,W)."""
    return np.asarray(cv2.applyColorMap(levels, _COLORS), np.uint8)


def _levels(depth_m: npt.NDArray[np.float64]) -> ImageU8:
    """Levels (N,) of depths, 1 far to 255 near; 0 for those that are not positive."""
    known = np.isfinite(depth_m) & (depth_m > 0)
    # Between equal steps of depth and of disparity: near and far can both be told apart.
    inverse_m = 1 / np.where(known, depth_m, _FAR_M)
    nearness = np.sqrt(np.clip((inverse_m - 1 / _FAR_M) / (1 / _NEAR_M - 1 / _FAR_M), 0, 1))
    return np.where(known, np.rint(1 + 254 * nearness), 0).astype(np.uint8)


def _colors() -> ImageU8:
    """Colours (256,1,3) of levels: Turbo without its dark ends, which would look like nothing."""
    ramp = np.rint(np.linspace(15, 240, 256)).astype(np.uint8)
    colors = np.asarray(cv2.applyColorMap(ramp[:, None], cv2.COLORMAP_TURBO), np.uint8)
    colors[0] = _NOTHING_BGR
    return colors


_COLORS = _colors()
_MM_LEVELS = _levels(np.arange(_TABLE_SIZE, dtype=np.float64) * (_MM_STEP / 1000.0))


@lru_cache(maxsize=256)
def _raw_levels(model: RawDepthModel) -> ImageU8:
    """Levels of all disparities; the last means none."""
    with np.errstate(divide="ignore"):
        depth_m = model.numerator_m / (model.offset - np.arange(_TABLE_SIZE, dtype=np.float64))
    depth_m[-1] = 0.0
    return _levels(depth_m)
