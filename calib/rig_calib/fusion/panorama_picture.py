"""panorama.png: the colour strip above the depth strip, with a scale in metres and the cameras' places."""

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from rig_calib.fusion.panorama import Panorama
from rig_calib.whole_file import whole_file
from rig_protocol.errors import DataError
from rig_protocol.frames import ImageU8

_BACKGROUND, _INK, _FAINT = (24, 22, 20), (235, 232, 228), (120, 116, 112)  # BGR
_BORDER_PX, _RULER_PX, _LEGEND_PX = 24, 60, 96
_FONT, _FONT_SCALE = cv2.FONT_HERSHEY_SIMPLEX, 0.95
_NAME_GAP_PX = 24
_MIN_WIDTH_PX = 480  # the legend needs this much


def write_panorama(path: Path, panorama: Panorama) -> None:
    """Write the picture, the file whole or not at all."""
    written, data = cv2.imencode(".png", panorama_picture(panorama))
    if not written:
        raise DataError(f"{path}: the panorama could not be encoded as PNG")
    with whole_file(path) as file:
        file.write(data.tobytes())


def panorama_picture(panorama: Panorama) -> ImageU8:
    """The picture (H,W,3), BGR: colour, cameras, depth, scale."""
    low, high = depth_range_m(panorama.depth_m)
    color = np.where(
        panorama.color.any(axis=2, keepdims=True), panorama.color, np.array(_BACKGROUND, np.uint8)
    )
    strips = (
        color,
        _camera_ruler(panorama),
        color_depth(panorama.depth_m, low, high),
        _legend(panorama.cylinder.width, low, high),
    )
    width = max(panorama.cylinder.width, _MIN_WIDTH_PX)
    return np.asarray(_framed(np.concatenate([_widened(strip, width) for strip in strips])), np.uint8)


def depth_range_m(depth_m: npt.NDArray[np.float32]) -> tuple[float, float]:
    """Rounded limits that hold nearly all of a depth image; 0 to 1 m when it is empty."""
    known = depth_m[np.isfinite(depth_m)]
    if not len(known):
        return 0.0, 1.0
    low, high = np.percentile(known, (0.5, 99.5))
    low, high = np.floor(low * 2) / 2, np.ceil(high * 2) / 2
    return float(low), float(max(high, low + 0.5))


def color_depth(depth_m: npt.NDArray[np.float32], low_m: float, high_m: float) -> ImageU8:
    """Depth (H,W) as colours (H,W,3), BGR: warm is near, and nothing is the background."""
    known = np.isfinite(depth_m)
    nearness = (high_m - np.where(known, depth_m, high_m)) / (high_m - low_m)
    image = cv2.applyColorMap((nearness.clip(0, 1) * 255).astype(np.uint8), cv2.COLORMAP_TURBO)
    image[~known] = _BACKGROUND
    return np.asarray(image, dtype=np.uint8)


def _camera_ruler(panorama: Panorama) -> ImageU8:
    """Names of the cameras under the columns where they look; those without room get a tick only."""
    strip = _blank(_RULER_PX, panorama.cylinder.width)
    free_from = 0
    columns = {
        name: panorama.cylinder.column(np.array(a)) for name, a in panorama.camera_azimuths_rad.items()
    }
    for name, column in sorted(columns.items(), key=lambda item: float(item[1])):
        cv2.line(strip, (round(float(column)), 0), (round(float(column)), 12), _FAINT, 3)
        left, right = _text_span(strip, name, round(float(column)))
        if left >= free_from:
            cv2.putText(strip, name, (left, 44), _FONT, _FONT_SCALE, _INK, 1, cv2.LINE_AA)
            free_from = right + _NAME_GAP_PX
    return strip


def _legend(width: int, low_m: float, high_m: float) -> ImageU8:
    """The colours of depth with a tick every half metre or metre."""
    strip = _blank(_LEGEND_PX, max(width, _MIN_WIDTH_PX))
    bar = min(1200, strip.shape[1] - 200)
    left = (strip.shape[1] - bar) // 2
    ramp = np.linspace(low_m, high_m, bar, dtype=np.float32)
    strip[18:42, left : left + bar] = color_depth(ramp[None], low_m, high_m)
    step = 0.5 if high_m - low_m <= 4 else 1.0
    for metres in np.arange(np.ceil(low_m / step) * step, high_m + 1e-6, step):
        column = left + round((metres - low_m) / (high_m - low_m) * (bar - 1))
        cv2.line(strip, (column, 42), (column, 50), _INK, 2)
        origin = (_text_span(strip, f"{metres:g}", column)[0], 80)
        cv2.putText(strip, f"{metres:g}", origin, _FONT, _FONT_SCALE, _INK, 1, cv2.LINE_AA)
    cv2.putText(strip, "m", (left + bar + 36, 80), _FONT, _FONT_SCALE, _INK, 1, cv2.LINE_AA)
    return strip


def _blank(height: int, width: int) -> ImageU8:
    return np.full((height, width, 3), _BACKGROUND, np.uint8)


def _text_span(image: ImageU8, text: str, column: int) -> tuple[int, int]:
    """First and last column of a text centred on a column, moved to lie within the image."""
    width = cv2.getTextSize(text, _FONT, _FONT_SCALE, 1)[0][0]
    left = min(max(column - width // 2, 0), max(image.shape[1] - width, 0))
    return left, left + width


def _widened(strip: ImageU8, width: int) -> ImageU8:
    missing = width - strip.shape[1]
    sides = (missing // 2, missing - missing // 2)
    return np.stack(
        [np.pad(strip[..., k], ((0, 0), sides), constant_values=_BACKGROUND[k]) for k in range(3)], axis=-1
    )


def _framed(image: ImageU8) -> npt.NDArray[np.uint8]:
    border = (_BORDER_PX,) * 4
    return np.asarray(cv2.copyMakeBorder(image, *border, cv2.BORDER_CONSTANT, value=_BACKGROUND))
